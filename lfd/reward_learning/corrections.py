"""From a physical correction to new reward weights (chapter 10.5.2).

A person pushes the arm off its trajectory tau_R, and it goes along tau_H; that is taken to be better, w*.f(tau_H) >=
w*.f(tau_R).
"""

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.rewards.checked_arrays import finite_array


def correction_update(
    weights: Float[np.ndarray, "K"],
    f_corrected: Float[np.ndarray, "K"],
    f_planned: Float[np.ndarray, "K"],
    *,
    step_size: float | Float[np.ndarray, "K"],
    lower: float | Float[np.ndarray, "K"] | None = None,
    upper: float | Float[np.ndarray, "K"] | None = None,
) -> Float[np.ndarray, "K"]:
    """w <- w + beta (f(tau_H) - f(tau_R)), then the nearest weights within `lower` and `upper`.

    It is the MAP estimate (Bajcsy et al. 2017, Section 3.3) of a person who picks tau_H with p(tau_H | w) ~
    exp(w.f(tau_H)) / integral exp(w.f(tau)) d tau. With the integral's Laplace approximation at tau_R, the optimum for
    the present weights, the log likelihood is w.(f(tau_H) - f(tau_R)) up to a constant, and with the prior N(w_hat,
    beta I)

        log p(w | tau_H) = w.(f(tau_H) - f(tau_R)) - |w - w_hat|^2 / (2 beta) + const.,

    which is largest at w_hat + beta (f(tau_H) - f(tau_R)); with a step size for each feature the prior is N(w_hat,
    diag(beta)), and the constrained maximum is the clipped one. beta_k ~ 1 / range_k^2 makes features of different
    units move alike. These are rewards: papers and code with costs subtract.

    Raises `InputError` for vectors of other lengths, numbers that are not finite, a step size that is not positive, or
    lower bounds above upper ones.
    """
    weights, corrected, planned = _checked(weights, f_corrected, f_planned)
    beta = _per_feature("step_size", step_size, len(weights))
    if (beta <= 0.0).any():
        raise InputError(f"step_size = {step_size}: must be positive; 0 would learn nothing, less the opposite")
    low = np.full(len(weights), -np.inf) if lower is None else _per_feature("lower", lower, len(weights))
    high = np.full(len(weights), np.inf) if upper is None else _per_feature("upper", upper, len(weights))
    if (low > high).any():
        k = int((low > high).argmax())
        raise InputError(f"lower[{k}] = {low[k]} is above upper[{k}] = {high[k]}")
    return np.clip(weights + beta * (corrected - planned), low, high)


def one_feature_update(
    weights: Float[np.ndarray, "K"],
    f_corrected: Float[np.ndarray, "K"],
    f_planned: Float[np.ndarray, "K"],
    *,
    step_size: float,
    ranges: Float[np.ndarray, "K"],
) -> tuple[Float[np.ndarray, "K"], int]:
    """The same for the one feature that the person most likely meant; the new weights and its index.

        k = argmax_k |f(tau_H) - f(tau_R)|_k / range_k,        w_k <- w_k + beta (f(tau_H) - f(tau_R))_k

    "One at a time" (Bajcsy et al. 2018, "Learning from Physical Human Corrections, One Feature at a Time"): a push that
    is meant for one feature moves others by accident, and learning all of them unlearns what was right. The intended
    feature is the one whose change is the largest part of its range.

    Raises `InputError` as `correction_update` does, and for ranges that are not positive.
    """
    weights, corrected, planned = _checked(weights, f_corrected, f_planned)
    ranges = finite_array("ranges", ranges, (len(weights),))
    if (ranges <= 0.0).any():
        k = int((ranges <= 0.0).argmax())
        raise InputError(
            f"ranges[{k}] = {ranges[k]}: must be positive, how far feature {k} varies between trajectories"
        )
    if not step_size > 0.0:
        raise InputError(f"step_size = {step_size}: must be positive")
    change = corrected - planned
    k = int((np.abs(change) / ranges).argmax())
    updated = weights.copy()
    updated[k] += step_size * change[k]
    return updated, k


def explained_share(push: Float[np.ndarray, "D"], gradients: Float[np.ndarray, "K D"]) -> float:
    """How much of a push the features explain, in [0, 1]: |P push|^2 / |push|^2.

    P projects on the span of the features' gradients with respect to what was pushed (joints, or waypoints of the
    trajectory). A push that changes no feature, to first order, is about something the robot has no feature for: 0.
    With this as a factor on the step size such a push teaches nothing. It is the idea of Bobu et al. 2018 ("Learning
    under Misspecified Objective Spaces"), who estimate the person's rationality for it; the share here is its
    first-order form.

    Raises `InputError` for shapes that do not fit, or a push of length 0.
    """
    push = finite_array("push", push, ("D",))
    gradients = finite_array("gradients", gradients, ("K", len(push)))
    size = float(push @ push)
    if size == 0.0:
        raise InputError("push is 0: nothing was corrected")
    explained = gradients.T @ np.linalg.lstsq(gradients.T, push, rcond=None)[0]
    return float(np.clip(explained @ explained / size, 0.0, 1.0))


def _checked(
    weights: Float[np.ndarray, "K"], f_corrected: Float[np.ndarray, "K"], f_planned: Float[np.ndarray, "K"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    weights = finite_array("weights", weights, ("K",))
    size = (len(weights),)
    return weights, finite_array("f_corrected", f_corrected, size), finite_array("f_planned", f_planned, size)


def _per_feature(name: str, value: float | Float[np.ndarray, "K"], size: int) -> Float[np.ndarray, "K"]:
    """A number for each feature, from one for all or one for each; bounds may be infinite."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (size,)) or np.isnan(array).any():
        raise InputError(f"{name} = {value}: give one number, or one for each of the {size} weights")
    return np.broadcast_to(array, (size,))
