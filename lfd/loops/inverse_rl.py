"""Inverse RL on arms: weights of features from demonstrations in scenes, by three methods of chapter 10.4.

The methods are those of `lfd.reward_learning`; here they meet the trajectory planner. With z(tau) the counts of a
trajectory divided by their ranges over the candidates, the planner's prior among them, and the mean taken over scenes:

    apprenticeship   Algorithm 2: v separates mean z_E from the plans so far by most, (10.5); plan for v; repeat
    margin           (10.6): min |v|^2 + C slack with the margin m(tau_E, tau); the loss-augmented plan joins; repeat
    maxent           max_v sum_E (v.z_E - log sum_{candidates} exp(v.z)) - l2/2 |v|^2; the plan for v joins; repeat

The scale of v is free in the first two and the demonstrator's rationality in the third. The planner's prior fixes it:
its weight is known, so v is divided by its component there, and w_k = v_k / range_k lambda range_prior / v_prior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BytesIO

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Progress, silent
from lfd.loops.arm_candidates import Candidates, ranges_of
from lfd.loops.arm_evidence import SAME, Evidence
from lfd.reward_learning.apprenticeship import apprenticeship
from lfd.reward_learning.ascent import maximise
from lfd.reward_learning.identifiable import identifiable_from_counts
from lfd.reward_learning.margin_loop import max_margin_planning_loop
from lfd.reward_learning.weight_belief import updated
from lfd.rewards.factors import GaussianFactor, check_features
from lfd.rewards.reward_artifact import Change, LinearReward

COUNT = 60
"""Random candidates about the straight way and about each demonstration."""
LEAST_PRIOR = 0.02
"""Least share of |v| that the prior's component counts as: without any, plans would have no scale."""
ITERATIONS = 40
"""Most plans in each scene."""
CERTAIN = 1e-4
"""Margin at which apprenticeship ends, in units of the ranges. It certifies a mixture of plans; the best single plan is
much farther away, and comes nearer as the loop goes on."""
TOLERANCE = 2e-3
"""Violation at which margin planning ends [rad^2]."""
SLACK_WEIGHT = 1e4
"""C of (10.6)."""
L2 = 1e-4
"""Of maximum entropy, which has no finite weights where demonstrations are optimal."""
TOLD = 1e-6
"""Component of a feature in the directions that nothing tells, up to which its weight is identifiable."""
SETTLED = 1e-6
"""By how much plans beat the candidates so far when maximum entropy ends, as a share of |v|."""


@dataclass(frozen=True)
class Learned:
    """What a method found, in units of the ranges."""

    weights: Float[np.ndarray, "K1"]
    """v, the prior's last."""
    curve: tuple[str, Float[np.ndarray, "iterations"]]
    """What shrinks as the method converges, with its name."""
    measures: dict[str, float] = field(default_factory=dict)
    covariance: Float[np.ndarray, "K1 K1"] | None = None


class Problem:
    """Scenes with their demonstrations and candidates, in units of the ranges."""

    def __init__(self, evidence: Evidence, features: Sequence[str], *, seed: int, progress: Progress = silent):
        """Raises `UnknownName` for a feature that lfd does not know, `InputError` for one that never varies."""
        rng = np.random.default_rng([2, seed])
        self.features, self.smoothness = tuple(features), evidence.recipe.smoothness
        self.scenes: list[Candidates] = []
        with progress("candidates", len(evidence.scenes)) as bar:
            for placement, demonstrations in evidence.scenes:
                planner = evidence.planner(placement, features)
                self.scenes.append(Candidates(planner, demonstrations, count=COUNT, rng=rng))
                bar.advance()
        self.ranges = ranges_of(self.scenes)
        for name, spread in zip(self.features, self.ranges, strict=False):
            if spread == 0:
                raise InputError(f"{name} is the same for all candidates: nothing tells its weight; leave it out")

    @property
    def expert(self) -> Float[np.ndarray, "K1"]:
        """Mean z of the demonstrations."""
        return np.mean([scene.expert for scene in self.scenes], axis=0) / self.ranges

    @property
    def straight(self) -> Float[np.ndarray, "K1"]:
        """Mean z of the straight ways."""
        return np.mean([scene.straight for scene in self.scenes], axis=0) / self.ranges

    def weights(self, v: Float[np.ndarray, "K1"]) -> Float[np.ndarray, "K"]:
        """w for v, by the prior's known weight."""
        prior = max(float(v[-1]), LEAST_PRIOR * float(np.linalg.norm(v)))
        return v[:-1] / self.ranges[:-1] * (self.smoothness * self.ranges[-1] / prior)

    def plan(self, v: Float[np.ndarray, "K1"]) -> list[int]:
        """The best candidate of each scene for v, after a plan has joined."""
        return [scene.plan(self.weights(v), self.smoothness, starts=1, rng=None) for scene in self.scenes]

    def best(self, v: Float[np.ndarray, "K1"]) -> list[int]:
        """The best candidate of each scene for v, as they are."""
        return [int(np.argmax(scene.counts @ (v / self.ranges))) for scene in self.scenes]

    def mean(self, chosen: Sequence[int]) -> Float[np.ndarray, "K1"]:
        """Mean z of a candidate of each scene."""
        return np.mean([s.counts[i] for s, i in zip(self.scenes, chosen, strict=True)], axis=0) / self.ranges


def by_apprenticeship(problem: Problem) -> Learned:
    """The weights whose plans come nearest to the demonstrations in features."""
    found = apprenticeship(
        problem.expert,
        lambda v: problem.mean(problem.plan(v)),
        initial=problem.straight,
        tolerance=CERTAIN,
        max_iterations=ITERATIONS,
    )
    planned = np.array(found.planned_for).reshape(-1, len(problem.ranges))
    away = np.linalg.norm(found.mus[1 : 1 + len(planned)] - problem.expert, axis=1)
    away[planned[:, -1] <= LEAST_PRIOR * np.linalg.norm(planned, axis=1)] = np.inf  # such weights have no scale
    smoothest = np.linalg.norm(problem.straight - problem.expert)
    weights, distance = np.append(np.zeros(len(problem.features)), 1.0), float(smoothest)  # of the straight way
    if len(away) and away.min() < smoothest:
        weights, distance = planned[int(away.argmin())], float(away.min())
    measures = {"margin": float(found.margins[-1]), "distance_of_best": distance}
    return Learned(weights, ("margin", found.margins), measures)


def by_margin(problem: Problem) -> Learned:
    """The smallest weights for which the demonstrations beat all else by a margin that grows with the distance."""

    def plan(v: Float[np.ndarray, "K1"]) -> tuple[Float[np.ndarray, "K1"], float]:
        if v.any():
            problem.plan(v)
        losses = [scene.differences() for scene in problem.scenes]
        chosen = [
            int(np.argmax(scene.counts @ (v / problem.ranges) + loss))
            for scene, loss in zip(problem.scenes, losses, strict=True)
        ]
        return problem.mean(chosen), float(np.mean([loss[i] for loss, i in zip(losses, chosen, strict=True)]))

    found = max_margin_planning_loop(
        problem.expert, plan, slack_weight=SLACK_WEIGHT, tolerance=TOLERANCE, max_iterations=ITERATIONS
    )
    measures = {"slack": found.slack, "violation": float(found.violations[-1])}
    return Learned(found.weights, ("violation", found.violations[1:]), measures)


def by_maxent(problem: Problem) -> Learned:
    """The most likely weights where trajectories are chosen with probabilities proportional to exp(v.z)."""
    v, gains = np.zeros(len(problem.ranges)), []
    while True:
        found = maximise(scene_softmax(problem), v, tolerance=1e-8, max_iterations=1000)
        v = found.point
        before = problem.mean(problem.best(v)) @ v
        gains.append(float(problem.mean(problem.plan(v)) @ v - before) / float(np.linalg.norm(v)))
        if gains[-1] <= SETTLED or len(gains) == ITERATIONS:
            break
    value = found.value + 0.5 * L2 * float(v @ v)
    return Learned(v, ("gain of plans", np.array(gains)), {"log_likelihood": value}, _covariance(problem, v))


def scene_softmax(problem: Problem) -> Callable[[Float[np.ndarray, "K1"]], tuple[float, Float[np.ndarray, "K1"]]]:
    """sum_E (v.z_E - log sum_j exp(v.z_j)) - l2/2 |v|^2 and its slope; j are the candidates of E's scene."""
    tables = [(scene.counts / problem.ranges, scene.demonstrated) for scene in problem.scenes]

    def objective(v: Float[np.ndarray, "K1"]) -> tuple[float, Float[np.ndarray, "K1"]]:
        value, slope = -0.5 * L2 * float(v @ v), -L2 * v
        for z, shown in tables:
            shares, total = _shares(z @ v)
            value += float((z[:shown] @ v).sum()) - shown * total
            slope = slope + z[:shown].sum(axis=0) - shown * (shares @ z)
        return value, slope

    return objective


def _shares(logits: Float[np.ndarray, "M"]) -> tuple[Float[np.ndarray, "M"], float]:
    """Probabilities, and the logarithm of what they were divided by."""
    largest = logits.max()
    total = float(largest + np.log(np.exp(logits - largest).sum()))
    return np.exp(logits - total), total


def _covariance(problem: Problem, v: Float[np.ndarray, "K1"]) -> Float[np.ndarray, "K1 K1"]:
    """Inverse of minus the objective's Hessian: sum over demonstrations of Cov[z], and l2."""
    information = L2 * np.eye(len(v))
    for scene in problem.scenes:
        z = scene.counts / problem.ranges
        shares, _ = _shares(z @ v)
        away = z - shares @ z
        information += scene.demonstrated * (away * shares[:, None]).T @ away
    return np.linalg.inv(information)


METHODS: dict[str, Callable[[Problem], Learned]] = {
    "apprenticeship": by_apprenticeship,
    "margin": by_margin,
    "maxent": by_maxent,
}


def identifiable(problem: Problem) -> list[bool]:
    """For each feature whether differences between candidates of a scene tell its weight apart from all others'."""
    away = np.concatenate([scene.counts - scene.counts.mean(axis=0) for scene in problem.scenes]) / problem.ranges
    hidden = identifiable_from_counts(away).unidentified
    return [bool((np.abs(hidden[:, k]) <= TOLD).all()) for k in range(len(problem.features))]


def learn(problem: Problem, method: str, evidence: Evidence) -> tuple[LinearReward, Learned]:
    """The reward that a method finds. Raises `UnknownName` for a method that lfd does not know."""
    if method not in METHODS:
        raise UnknownName("method", method, METHODS)
    found = METHODS[method](problem)
    weights = problem.weights(found.weights)
    covariance = _of_weights(problem, found)
    factor = None if covariance is None else GaussianFactor.about(weights, covariance)
    recipe, words = evidence.recipe, f"{len(evidence.demonstrations)} demonstrations, {method}"
    return LinearReward(
        features=problem.features,
        weights=weights,
        ranges=problem.ranges[:-1].copy(),
        robot=recipe.robot,
        waypoints=recipe.waypoints,
        duration_s=recipe.duration_s,
        smoothness=recipe.smoothness,
        method=method,
        measures=found.measures,
        covariance=covariance,
        history=(Change(words, (), tuple(map(float, weights)), factor),),
    ), found


def joined(old: LinearReward, learned: LinearReward) -> LinearReward:
    """A reward after demonstrations that another one was learned from, by maximum entropy.

    Raises `InputError` for another arm, other features or settings of the planner, and where demonstrations did not
    tell the weights well enough to be evidence.
    """
    check_features(learned.features, old.features, "what is to be learned")
    for key in SAME:
        if getattr(old, key) != getattr(learned, key):
            raise InputError(
                f"the demonstrations were planned with {key} = {getattr(learned, key)}, the reward with "
                f"{getattr(old, key)}; weights are comparable only for the same arm and planner"
            )
    change = learned.history[0]
    if change.factor is None:
        raise InputError(
            f"{change.evidence}: these tell no spread of the weights, so that they cannot be joined with other "
            "evidence; give more of them, or leave out --reward"
        )
    return updated(old, change.factor, change.evidence)


def _of_weights(problem: Problem, found: Learned) -> Float[np.ndarray, "K K"] | None:
    """Covariance of w from that of v: w_k = c_k v_k / v_prior, to first order."""
    v = found.weights
    if found.covariance is None or v[-1] <= LEAST_PRIOR * np.linalg.norm(v):
        return None
    weights = problem.weights(v)
    slope = np.column_stack([np.diag(weights / v[:-1]), -weights / v[-1]])
    return slope @ found.covariance @ slope.T


def convergence_picture(found: Learned, method: str) -> bytes:
    """How what should shrink did, iteration by iteration, as PNG."""
    from matplotlib.figure import Figure

    name, values = found.curve
    axes = (figure := Figure(figsize=(6, 3.5), layout="constrained")).subplots()
    axes.plot(np.arange(1, len(values) + 1), values, "o-", markersize=3)
    if (values > 0).all():
        axes.set_yscale("log")
    axes.set(xlabel="iteration", ylabel=f"{name} [ranges]", title=method)
    axes.grid(alpha=0.3)
    figure.savefig(file := BytesIO(), dpi=120, format="png")
    return file.getvalue()
