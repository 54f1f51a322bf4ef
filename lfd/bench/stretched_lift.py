"""Compounding error on Lift: the same task, made longer by a slower expert.

An expert at a fraction of its speed takes more control steps for the same motion. At each speed a policy is cloned from
demonstrations without noise, and another comes from DAgger, which spends half of these labels on demonstrations and
half on the learner's own episodes. Then both run from starts of their own until the cube has been lifted, or for
`ROOM` times as long as a demonstration, with the expert asked in every state, and pay

    c_t = 1 where |pi_hat(x_t) - pi*(x_t)| > TAU, else 0,

the theorem's 0-1 loss under the learner's own distribution of states, with a tolerance for a continuous action.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lfd.convert.to_lerobot import convert
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import Table, load_toml
from lfd.experts.registry import make_expert
from lfd.loops.dagger import dagger
from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES, LoopRecipes
from lfd.loops.dagger_round import counts_of
from lfd.policies.acting import AskedOnce, LearnedPolicy
from lfd.record.demonstrations import record
from lfd.record.mcap_file import SUFFIX
from lfd.run.control import MixturePolicy, label_of
from lfd.run.gates import Transitions, discrepancy
from lfd.train.behavior_cloning import train
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.rollout import OneEach, Start, episode_rng, rollouts

TAU = 0.5
"""Distance from the expert's action beyond which a step is an error; the gripper alone makes 2."""
ROOM = 2.0
"""Longest episode, as a multiple of a demonstration's mean length."""
ROUNDS = 5
"""Rounds of DAgger, the demonstrations' included."""
RECIPES = Path("policies/dagger_lift.toml"), Path("datasets/lift_panda.toml")


@dataclass(frozen=True, kw_only=True)
class Side:
    """How one learner did at one speed, over all seeds."""

    labels: int
    """Labels that a policy was trained on, mean of the seeds."""
    costs: tuple[float, ...]
    """Mean number of errors in an episode, of each seed."""
    solved: int
    """Episodes in which the cube was lifted."""

    @property
    def cost(self) -> float:
        """Mean number of errors in an episode."""
        return float(np.mean(self.costs))


@dataclass(frozen=True, kw_only=True)
class Stretched:
    """What one speed of the expert gave."""

    speed: float
    length: float
    """Mean length of a demonstration [control steps]."""
    episodes: int
    """Episodes of each learner."""
    cloned: Side
    dagger: Side


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all speeds share."""

    robot: str
    control_hz: int
    demonstrations: int
    """Demonstrations that a policy is cloned from."""
    episodes: int
    """Episodes of each policy."""
    gradient_steps: int
    """Gradient steps of each policy."""

    def recipes(self, speed: float, seed: int, **dagger_keys: Any) -> LoopRecipes:
        """The recipes of this repository, for one speed and seed."""
        learn, data = load_toml(RECIPES[0], LEARN_TABLES), load_toml(RECIPES[1], DATA_TABLES)
        record_: Table = data["record"] | {"robot": self.robot, "control_hz": self.control_hz, "seed": seed}
        record_ |= {"action_noise": 0.0, "expert_speed": [speed, speed]}
        record_["max_seconds"] /= speed
        own: Table = learn["dagger"] | {"seed": seed, "rounds": ROUNDS, "episodes_per_round": self.demonstrations}
        own |= {"demonstrations": self.demonstrations, "evaluate": "last"}
        return LoopRecipes.of(
            learn
            | {
                "train": learn["train"] | {"steps": self.gradient_steps, "seed": seed},
                "eval": learn["eval"] | {"episodes": 1},  # the bench has its own
                "dagger": own | dagger_keys,
            },
            data | {"record": record_},
            "lfd bench compounding:",
        )


@dataclass(frozen=True)
class _Pair:
    """Both learners of one speed and seed: labels, errors in an episode, and episodes solved."""

    length: float
    cloned: tuple[int, float, int]
    dagger: tuple[int, float, int]


def bench_lift(
    setting: Setting, *, speeds: Sequence[float], seeds: Sequence[int], progress: Progress = silent
) -> list[Stretched]:
    """Clone and aggregate at each of some speeds, over some seeds."""
    found = []
    world = make_world("Lift", setting.robot, setting.control_hz)
    with progress("bench compounding: Lift", len(speeds) * len(seeds)) as bar:
        for speed in speeds:
            pairs = []
            for seed in seeds:
                with TemporaryDirectory() as folder:
                    pairs.append(_compare(setting, world, speed, seed, Path(folder)))
                bar.advance(note=f"{pairs[-1].cloned[1]:.1f} errors cloned, {pairs[-1].dagger[1]:.1f} with DAgger")
            found.append(
                Stretched(
                    speed=speed,
                    length=float(np.mean([pair.length for pair in pairs])),
                    episodes=setting.episodes * len(seeds),
                    cloned=_side([pair.cloned for pair in pairs]),
                    dagger=_side([pair.dagger for pair in pairs]),
                )
            )
    return found


def _side(each: Sequence[tuple[int, float, int]]) -> Side:
    labels, costs, solved = zip(*each, strict=True)
    return Side(labels=round(np.mean(labels)), costs=costs, solved=sum(solved))


def _compare(setting: Setting, world: RobosuiteWorld, speed: float, seed: int, out: Path) -> _Pair:
    """The clone first: DAgger may use no more labels than it had."""
    recipes = setting.recipes(speed, seed)
    record(recipes.record, out / "recordings", tables=recipes.tables, most_worlds=1)
    labels = [counts_of(file).labels for file in sorted((out / "recordings").glob(f"*{SUFFIX}"))]
    convert([out / "recordings"], out / "dataset", recipe=recipes.source)
    train(recipes.policy, recipes.train, out / "dataset", out / "policy", tables=recipes.tables)
    half, length = setting.demonstrations // 2, float(np.mean(labels))
    limits = {
        "demonstrations": half,
        "labels_per_round": -(-sum(labels[half:]) // (ROUNDS - 1)),
        "max_labels": sum(labels),
        "rollout_seconds": length / setting.control_hz,  # a learner that got stuck would use the labels up
    }
    report = dagger(setting.recipes(speed, seed, **limits), out / "dagger", most_worlds=1)
    return _Pair(
        length,
        (sum(labels), *_tried(recipes, world, out / "policy", setting.episodes, round(ROOM * length))),
        (report["labels"], *_tried(recipes, world, out / "dagger" / "policy", setting.episodes, round(ROOM * length))),
    )


def _tried(recipes: LoopRecipes, world: RobosuiteWorld, policy: Path, episodes: int, horizon: int) -> tuple[float, int]:
    """Errors in an episode, and episodes solved, of a policy that acts alone while the expert labels."""
    expert = make_expert(world.spec, recipes.record.style)
    learner = MixturePolicy(OneEach([expert]), AskedOnce(LearnedPolicy(policy, world.spec)), 0.0, per="step")
    kept: Mapping[int, Transitions] = {index: Transitions() for index in range(episodes)}
    starts = (
        Start(index=index, rng=episode_rng("eval", recipes.record.seed, index), observers=[observer])
        for index, observer in kept.items()
    )
    hold_steps = recipes.record.hold_steps
    ended = rollouts([world], learner, lambda: next(starts, None), horizon=horizon, hold_steps=hold_steps)
    solved = sum(outcome.success for _, outcome in ended)
    decisions = [transition.decision for episode in kept.values() for transition in episode.kept]
    errors = sum(discrepancy(decision.action, label_of(decision)) > TAU for decision in decisions)
    return errors / episodes, solved
