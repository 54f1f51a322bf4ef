from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.core.protocols import Decision, Verdict, WorldSpec
from lfd.experts.device import DeviceState
from lfd.experts.keys import Word
from lfd.experts.teleoperation import TeleopPolicy
from lfd.run.control import label_of
from lfd.run.gate_ensemble import EnsembleGate
from lfd.run.gate_human import HumanGate
from lfd.run.gate_judge import Judge, JudgeTraining
from lfd.run.gate_safety import SafeGate, fit_safety
from lfd.run.gate_thrifty import (
    Experience,
    Thresholds,
    ThriftyGate,
    fit_risk,
    thresholds_for,
)
from lfd.run.gates import (
    Counts,
    Ensemble,
    GatedPolicy,
    Moment,
    Transitions,
    budget_threshold,
    disagreement,
    discrepancy,
    joint_thresholds,
)
from lfd.worlds.robots import TeleopConfig
from lfd.worlds.rollout import OneEach, rollout
from tests.point_mass import SPEC, PointExpert, PointLearner, PointMass

HOW = JudgeTraining(steps=600, batch_size=64, learning_rate=1e-2, hidden=(32,), seed=0)
GAINS = (0.1, 0.3, 0.9)
"""Learners that agree at the origin and differ the more the further they are from it."""
STATES = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 2))


def ensemble() -> Ensemble:
    return Ensemble([OneEach([PointLearner(gain)]) for gain in GAINS])


def gated(gate, *, names=SPEC.labels["action"]) -> tuple[GatedPolicy, PointExpert]:
    expert = PointExpert()
    policy = GatedPolicy(OneEach([expert]), ensemble(), gate, names=names)
    policy.reset(0, np.random.default_rng(0))
    return policy, expert


def decide(policy: GatedPolicy, states=STATES) -> list[Decision]:
    return [policy.act([0], [{"position": state}])[0] for state in states]


def moment(state, label=(0.0, 0.0)) -> Moment:
    learners = ensemble()
    learners.reset(0, np.random.default_rng(0))
    observation = {"position": np.array(state, dtype=float)}
    return Moment(observation, learners.propose([0], [observation])[0], lambda: np.array(label, dtype=float))


# numbers


def test_disagreement_and_discrepancy_by_hand() -> None:
    proposals = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 6.0]])
    variances = [np.mean((column - column.mean()) ** 2) for column in proposals.T]
    assert disagreement(proposals) == pytest.approx(np.sqrt(sum(variances)))
    assert disagreement(proposals[:1]) == 0.0
    assert discrepancy(np.array([1.0, 2.0]), np.array([4.0, 6.0])) == 5.0


@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0]), min_size=1, max_size=30), st.floats(0, 1))
def test_a_budget_is_kept_and_used(values, budget) -> None:
    given_values = np.array(values)
    limit = budget_threshold(given_values, budget)
    share = np.mean(given_values > limit)
    assert share <= budget + 1e-9
    lower = [value for value in {*values, -np.inf} if value < limit]
    assert all(np.mean(given_values > value) > budget for value in lower)


@pytest.mark.parametrize("tenths", range(11))
def test_without_ties_the_share_is_the_budget(tenths) -> None:
    values = np.random.default_rng(1).normal(size=10)
    assert np.mean(values > budget_threshold(values, tenths / 10)) == tenths / 10


@pytest.mark.parametrize("budget", [0.0, 0.1, 0.35, 1.0])
def test_two_thresholds_share_a_budget(budget) -> None:
    first, second = np.random.default_rng(2).normal(size=(2, 40))
    pair = joint_thresholds(first, second, budget)
    shares = []
    for above in range(41):
        limits = [budget_threshold(values, above / 40) for values in (first, second)]
        shares.append(np.mean((first > limits[0]) | (second > limits[1])))
    best = max(share for share in shares if share <= budget)
    assert np.mean((first > pair[0]) | (second > pair[1])) == best


def test_mistakes_in_a_budget() -> None:
    with pytest.raises(InputError, match=r"budget = 1.5: it is the share of steps"):
        budget_threshold(np.zeros(3), 1.5)
    with pytest.raises(InputError, match="run some episodes of the learner first"):
        budget_threshold(np.zeros(0), 0.5)


def test_effort_is_counted_step_by_step() -> None:
    action = np.zeros(2)
    for acts in product([False, True], repeat=5):
        episode = [Decision(action, action if act else None, act) for act in acts]
        text = "".join("E" if act else "L" for act in acts)
        takeovers = len([part for part in text.split("L") if part])
        assert Counts.of(episode) == Counts(sum(acts), takeovers, sum(acts), 5)
    both = Counts.of([Decision(action, action)]) + Counts.of([Decision(action, action, True)])
    assert both == Counts(labels=2, takeovers=1, expert_steps=1, steps=2)


# the ensemble gate


def test_the_expert_acts_in_the_share_of_the_budget() -> None:
    doubts = np.array([disagreement(moment(state).proposals) for state in STATES])
    policy, expert = gated(EnsembleGate(doubt=budget_threshold(doubts, 0.2)))
    decided = decide(policy)
    assert Counts.of(decided).expert_steps == 40
    assert expert.asked == Counts.of(decided).labels == 40  # nobody was asked in vain
    for state, doubt, decision in zip(STATES, doubts, decided, strict=True):
        acts = doubt > np.sort(doubts)[159]
        assert decision.intervention == acts
        assert (decision.expert_action is not None) == acts
        wanted = PointExpert().act({"position": state}).action if acts else moment(state).action
        np.testing.assert_array_equal(decision.action, wanted)
        assert decision.signals["gate"] == {"doubt": doubt}
        assert list(decision.signals["policy_action"].values()) == list(moment(state).action)


def test_with_a_discrepancy_the_expert_is_asked_in_every_step() -> None:
    policy, expert = gated(EnsembleGate(doubt=np.inf, discrepancy=0.6), names=())
    decided = decide(policy)
    away = [np.linalg.norm(moment(state).action - label_of(each)) for state, each in zip(STATES, decided, strict=True)]
    np.testing.assert_array_equal([each.intervention for each in decided], np.array(away) > 0.6)
    assert expert.asked == Counts.of(decided).labels == len(STATES)
    assert 0 < Counts.of(decided).expert_steps < len(STATES)
    assert decided[0].signals == {}


def test_an_ensembles_action_is_the_mean_and_each_member_has_its_own_randomness() -> None:
    noisy = Ensemble([OneEach([PointLearner(0.0, noise=0.1)]) for _ in range(2)])
    noisy.reset(0, np.random.default_rng(0))
    (proposals,) = noisy.propose([0], [{"position": np.ones(2)}])
    assert not np.array_equal(*proposals)
    learners = ensemble()
    learners.reset(0, np.random.default_rng(0))
    (decision,) = learners.act([0], [{"position": np.full(2, 0.1)}])
    np.testing.assert_allclose(decision.action, -np.mean(GAINS) * np.ones(2))


def test_a_gated_rollout_in_the_closed_loop_solves_what_the_learner_does_not() -> None:
    """A learner with a bias settles 0.2 beside the goal; the gate calls the expert for the rest."""
    stray = Ensemble([OneEach([PointLearner(0.5, (1.0, 0.0))])])
    solved, kept = {}, Transitions()
    for name, limit in (("alone", np.inf), ("gated", 0.5)):
        policy = GatedPolicy(OneEach([PointExpert()]), stray, EnsembleGate(doubt=np.inf, discrepancy=limit))
        outcome = rollout(PointMass(), _Single(policy), [kept], np.random.default_rng(4), horizon=60, hold_steps=3)
        solved[name] = outcome.success
    assert solved == {"alone": False, "gated": True}
    assert kept.counts.steps == kept.counts.labels
    assert 0 < kept.counts.expert_steps < kept.counts.steps


class _Single:
    """A policy for many worlds in one."""

    def __init__(self, policy: GatedPolicy):
        self._policy, self.name = policy, policy.name

    def reset(self, rng: np.random.Generator) -> None:
        self._policy.reset(0, rng)

    def act(self, observation) -> Decision:
        return self._policy.act([0], [observation])[0]


# learned gates


def certain(weights: list[float], bias: float) -> Judge:
    """A judge whose log-odds are linear, by hand."""
    judge = Judge(np.zeros((1, len(weights))), ())
    with torch.no_grad():
        judge.layers[0].weight.copy_(torch.tensor([weights]))  # type: ignore[union-attr]
        judge.layers[0].bias.fill_(bias)  # type: ignore[union-attr]
    return judge


def test_a_safety_judge_learns_where_the_learner_strays() -> None:
    labels = -STATES
    proposals = labels + np.where(STATES[:, :1] > 0.2, 0.5, 0.01)
    judge = fit_safety(STATES, proposals, labels, tau=0.1, how=HOW)
    others = np.random.default_rng(8).uniform(-1, 1, (1000, 2))
    assert np.mean((judge.of(others) > 0.5) == (others[:, 0] > 0.2)) > 0.95
    with pytest.raises(InputError, match="all 200 states are unsafe with tau = 0.001; distances from the expert lie"):
        fit_safety(STATES, proposals, labels, tau=0.001, how=HOW)


def test_the_same_seed_trains_the_same_judge_and_leaves_torchs_own_randomness_alone() -> None:
    proposals = STATES * 2
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    first, second = (fit_safety(STATES, proposals, STATES, tau=0.5, how=HOW) for _ in range(2))
    np.testing.assert_array_equal(first.of(STATES), second.of(STATES))
    assert torch.rand(1) == expected


def test_the_safety_gate_keeps_to_its_budget_and_asks_nobody_else() -> None:
    judge = certain([3.0, 0.0], 0.0)
    answers = judge.of(STATES)
    policy, expert = gated(SafeGate(judge=judge, channels=["position"], threshold=budget_threshold(answers, 0.25)))
    counts = Counts.of(decide(policy))
    assert (counts.expert_steps, counts.labels, expert.asked) == (50, 50, 50)


def test_risk_is_the_discounted_probability_of_success() -> None:
    """A walk on 0 ... 6 that goes right with probability 0.6, solved at 6, failed at 0: the linear system's answer."""
    discount, right, inner = 0.9, 0.6, range(1, 6)
    system, goal = np.eye(5), np.zeros(5)
    for row, place in enumerate(inner):
        for to, chance in ((place + 1, right), (place - 1, 1 - right)):
            if to == 6:
                goal[row] += chance
            elif to != 0:
                system[row, to - 1] -= discount * chance
    exact = np.linalg.solve(system, goal)
    rng = np.random.default_rng(0)
    at = rng.integers(1, 6, 20_000)
    to = np.where(rng.random(len(at)) < right, at + 1, at - 1)
    experience = Experience(
        states=np.eye(7)[at],
        actions=np.zeros((len(at), 1)),
        next_states=np.eye(7)[to],
        next_actions=np.zeros((len(at), 1)),
        solved=to == 6,
        ended=to == 0,
    )
    how = JudgeTraining(steps=2000, batch_size=256, learning_rate=1e-2, hidden=(16,), seed=0)
    judge = fit_risk(experience, discount=discount, how=how)
    found = judge.of(np.hstack([np.eye(7)[1:6], np.zeros((5, 1))]))
    np.testing.assert_allclose(found, exact, atol=0.04)


def test_risk_learned_from_rollouts_tells_far_from_near() -> None:
    steps = []
    for seed in range(40):
        episode = Transitions()
        rollout(PointMass(), PointLearner(0.5), [episode], np.random.default_rng(seed), horizon=30, hold_steps=1)
        steps += episode.kept
    after = np.array([step.result.observation["position"] for step in steps])
    experience = Experience(
        states=np.array([step.observation["position"] for step in steps]),
        actions=np.array([step.decision.action for step in steps]),
        next_states=after,
        next_actions=np.clip(-5 * after, -1, 1),
        solved=np.array([step.result.success for step in steps]),
        ended=np.array([step.done for step in steps]),
    )
    judge = fit_risk(experience, discount=0.9, how=HOW)
    rows = [np.append(position, np.clip(-5 * position, -1, 1)) for position in (np.full(2, 0.15), np.full(2, 0.9))]
    near, far = judge.of(np.array(rows))
    assert near > far + 0.2


def test_mistakes_in_learning_risk() -> None:
    nothing = np.zeros((3, 1))
    flags = np.zeros(3, dtype=bool)
    experience = Experience(
        states=nothing, actions=nothing, next_states=nothing, next_actions=nothing, solved=flags, ended=flags
    )
    with pytest.raises(InputError, match="no step of the experience solved the task"):
        fit_risk(experience, discount=0.9, how=HOW)
    with pytest.raises(InputError, match=r"discount = 0.0: must be above 0"):
        fit_risk(experience, discount=0.0, how=HOW)


def test_the_thrifty_gate_takes_over_in_the_share_of_the_budget() -> None:
    judge = certain([2.0, 1.0, 0.0, 0.0], 0.0)
    free = Thresholds(novelty=np.inf, risk=np.inf, agreement=0.0, calm=-np.inf)
    measured = [each.signals["gate"] for each in decide(gated(ThriftyGate(judge, ["position"], free))[0])]
    novelties, risks = (np.array([each[key] for each in measured]) for key in ("novelty", "risk"))
    thresholds = thresholds_for(0.2, novelties, risks, np.array([0.3, 0.4]))
    assert thresholds.agreement == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert thresholds.calm == np.median(risks)
    took = 0
    for state in STATES:
        policy, expert = gated(ThriftyGate(judge, ["position"], thresholds))  # each state as the first of an episode
        took += decide(policy, state[None])[0].intervention
        assert expert.asked <= 1
    share = took / len(STATES)
    assert 0.2 - 0.02 <= share <= 0.2


def test_control_goes_back_only_where_both_agree_and_risk_is_low() -> None:
    """Every history of two measurements against the rule, written out: hysteresis."""
    limits = Thresholds(novelty=np.inf, risk=0.8, agreement=0.1, calm=0.4)
    judge = certain([1.0, 0.0, 0.0, 0.0], 0.0)  # Q = 1 / (1 + exp(-x))
    risks, agreements = (0.2, 0.6, 0.9), (True, False)
    for history in product(product(risks, agreements), repeat=3):
        gate, expert_controls = ThriftyGate(judge, ["position"], limits), False
        gate.reset(0)
        for risk, agrees in history:
            state = [np.log((1 - risk) / risk), 0.0]
            own = moment(state).action
            ruling = gate.rule(0, moment(state, label=own if agrees else own + 1.0))
            acts = expert_controls or risk > limits.risk
            assert ruling.measured["risk"] == pytest.approx(risk, abs=1e-6)
            assert ruling.expert_acts == acts
            expert_controls = acts and not (agrees and risk < limits.calm)


# a person


OSC = WorldSpec(
    task="Lift",
    instruction="lift the cube",
    robot="panda",
    controller="OSC_POSE",
    control_hz=20,
    labels={"ee_quat": ("w", "x", "y", "z"), "action": ("x", "y", "z", "rx", "ry", "rz", "gripper")},
    action_low=-np.ones(7),
    action_high=np.ones(7),
    stepper="plain",
)
HAND = TeleopConfig(frame="base", position_gain=1.0, rotation_gain=1.0, dead_band=0.1)


class Scripted:
    """A device that says one state after another."""

    name = "scripted"

    def __init__(self, *states: DeviceState):
        self._states = iter(states)

    def read(self) -> DeviceState:
        return next(self._states)


class Closed:
    """A learner that lifts, its gripper closed."""

    name = "closed"

    def reset(self, place: int, rng: np.random.Generator) -> None: ...

    def act(self, places, observations) -> list[Decision]:
        return [Decision(np.array([0, 0, 0.3, 0, 0, 0, 1.0])) for _ in places]


def said(push: float = 0.0, *words: Word) -> DeviceState:
    return DeviceState(translation=np.array([push, 0.0, 0.0]), rotation=np.zeros(3), words=words)


def beside_a_person(*states: DeviceState, quiet_steps: int) -> tuple[list[Decision], HumanGate]:
    gate = HumanGate(Scripted(*states), dead_band=HAND.dead_band, quiet_steps=quiet_steps)
    policy = GatedPolicy(OneEach([TeleopPolicy(gate, OSC, HAND)]), Ensemble([Closed()]), gate)
    policy.reset(0, np.random.default_rng(0))
    seen = {"ee_quat": np.array([0.0, 1.0, 0.0, 0.0])}
    return [policy.act([0], [seen])[0] for _ in states], gate


def acts(decided: list[Decision]) -> str:
    return "".join("P" if each.intervention else "r" for each in decided)


def test_a_person_takes_over_by_moving_and_hands_back_by_resting() -> None:
    states = [said(), said(0.05), said(0.55), said(1.0), said(), said(), said(), said(0.5)]
    decided, _ = beside_a_person(*states, quiet_steps=2)
    assert acts(decided) == "rrPPPrrP"
    for each in decided:
        assert (each.expert_action is not None) == each.intervention  # no label but where the person acts
    np.testing.assert_allclose(decided[2].action, [0.5, 0, 0, 0, 0, 0, 1.0])  # the gripper stays closed
    np.testing.assert_array_equal(decided[2].action, label_of(decided[2]))
    assert Counts.of(decided) == Counts(labels=4, takeovers=2, expert_steps=4, steps=8)


def test_a_person_takes_over_and_hands_back_by_words() -> None:
    states = [said(), said(0, Word.TAKE_OVER), said(), said(), said(0, Word.HAND_BACK), said()]
    decided, _ = beside_a_person(*states, quiet_steps=0)
    assert acts(decided) == "rPPPrr"


def test_after_the_word_a_device_must_come_to_rest_before_it_takes_over() -> None:
    states = [said(1.0), said(1.0, Word.HAND_BACK), said(1.0), said(1.0), said(), said(1.0)]
    assert acts(beside_a_person(*states, quiet_steps=0)[0]) == "PrrrrP"
    states[3] = said(1.0, Word.TAKE_OVER)
    assert acts(beside_a_person(*states, quiet_steps=0)[0]) == "PrrPPP"


def test_the_grippers_word_takes_over_and_toggles_what_the_learner_had() -> None:
    states = [said(), said(0, Word.GRIPPER), said(), said(0, Word.GRIPPER), said(0, Word.HAND_BACK), said(1.0)]
    decided, _ = beside_a_person(*states, quiet_steps=0)
    assert acts(decided) == "rPPPrP"
    assert [each.action[-1] for each in decided] == [1, -1, -1, 1, 1, 1]


@pytest.mark.parametrize("who", [(), (Word.TAKE_OVER,)])
def test_words_end_the_episode_whoever_acts(who) -> None:
    decided, gate = beside_a_person(said(0, *who), said(0, Word.SUCCESS, Word.QUIT), quiet_steps=0)
    assert [each.verdict for each in decided] == [None, Verdict.SUCCESS]
    assert gate.word is Word.SUCCESS
    assert decided[1].intervention == bool(who)  # a word about the episode is no action


def test_a_person_looks_after_one_world() -> None:
    with pytest.raises(InputError, match="run a human gate with most_worlds=1"):
        HumanGate(Scripted(), dead_band=0.1, quiet_steps=0).reset(1)
