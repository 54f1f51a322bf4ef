"""Who acts while an expert is at hand: DAgger's mixture of expert and learner (chapter 10.3, Algorithm 1).

    pi_i = beta_i pi* + (1 - beta_i) pi_hat_i

is a mixture of distributions: with probability beta_i the action is the expert's, else it is the learner's (Ross,
Gordon, Bagnell 2011, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning",
Algorithm 3.1). Adding the two actions with these weights would be another policy: half-way between passing an
obstacle on the left and on the right stands the obstacle.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import BatchPolicy, Decision, Observation

SCHEDULES = {
    "first": "the expert acts in the first round, the learner in all others",
    "exponential": "beta_i = rate^i, which is 1 in the first round",
    "linear": "from 1 in the first round to 0 in the last",
}
PER = {"step": "a coin in every step", "episode": "a coin for the whole episode"}
PROPOSAL = "policy_action"
"""Channel of what the learner proposed."""


def beta_schedule(kind: str, rounds: int, *, rate: float) -> tuple[float, ...]:
    """beta_i, the probability that the expert acts, for the rounds i = 0, 1, ... `rounds` - 1.

        first          1, 0, 0, ...
        exponential    rate^i
        linear         1 - i / (rounds - 1)

    Each begins with 1: before the first round there is no learner. The no-regret guarantee asks that the mean of the
    betas goes to 0 as rounds grow, which holds for `first` and for `exponential` with a rate below 1, not for `linear`
    (its mean is 1/2; the last rounds act well all the same). Only `exponential` reads `rate`.

    Raises `UnknownName` for another kind, `InputError` for fewer than one round or a rate beyond [0, 1].
    """
    if kind not in SCHEDULES:
        raise UnknownName("beta schedule", kind, SCHEDULES)
    if rounds < 1:
        raise InputError(f"rounds = {rounds}: DAgger needs at least 1 round")
    if kind == "exponential":
        if not 0.0 <= rate <= 1.0:
            raise InputError(f"rate = {rate}: beta is a probability, its rate must lie within 0 and 1")
        return tuple(float(rate) ** i for i in range(rounds))
    if kind == "linear":
        return tuple(1.0 - i / max(rounds - 1, 1) for i in range(rounds))
    return (1.0,) + (0.0,) * (rounds - 1)


def label_of(decision: Decision) -> Float[np.ndarray, "Da"]:
    """What an expert means by a decision: its label where what it applies differs (noise), else the action."""
    return decision.action if decision.expert_action is None else decision.expert_action


class MixturePolicy:
    """Lets the expert act with probability `beta`, else the learner; the label is the expert's in every state.

    `per` says for how long a coin counts: a step, as in Algorithm 1, or a whole episode. Both are asked in every state
    and draw from generators of their own, so that neither's memory nor randomness depends on the coin. Where the expert
    acts, the decision is an intervention. With `names`, the components of an action, the learner's proposal goes on
    record in the channel `policy_action`. Experts that act one by one come as `lfd.worlds.rollout.OneEach`.

    Raises `InputError` for a beta beyond [0, 1], `UnknownName` for another `per`.
    """

    def __init__(self, expert: BatchPolicy, learner: BatchPolicy, beta: float, *, per: str, names: Sequence[str] = ()):
        if not 0.0 <= beta <= 1.0:
            raise InputError(f"beta = {beta}: it is the probability that the expert acts, within 0 and 1")
        if per not in PER:
            raise UnknownName("length of a coin", per, PER)
        self.name = learner.name
        self._expert, self._learner = expert, learner
        self._beta, self._per, self._names = beta, per, tuple(names)
        self._coins: dict[int, np.random.Generator] = {}
        self._expert_acts: dict[int, bool] = {}

    def reset(self, place: int, rng: np.random.Generator) -> None:
        coin, for_expert, for_learner = rng.spawn(3)
        self._expert.reset(place, for_expert)
        self._learner.reset(place, for_learner)
        self._coins[place] = coin
        self._toss(place)

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        meant = self._expert.act(places, observations)
        proposed = self._learner.act(places, observations)
        return [self._decide(*each) for each in zip(places, meant, proposed, strict=True)]

    def _decide(self, place: int, meant: Decision, proposed: Decision) -> Decision:
        acts = self._expert_acts[place]
        if self._per == "step":
            self._toss(place)
        signals = {**proposed.signals, **meant.signals, **on_record(proposed, self._names)}
        return replace(
            meant,
            action=meant.action if acts else proposed.action,
            expert_action=label_of(meant),
            intervention=acts,
            signals=signals,
        )

    def _toss(self, place: int) -> None:
        self._expert_acts[place] = bool(self._coins[place].random() < self._beta)


def on_record(proposed: Decision, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """The signal that keeps what a learner proposed, by the names of an action's components; none without names."""
    return {PROPOSAL: dict(zip(names, proposed.action.tolist(), strict=True))} if names else {}
