"""Who acts in the rollouts of a round: the mixture of Algorithm 1, or a gate in the coin's place.

A gate is made anew in each round, for the policies of the round before and from the recordings so far: its thresholds
let about a share `gate_share` of the states of the last round call the expert.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lfd.core.episode import Episode
from lfd.core.protocols import BatchPolicy
from lfd.loops.dagger_recipe import LoopRecipes
from lfd.policies.acting import AskedOnce
from lfd.record.episode_file import episode_of
from lfd.record.mcap_file import read_mcap
from lfd.run.control import MixturePolicy
from lfd.run.gate_ensemble import EnsembleGate
from lfd.run.gate_judge import JudgeTraining, features
from lfd.run.gate_safety import SafeGate, fit_safety
from lfd.run.gate_thrifty import Experience, ThriftyGate, fit_risk, thresholds_for
from lfd.run.gates import Ensemble, Gate, GatedPolicy, budget_threshold, disagreement
from lfd.run.trial import EvalRecipe, Trial
from lfd.worlds.robosuite_world import RobosuiteWorld


def learner_of(policy: Path, tried: EvalRecipe, worlds: Sequence[RobosuiteWorld]) -> BatchPolicy:
    """A policy folder, acting in the worlds."""
    return AskedOnce(Trial.of(policy, tried).learned(worlds))


def who_acts(
    recipes: LoopRecipes,
    beta: float,
    expert: BatchPolicy,
    learners: Sequence[BatchPolicy],
    recordings: Sequence[Sequence[Path]],
    names: Sequence[str],
) -> BatchPolicy:
    """pi_i; `recordings` are those of each round so far, from which a gate is made.

    `names` are those of the action's components, by which the learner's proposals go on record.
    """
    recipe, learner = recipes.dagger, Ensemble(learners)
    if recipe.gate == "none":
        one = learners[0] if len(learners) == 1 else learner
        return MixturePolicy(expert, one, beta, per=recipe.per, names=names)
    convert = recipes.source.convert()
    channels = (*convert.state, *convert.environment_state)
    visits = [[visit(learner, file, channels) for file in files] for files in recordings]
    gate = GATE_MAKERS[recipe.gate](recipes, visits, channels)
    return GatedPolicy(expert, learner, gate, names=names)


@dataclass(frozen=True)
class Visit:
    """A recorded episode, and what the members would do now in its states."""

    episode: Episode
    states: Float[np.ndarray, "T1 Do"]
    proposals: Float[np.ndarray, "T1 M Da"]

    @property
    def doubts(self) -> Float[np.ndarray, "T"]:
        """How far the members are apart in each state in which one acted."""
        return np.array([disagreement(actions) for actions in self.proposals[:-1]])


def visit(learner: Ensemble, recording: Path, channels: Sequence[str]) -> Visit:
    """Go through a recording in its order, as policies with a memory need it."""
    episode = episode_of(read_mcap(recording), recording, with_states=False)
    learner.reset(0, np.random.default_rng(0))
    states, proposals = [], []
    for step in range(len(episode) + 1):
        observation = {name: rows[step] for name, rows in episode.observations.items()}
        states.append(features(observation, channels))
        proposals.append(learner.propose([0], [observation])[0])
    return Visit(episode, np.array(states), np.array(proposals))


Visits = Sequence[Sequence[Visit]]
"""The visits of each round."""


def _ensemble(recipes: LoopRecipes, visits: Visits, channels: Sequence[str]) -> Gate:
    del channels  # it looks at actions alone
    doubts = np.concatenate([each.doubts for each in visits[-1]])
    doubt = budget_threshold(doubts, recipes.dagger.gate_share)
    return EnsembleGate(doubt=doubt, discrepancy=recipes.dagger.gate_distance or None)


def _safe(recipes: LoopRecipes, visits: Visits, channels: Sequence[str]) -> Gate:
    states, proposals, labels = _labelled(visits)
    share, distances = recipes.dagger.gate_share, np.linalg.norm(proposals - labels, axis=1)
    tau = budget_threshold(distances, share)  # with a fixed one all states are unsafe at first, and safe in the end
    judge = fit_safety(states, proposals, labels, tau=tau, how=_judge_training(recipes))
    unsafe = judge.of(np.concatenate([each.states[:-1] for each in visits[-1]]))
    return SafeGate(judge=judge, channels=channels, threshold=budget_threshold(unsafe, share))


def _thrifty(recipes: LoopRecipes, visits: Visits, channels: Sequence[str]) -> Gate:
    every = [each for of_round in visits for each in of_round]
    experience = Experience(
        states=np.concatenate([each.states[:-1] for each in every]),
        actions=np.concatenate([each.episode.actions for each in every]),
        next_states=np.concatenate([each.states[1:] for each in every]),
        next_actions=np.concatenate([each.proposals[1:].mean(axis=1) for each in every]),
        solved=np.concatenate([each.episode.successes for each in every]),
        ended=np.concatenate([np.arange(len(each.episode)) == len(each.episode) - 1 for each in every]),
    )
    judge = fit_risk(experience, discount=recipes.dagger.gate_discount, how=_judge_training(recipes))
    last = visits[-1]
    rows = [np.hstack([each.states[:-1], each.proposals[:-1].mean(axis=1)]) for each in last]
    _, proposals, labels = _labelled(visits)
    thresholds = thresholds_for(
        recipes.dagger.gate_share,
        np.concatenate([each.doubts for each in last]),
        1.0 - judge.of(np.concatenate(rows)),
        np.linalg.norm(proposals - labels, axis=1),
    )
    return ThriftyGate(judge, channels, thresholds)


GATE_MAKERS = {"ensemble": _ensemble, "safe": _safe, "thrifty": _thrifty}


def _labelled(
    visits: Visits,
) -> tuple[Float[np.ndarray, "L Do"], Float[np.ndarray, "L Da"], Float[np.ndarray, "L Da"]]:
    """The states in which the expert was asked, what the learner would do there, and what the expert would."""
    states, proposals, labels = [], [], []
    for each in (each for of_round in visits for each in of_round):
        if each.episode.expert_actions is None:
            continue
        asked = each.episode.labelled
        states.append(each.states[:-1][asked])
        proposals.append(each.proposals[:-1][asked].mean(axis=1))
        labels.append(each.episode.expert_actions[asked])
    return np.concatenate(states), np.concatenate(proposals), np.concatenate(labels)


def _judge_training(recipes: LoopRecipes) -> JudgeTraining:
    seed = recipes.dagger.seed
    return JudgeTraining(steps=1000, batch_size=256, learning_rate=1e-3, hidden=(64, 64), seed=seed)
