"""Maximum margin planning for a given set of candidate policies (Ratliff, Bagnell, Zinkevich 2006).

    min_w     |w|^2         s.t.  w^T mu_E >= w^T mu_i + m_i                                        (the hard form)
    min_{w,v} |w|^2 + C v   s.t.  w^T mu_E >= w^T mu_i + m_i - v                                             (10.6)

10.6 as printed leaves v free. At its optimum v = max_i m_i - w^T (mu_E - mu_i): once the margins are met v is negative
and still pays, so |w| grows with C without end (w = C/2 (mu_E - mu_1) for one candidate). With v >= 0, the default, w
tends to the hard form's solution as C grows, where that exists.

The hard form is solved by an active set, 10.6 by Clarabel, whose answer is then made exact on the rows it found active.
"""

from dataclasses import dataclass

import clarabel.clarabel as clarabel  # the compiled module: type checkers do not see its names in the package
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Shaped
from scipy.optimize import nnls

from lfd.core.errors import InputError
from lfd.reward_learning.failures import Infeasible, SolverFailed
from lfd.reward_learning.hull import ZERO_MARGIN
from lfd.rewards.checked_arrays import finite_array

SOLVER_TOLERANCE = 1e-11
OPTIMAL = 1e-8
"""How far an optimality condition may be missed, as a share of the largest margin or slope."""


@dataclass(frozen=True)
class MaxMarginPlanning:
    """Solution of the hard form or of (10.6)."""

    weights: Float[np.ndarray, "K"]
    """w."""
    slack: float
    """v; 0 in the hard form."""


def max_margin_planning(
    mu_expert: Shaped[np.ndarray, "..."],
    mu_candidates: Shaped[np.ndarray, "..."],
    *,
    margins: Shaped[np.ndarray, "..."] | None = None,
    slack_weight: float | int | None = None,
    nonnegative_slack: bool = True,
) -> MaxMarginPlanning:
    """Weights for `mu_expert` (K,) and `mu_candidates` (M, K).

    `margins` are m_i = m(pi*, pi_i) (M,), 1 each unless given (`lfd.reward_learning.dissimilarity` has several).
    `slack_weight` is C; without it the hard form is solved. `nonnegative_slack=False` is 10.6 as printed.

    Raises `Infeasible` when no w meets the hard form's constraints, `InputError` for other shapes, negative margins,
    a C that is not positive and when there is no candidate, `SolverFailed` when nnls or Clarabel (with its status) has
    no answer.
    """
    candidates = finite_array("mu_candidates", mu_candidates, ("M", "K"))
    if len(candidates) == 0:
        raise InputError("mu_candidates has no row: give the feature expectations of at least one policy")
    expert = finite_array("mu_expert", mu_expert, (candidates.shape[1],))
    wanted = np.ones(len(candidates)) if margins is None else finite_array("margins", margins, (len(candidates),))
    if (wanted < 0).any():
        raise InputError(
            f"margins[{int(np.argmax(wanted < 0))}] is negative: it says how unlike the expert a policy is"
        )
    if slack_weight is None and not nonnegative_slack:
        raise InputError("nonnegative_slack=False needs a slack: give slack_weight, the C of 10.6")
    if slack_weight is not None and not 0 < slack_weight < np.inf:
        raise InputError(f"slack_weight = {slack_weight}: the C of 10.6 is positive and finite; None is the hard form")
    better = expert - candidates
    # In units of the largest difference: w' = scale w, and the objective times scale^2.
    scale = float(np.abs(better).max(initial=0.0)) or 1.0
    if slack_weight is None:
        rounding = ZERO_MARGIN * max(1.0, float(np.abs(candidates).max()) / scale, float(np.abs(expert).max()) / scale)
        return MaxMarginPlanning(weights=_hard(better / scale, wanted, rounding) / scale, slack=0.0)
    weights, slack = _with_slack(better / scale, wanted, slack_weight * scale**2, nonnegative_slack)
    return MaxMarginPlanning(weights=weights / scale, slack=slack)


def _hard(better: Float[np.ndarray, "M K"], margins: Float[np.ndarray, "M"], rounding: float) -> Float[np.ndarray, "K"]:
    """min |w|^2  s.t.  better w >= margins, as least-distance programming (Lawson and Hanson 1974, chapter 23).

    min_{u >= 0} |better^T u|^2 + (margins^T u - 1)^2 is 0 if and only if no w exists; else w holds with equality in the
    rows where u > 0.
    """
    count, features = better.shape
    largest = float(margins.max()) or 1.0
    rows = np.vstack([better.T, margins / largest])
    try:
        u, missing = nnls(rows, np.append(np.zeros(features), 1.0), maxiter=10 * (count + features))
    except RuntimeError as error:
        raise SolverFailed(f"scipy.optimize.nnls on {count} candidates: {error}") from error
    if missing <= rounding:
        raise Infeasible(
            f"no weights let the expert beat all {count} candidates by their margins: the expert lies in the convex "
            "hull of the candidates, or is one of them. Give slack_weight=C for the form with slack (10.6), which "
            "allows for a suboptimal expert"
        )
    weights = _nearest_with_equality(better[u > 0], margins[u > 0], np.zeros(features))
    if not _optimal(better, margins, 2.0 * weights, better @ weights, u > 0):
        raise SolverFailed(f"scipy.optimize.nnls on {count} candidates ended at weights that are not optimal")
    return weights


def _with_slack(
    better: Float[np.ndarray, "M K"], margins: Float[np.ndarray, "M"], penalty: float, nonnegative: bool
) -> tuple[Float[np.ndarray, "K"], float]:
    """min |w|^2 + penalty v  s.t.  better w + v >= margins, and v >= 0 if `nonnegative`."""
    count, features = better.shape
    rows, bound = np.column_stack([better, np.ones(count)]), margins
    if nonnegative:
        rows, bound = np.vstack([rows, np.eye(features + 1)[-1]]), np.append(margins, 0.0)
    quadratic, linear = np.append(np.full(features, 2.0), 0.0), np.append(np.zeros(features), penalty)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = SOLVER_TOLERANCE
    cone = clarabel.NonnegativeConeT(len(bound))
    solution = clarabel.DefaultSolver(
        sp.diags(quadratic, format="csc"), linear, sp.csc_matrix(-rows), -bound, [cone], settings
    ).solve()
    active = np.array(solution.z) > np.array(solution.s)
    point = _on_face(better, margins, penalty, active)
    if _optimal(rows, bound, quadratic * point + linear, rows @ point, active):
        return point[:features], float(point[features])
    if solution.status != clarabel.SolverStatus.Solved:
        raise SolverFailed(
            f"Clarabel stopped with status {solution.status} on {count} candidates of {features} features"
        )
    weights = np.array(solution.x[:features])
    return weights, max(float((margins - better @ weights).max()), 0.0 if nonnegative else -np.inf)


def _on_face(
    better: Float[np.ndarray, "M K"], margins: Float[np.ndarray, "M"], penalty: float, active: Bool[np.ndarray, "R"]
) -> Float[np.ndarray, "K1"]:
    """(w, v) of 10.6 if the `active` rows hold with equality: an interior point comes near, this is exact.

    With v = margins_0 - better_0 w of the first active row the objective is |w - penalty/2 better_0|^2 + a constant.
    """
    used, wanted = better[active[: len(better)]], margins[active[: len(better)]]
    if active[len(better) :].any() or len(used) == 0:  # v = 0
        return np.append(_nearest_with_equality(used, wanted, np.zeros(better.shape[1])), 0.0)
    weights = _nearest_with_equality(used[1:] - used[0], wanted[1:] - wanted[0], 0.5 * penalty * used[0])
    return np.append(weights, wanted[0] - used[0] @ weights)


def _nearest_with_equality(
    rows: Float[np.ndarray, "R K"], bound: Float[np.ndarray, "R"], centre: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """The point nearest to `centre` of those with rows x = bound."""
    return centre + np.linalg.lstsq(rows, bound - rows @ centre, rcond=None)[0] if len(rows) else centre


def _optimal(
    rows: Float[np.ndarray, "R N"],
    bound: Float[np.ndarray, "R"],
    slope: Float[np.ndarray, "N"],
    reached: Float[np.ndarray, "R"],
    active: Bool[np.ndarray, "R"],
) -> bool:
    """Whether all rows hold and the objective's `slope` is a sum of `active` rows with multipliers that are >= 0."""
    holds = (reached - bound).min() >= -OPTIMAL * max(1.0, float(np.abs(bound).max()))
    if not active.any():
        return bool(holds) and not slope.any()
    _, missing = nnls(rows[active].T, slope)
    return bool(holds and missing <= OPTIMAL * max(1.0, float(np.abs(slope).max())))
