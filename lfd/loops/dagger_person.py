"""A person as DAgger's expert (HG-DAgger): they demonstrate the first round, then look after the learner.

In a rollout the learner acts until the person takes over, and again when they hand back (`lfd.run.gate_human`). A step
has a label where the person acts. Each episode begins at their word, and runs in real time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.errors import InputError
from lfd.core.protocols import BatchPolicy, Decision, Observation, Observer
from lfd.experts.device import Device
from lfd.experts.teleoperation import TeleopPolicy
from lfd.record.demonstrations import RecordRecipe, numbers_in
from lfd.record.session import Session, Sitting, Status, View, record_session
from lfd.run.gate_human import HumanGate
from lfd.run.gates import Ensemble, GatedPolicy
from lfd.worlds.robosuite_world import RobosuiteWorld
from lfd.worlds.robots import load_teleop
from lfd.worlds.rollout import OneEach

QUIT = "you quit before the round was over: what is recorded is kept, --resume goes on"


@dataclass(frozen=True, kw_only=True)
class Person:
    """Who sits there: their device, what they see, and how they are told."""

    device: Device
    view: View | None
    status: Status
    demonstrates: bool = True
    """Whether the first round is theirs; else the scripted expert demonstrates."""

    def demonstrate(self, recipe: RecordRecipe, out: Path, *, tables: Mapping[str, Any], resume: bool) -> None:
        """The first round: demonstrations until `recipe.episodes` succeeded, those that are there among them.

        Raises `InputError` when the person quits before.
        """
        there = len(numbers_in(out, "$")) if resume else 0
        left = replace(recipe, episodes=recipe.episodes - there)
        done = record_session(
            left,
            out,
            self.device,
            tables=tables,
            view=self.view,
            status=self.status,
            resume=resume,
            overwrite=not resume,
        )
        if done.successes < left.episodes:
            raise InputError(QUIT)

    def look_after(
        self,
        learners: Sequence[BatchPolicy],
        world: RobosuiteWorld,
        generator: Callable[[int], np.random.Generator],
        recorder: Callable[[int], Observer],
        *,
        first: int,
        wanted: int,
        horizon: int,
        hold_steps: int,
        rest_seconds: float,
        longer: str,
    ) -> Session:
        """Rollouts of the learner in the person's care, from number `first` on, until `wanted` are recorded.

        `horizon` and `hold_steps` are control steps of a rollout and of a success; the learner acts again after
        `rest_seconds` of rest [s]. `longer` is what to type for longer rollouts. There are fewer when the person quits.
        """
        teleop = load_teleop(world.spec.robot)
        rest = round(rest_seconds * world.spec.control_hz)
        gate = HumanGate(self.device, dead_band=teleop.dead_band, quiet_steps=rest)
        names = world.spec.labels["action"]
        hand = OneEach([TeleopPolicy(gate, world.spec, teleop)])
        sitting = Sitting(
            world=world,
            device=self.device,
            policy=_Alone(GatedPolicy(hand, Ensemble(learners), gate, names=names)),
            said=lambda: gate.word,
            generator=generator,
            recorder=recorder,
            wanted=wanted,
            counted=lambda session: session.successes + session.failures,
            view=self.view,
            status=self.status,
            horizon=horizon,
            hold_steps=hold_steps,
            longer=longer,
        )
        return sitting.run(first)


class _Alone:
    """A policy for many worlds, in one."""

    def __init__(self, policy: BatchPolicy):
        self.name, self._policy = policy.name, policy

    def reset(self, rng: np.random.Generator) -> None:
        self._policy.reset(0, rng)

    def act(self, observation: Observation) -> Decision:
        (decision,) = self._policy.act([0], [observation])
        return decision
