"""Gates: step by step, something other than a coin decides whether the learner or its expert acts.

A `Gate` rules on each step from what the learners propose; `GatedPolicy` carries the ruling out. The kinds of gate
stand in `gate_human`, `gate_ensemble`, `gate_thrifty` and `gate_safety`; what they cost the expert is `Counts`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.core.protocols import BatchPolicy, Decision, Observation, Transition, Verdict, World
from lfd.run.control import label_of, on_record

MEASURED = "gate"
"""Channel of what a gate measured."""


class Ensemble:
    """M learners of the same task as one policy, whose action is the mean of theirs; one learner is an ensemble, too.

    The mean is that of EnsembleDAgger and ThriftyDAgger. Members that were trained on the same demonstrations with
    other initial weights seldom differ as two experts do; where they do, the gates call the expert.
    """

    def __init__(self, members: Sequence[BatchPolicy]):
        self.name = members[0].name
        self._members = members

    def reset(self, place: int, rng: np.random.Generator) -> None:
        for member, generator in zip(self._members, rng.spawn(len(self._members)), strict=True):
            member.reset(place, generator)

    def propose(self, places: Sequence[int], observations: Sequence[Observation]) -> Float[np.ndarray, "N M Da"]:
        """What each member would do in each of N worlds."""
        asked = [member.act(places, observations) for member in self._members]
        return np.array([[decision.action for decision in each] for each in zip(*asked, strict=True)])

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        return [Decision(actions.mean(axis=0)) for actions in self.propose(places, observations)]


@dataclass(frozen=True)
class Moment:
    """What a gate may know when it rules on a step."""

    observation: Observation
    proposals: Float[np.ndarray, "M Da"]
    """The learners' actions."""
    ask: Callable[[], Float[np.ndarray, "Da"]]
    """The expert's label in this state. Asking costs the expert a label, once however often it is called."""

    @property
    def action(self) -> Float[np.ndarray, "Da"]:
        """What the learner would do: the mean of the proposals."""
        return self.proposals.mean(axis=0)


@dataclass(frozen=True)
class Ruling:
    """Who acts in a step, and why."""

    expert_acts: bool
    verdict: Verdict | None = None
    """A person's word that ends the episode, whoever acts."""
    measured: Mapping[str, float] = field(default_factory=dict)
    """The numbers that the ruling rests on."""


@runtime_checkable
class Gate(Protocol):
    """Rules who acts."""

    def reset(self, place: int) -> None:
        """Begin an episode in the world number `place`, with the learner in control."""
        ...

    def rule(self, place: int, moment: Moment) -> Ruling: ...


class GatedPolicy:
    """Lets a gate decide, step by step, whether the learner or the expert acts.

    A step has a label (`expert_action`) where the gate asked the expert, and always where the expert acts; in the
    others nobody spent the effort. Where the expert acts, the decision is an intervention. With `names`, the components
    of an action, the learner's action and what the gate measured go on record in `policy_action` and `gate`.
    The expert is asked in some states of an episode only, so it must not count on having seen the others.
    """

    def __init__(self, expert: BatchPolicy, learner: Ensemble, gate: Gate, *, names: Sequence[str] = ()):
        self.name = learner.name
        self._expert, self._learner, self._gate, self._names = expert, learner, gate, tuple(names)

    def reset(self, place: int, rng: np.random.Generator) -> None:
        for_expert, for_learner = rng.spawn(2)
        self._expert.reset(place, for_expert)
        self._learner.reset(place, for_learner)
        self._gate.reset(place)

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        proposed = self._learner.propose(places, observations)
        return [self._decide(*each) for each in zip(places, observations, proposed, strict=True)]

    def _decide(self, place: int, observation: Observation, proposals: Float[np.ndarray, "M Da"]) -> Decision:
        said: list[Decision] = []

        def ask() -> Float[np.ndarray, "Da"]:
            if not said:
                said.extend(self._expert.act([place], [observation]))
            return label_of(said[0])

        moment = Moment(observation, proposals, ask)
        ruling = self._gate.rule(place, moment)
        own = Decision(moment.action)
        signals: dict[str, Mapping[str, float]] = {}
        if self._names:
            signals |= on_record(own, self._names) | ({MEASURED: ruling.measured} if ruling.measured else {})
        if ruling.expert_acts:
            ask()
        if not said:
            return replace(own, verdict=ruling.verdict, signals=signals)
        (meant,) = said
        return Decision(
            meant.action if ruling.expert_acts else own.action,
            expert_action=label_of(meant),
            intervention=ruling.expert_acts,
            verdict=ruling.verdict or meant.verdict,
            signals={**meant.signals, **signals},
        )


@dataclass(frozen=True)
class Counts:
    """What some steps cost the expert."""

    labels: int = 0
    """Steps in which the expert said what it would do."""
    takeovers: int = 0
    """Times that the expert began to act: after a step of the learner's, or at the start of an episode."""
    expert_steps: int = 0
    """Steps in which the expert acted."""
    steps: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(
            self.labels + other.labels,
            self.takeovers + other.takeovers,
            self.expert_steps + other.expert_steps,
            self.steps + other.steps,
        )

    @classmethod
    def of(cls, episode: Iterable[Decision]) -> "Counts":
        """The effort of one episode, from its decisions in their order."""
        decisions = list(episode)
        acted = [False, *(decision.intervention for decision in decisions)]
        return cls(
            labels=sum(decision.expert_action is not None for decision in decisions),
            takeovers=sum(now and not before for before, now in pairwise(acted)),
            expert_steps=sum(acted),
            steps=len(decisions),
        )


class Transitions:
    """An observer that keeps the transitions of one episode, to count and to learn from.

    An episode that was broken off keeps them as well: its labels were given all the same.
    """

    def __init__(self) -> None:
        self.kept: list[Transition] = []

    @property
    def counts(self) -> Counts:
        return Counts.of(transition.decision for transition in self.kept)

    def begin(self, world: World, observation: Observation) -> None: ...

    def step(self, world: World, transition: Transition) -> None:
        self.kept.append(transition)

    def end(self, success: bool) -> None: ...

    def abort(self) -> None: ...


def disagreement(proposals: Float[np.ndarray, "M Da"]) -> float:
    """How far M learners are apart: sqrt(sum_d Var_m a_md), the norm of the components' standard deviations.

    EnsembleDAgger's doubt and the square root of Da times ThriftyDAgger's novelty; 0 for a single learner.
    """
    return float(np.linalg.norm(proposals.std(axis=0)))


def discrepancy(action: Float[np.ndarray, "Da"], other: Float[np.ndarray, "Da"]) -> float:
    """Distance of two actions, |a - a'|."""
    return float(np.linalg.norm(action - other))


def budget_threshold(values: Float[np.ndarray, "N"], budget: float) -> float:
    """The lowest t for which no more than a share `budget` of the values lies above it: their (1 - budget) quantile.

    Without ties exactly floor(budget N) values lie above; with ties at the threshold fewer may. A budget of 1 gives
    -inf: every state is above. Raises `InputError` for a budget beyond [0, 1] or for no values.
    """
    allowed = _allowed(len(values), budget)
    return -np.inf if allowed == len(values) else float(np.sort(values)[::-1][allowed])


def joint_thresholds(
    first: Float[np.ndarray, "N"], second: Float[np.ndarray, "N"], budget: float
) -> tuple[float, float]:
    """The lowest pair of quantiles, of the same level, with no more than a share `budget` of the N states above either.

    Two thresholds at the (1 - budget) quantile each would let up to twice the budget through.
    """
    allowed, best = _allowed(len(first), budget), (np.inf, np.inf)
    for above in range(allowed + 1):
        pair = budget_threshold(first, above / len(first)), budget_threshold(second, above / len(first))
        if np.count_nonzero((first > pair[0]) | (second > pair[1])) > allowed:
            break
        best = pair
    return best


def _allowed(count: int, budget: float) -> int:
    if not 0.0 <= budget <= 1.0:
        raise InputError(f"budget = {budget}: it is the share of steps that the expert may act in, within 0 and 1")
    if count == 0:
        raise InputError("a budget needs states to measure it on: run some episodes of the learner first")
    return int(budget * count + 1e-9)  # 0.3 * 10 rounds to 3, not to 2
