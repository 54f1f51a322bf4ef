"""Feature counts of a trajectory and their expectation over trajectories (chapter 10.4).

    R(x, u) = w^T phi(x, u),    f(tau) = sum_{t<T} gamma^t phi(x_t, u_t),    mu(pi) = E_pi[f(tau)]

T decisions are taken at t = 0 .. T-1; the state after the last of them earns nothing. Hence R(tau) = w^T f(tau), and
the value of a policy is w^T mu(pi).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.rewards.checked_arrays import checked_discount, finite_array


@dataclass(frozen=True)
class FeatureExpectations:
    """Monte Carlo estimate of mu(pi) from n trajectories."""

    mean: Float[np.ndarray, "K"]
    """mean_i f(tau_i): every trajectory counts the same, however long it is."""
    standard_error: Float[np.ndarray, "K"]
    """sqrt(sum_i (f(tau_i) - mean)^2 / (n - 1)) / sqrt(n); NaN for n = 1, which says nothing about the spread."""
    trajectories: int
    """n."""


def feature_counts(phi: Shaped[np.ndarray, "..."], *, discount: float | int) -> Float[np.ndarray, "K"]:
    """f(tau) = sum_{t<T} gamma^t phi_t of one trajectory, `phi` of shape (T, K); 0 for T = 0.

    Raises `InputError` for a table of another shape, a number that is not finite, a discount outside [0, 1].
    """
    table = finite_array("phi", phi, ("T", "K"))
    return checked_discount(discount) ** np.arange(len(table)) @ table


def feature_expectations(phis: Sequence[Shaped[np.ndarray, "..."]], *, discount: float | int) -> FeatureExpectations:
    """Mean of f over trajectories and its standard error; `phis` are tables (T_i, K), lengths may differ.

    Raises `InputError` as `feature_counts` does, naming the trajectory, and when there is none.
    """
    if len(phis) == 0:
        raise InputError("no trajectory is given; feature expectations need at least one, and two for a standard error")
    features = np.shape(phis[0])[-1] if np.ndim(phis[0]) else "K"
    checked_discount(discount)
    tables = [finite_array(f"phi of trajectory {i}", phi, ("T", features)) for i, phi in enumerate(phis)]
    return expectations_of_counts([feature_counts(table, discount=discount) for table in tables])


def expectations_of_counts(counts: Sequence[Float[np.ndarray, "K"]]) -> FeatureExpectations:
    """Mean and standard error of f(tau_i), one row for each of n trajectories.

    Raises `InputError` for rows of different lengths.
    """
    if len({len(row) for row in counts}) > 1:
        i = next(i for i, row in enumerate(counts) if len(row) != len(counts[0]))
        raise InputError(f"trajectory {i} has {len(counts[i])} features, trajectory 0 has {len(counts[0])}")
    table, n = np.array(counts), len(counts)
    error = table.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.full(table.shape[1], np.nan)
    return FeatureExpectations(mean=table.mean(axis=0), standard_error=error, trajectories=n)
