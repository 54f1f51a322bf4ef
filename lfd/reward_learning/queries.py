"""Which question to ask: what an answer to "A or B?" is expected to teach about w, for many pairs at once.

For samples w_m of the posterior and differences d = f_A - f_B, with p_m = p(a | w_m) of Bradley and Terry's model,

    information_gain   I(w; answer) = H(mean_m p_m) - mean_m H(p_m) [bits]     Houlsby et al. 2011; Biyik et al. 2019
    volume_removal     min(E[1 - f], E[1 - f'])                                 Sadigh et al. 2017, Eq. 10
                       f = min(1, exp(rationality w.d)), and f' the same with -d
    expected_volume    1 - sum_q pbar_q^2,  pbar_a = mean_m p_m, pbar_b = 1 - pbar_a

Information gain is 0 for two identical trajectories, and small where the person would only guess. The two volumes are
largest or near it there: their maximisers ask questions that cannot be answered (Biyik et al. 2019). `best_query` never
asks about identical trajectories.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from scipy.special import expit, xlogy

from lfd.core.errors import InputError, UnknownName
from lfd.rewards.checked_arrays import finite_array

Criterion = Literal["information_gain", "volume_removal", "expected_volume"]
AT_ONCE = 2_000_000
"""Numbers that are computed at a time, so that a large pool does not fill the memory."""
ALL_ALIKE = "all trajectories have the same features: no question teaches anything; add other trajectories"


class Query(NamedTuple):
    """Two trajectories to be compared, and what that is worth."""

    i: int
    j: int
    value: float


def query_values(
    differences: Float[np.ndarray, "Q K"],
    samples: Float[np.ndarray, "M K"],
    *,
    criterion: Criterion = "information_gain",
    rationality: float,
) -> Float[np.ndarray, "Q"]:
    """The worth of Q questions with feature differences f_A - f_B, over M samples of w; information gain in bits.

    Raises `InputError` for shapes that do not fit, numbers that are not finite, or a rationality that is not positive,
    `UnknownName` for another criterion.
    """
    differences = finite_array("differences", differences, ("Q", "K"))
    samples = finite_array("samples", samples, ("M", differences.shape[1]))
    _check(samples, criterion, rationality)
    values = np.empty(len(differences))
    for begin in range(0, len(values), step := max(1, AT_ONCE // len(samples))):
        x = rationality * (differences[begin : begin + step] @ samples.T)
        values[begin : begin + step] = _worth(x, criterion)
    return values


def best_query(
    features: Float[np.ndarray, "N K"],
    samples: Float[np.ndarray, "M K"],
    *,
    criterion: Criterion = "information_gain",
    rationality: float,
) -> Query:
    """The best of all pairs i < j of N trajectories.

    Raises `InputError` when all trajectories have the same features: no question teaches anything then.
    """
    features = finite_array("features", features, ("N", "K"))
    samples = finite_array("samples", samples, ("M", features.shape[1]))
    _check(samples, criterion, rationality)
    first, second, values = _all_pairs(features, samples, criterion, rationality)
    best = int(values.argmax())
    return Query(int(first[best]), int(second[best]), float(values[best]))


def best_batch(
    features: Float[np.ndarray, "N K"],
    samples: Float[np.ndarray, "M K"],
    size: int,
    *,
    rationality: float,
    among: int = 200,
) -> list[Query]:
    """Questions to be asked together, of all pairs i < j of N trajectories: see `joint_batch`."""
    features = finite_array("features", features, ("N", "K"))
    samples = finite_array("samples", samples, ("M", features.shape[1]))
    first, second = np.triu_indices(len(features), 1)
    different = (features[first] != features[second]).any(axis=1)
    if not different.any():
        raise InputError(ALL_ALIKE)
    first, second = first[different], second[different]
    chosen = joint_batch(features[first] - features[second], samples, size, rationality=rationality, among=among)
    return [Query(int(first[q]), int(second[q]), gain) for q, gain in chosen]


def joint_batch(
    differences: Float[np.ndarray, "Q K"],
    samples: Float[np.ndarray, "M K"],
    size: int,
    *,
    rationality: float,
    among: int = 200,
) -> list[tuple[int, float]]:
    """Questions to be asked together: each adds the most to what the answers to all tell about w, jointly.

    Their numbers, and the bits that each adds. Two that ask the same are not both chosen, since the second adds little.
    Greedy over the `among` best, which comes within 1 - 1/e of the best batch of these (information gain is
    submodular). Raises `InputError` for a size that is not positive or above 12: joint answers are counted, 2^size of
    them.
    """
    if not 1 <= size <= 12:
        raise InputError(f"size = {size}: a batch has 1 to 12 questions")
    values = query_values(differences, samples, rationality=rationality)
    pool = np.argsort(-values)[:among]
    x = rationality * (differences[pool] @ samples.T)
    chances, noise, left = expit(x), _mean_entropy(x), np.ones(len(pool), dtype=bool)
    joint, entropy, chosen = np.ones((1, len(samples))), 0.0, list[tuple[int, float]]()  # p(answers | w_m), (2^b, M)
    for _ in range(min(size, len(pool))):
        with_a = chances @ joint.T / len(samples)
        with_b = np.maximum(0.0, joint.mean(axis=1) - with_a)
        entropies = -(xlogy(with_a, with_a) + xlogy(with_b, with_b)).sum(axis=1) / np.log(2.0)
        best = int(np.where(left, entropies - noise, -np.inf).argmax())
        chosen.append((int(pool[best]), float(entropies[best] - noise[best] - entropy)))
        entropy, left[best] = float(entropies[best]), False
        joint = np.concatenate([joint * chances[best], joint * (1.0 - chances[best])])
    return chosen


def worth_asking(query: Query, cost_bits: float) -> bool:
    """The stopping rule: whether a question tells more than an answer costs the person [bits]."""
    return query.value > cost_bits


def _check(samples: Float[np.ndarray, "M K"], criterion: str, rationality: float) -> None:
    if criterion not in get_args(Criterion):
        raise UnknownName("criterion", criterion, get_args(Criterion))
    if len(samples) == 0:
        raise InputError("samples is empty: draw some from the posterior, posterior.sample(100)")
    if not (np.isfinite(rationality) and rationality > 0.0):
        raise InputError(f"rationality = {rationality}: give a positive number")


def _all_pairs(
    features: Float[np.ndarray, "N K"], samples: Float[np.ndarray, "M K"], criterion: Criterion, rationality: float
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "P"]]:
    """i, j and worth of all pairs i < j; -inf for trajectories with the same features."""
    first, second = np.triu_indices(len(features), 1)
    returns = rationality * (features @ samples.T)
    values = np.empty(len(first))
    for begin in range(0, len(values), step := max(1, AT_ONCE // len(samples))):
        pairs = slice(begin, begin + step)
        values[pairs] = _worth(returns[first[pairs]] - returns[second[pairs]], criterion)
    values[(features[first] == features[second]).all(axis=1)] = -np.inf
    if not np.isfinite(values).any():
        raise InputError(ALL_ALIKE)
    return first, second, values


def _worth(x: Float[np.ndarray, "Q M"], criterion: Criterion) -> Float[np.ndarray, "Q"]:
    """The criterion for x = rationality w.(f_A - f_B)."""
    if criterion == "volume_removal":
        return np.minimum(
            (1.0 - np.exp(np.minimum(0.0, x))).mean(axis=1), (1.0 - np.exp(np.minimum(0.0, -x))).mean(axis=1)
        )
    chances = expit(x)
    pbar = chances.mean(axis=1)
    if criterion == "expected_volume":
        return 1.0 - pbar**2 - (1.0 - pbar) ** 2
    return np.maximum(0.0, _entropy(pbar) - _mean_entropy(x))


def _entropy(chances: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Entropy of a coin [bits]."""
    return -(xlogy(chances, chances) + xlogy(1.0 - chances, 1.0 - chances)) / np.log(2.0)


def _mean_entropy(x: Float[np.ndarray, "Q M"]) -> Float[np.ndarray, "Q"]:
    """mean_m H(p_m) [bits], by H = log(1 + e^-|x|) + |x| e^-|x| / (1 + e^-|x|), exact also where p is 1 to rounding."""
    odds = np.exp(-np.abs(x))
    return (np.log1p(odds) + np.abs(x) * odds / (1.0 + odds)).mean(axis=1) / np.log(2.0)
