"""Exact replay: execute a recording's actions again from its first state and compare every state."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfd.core.artifact import versions
from lfd.core.episode import Episode
from lfd.core.errors import RecordingError
from lfd.core.protocols import Observation, Policy, Transition, World, WorldState
from lfd.experts.playback import PlaybackPolicy
from lfd.experts.pushing import PushedArm, RecordedPerson
from lfd.interaction.scenes import SCENES
from lfd.record.episode_file import read_episode, recording_in
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.rollout import rollout

DECISIVE = ("mujoco", "robosuite", "numpy")
"""Libraries whose version decides the last bits of a simulation."""


@dataclass(frozen=True, kw_only=True)
class Verification:
    """How far a replay went from its recording."""

    steps: int
    deviation: float
    """Largest absolute difference in MuJoCo's integration state over all steps; 0 means bit-identical."""
    first_step: int | None
    """First step whose state differs."""
    stepper: str
    differences: tuple[str, ...]
    """What of the recording's stepper and versions differs here."""


class _States:
    """Collects the simulation's states."""

    def begin(self, world: World, observation: Observation) -> None:
        self.rows = [world.sim_state()]

    def step(self, world: World, transition: Transition) -> None:
        self.rows.append(world.sim_state())

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""


def verify_replay(source: Path, index: int = 0) -> Verification:
    """Replay the recording `source`, or number `index` of a folder, and compare.

    Raises `RecordingError` for a file that cannot be read.
    """
    return verify_episode(read_episode(recording_in(source, index)))


def verify_episode(episode: Episode) -> Verification:
    """Replay an episode in the world that its metadata name.

    Raises `RecordingError` when it has no states to start from.
    """
    about = episode.metadata
    if episode.sim_states is None or episode.start_memory is None:
        raise RecordingError("the episode has no simulation states; only recordings of lfd can be replayed exactly")
    world, policy = _world_of(episode), PlaybackPolicy(episode.actions)
    start = WorldState(model_xml=episode.model_xml, sim=episode.sim_states[0], memory=episode.start_memory)
    states = _States()
    rollout(
        world,
        policy if not isinstance(world, RobosuiteWorld) else _pushed(policy, world, episode),
        [states],
        np.random.default_rng(0),
        horizon=len(episode),
        hold_steps=len(episode) + 1,
        start=start,
    )
    away = np.abs(np.array(states.rows) - episode.sim_states).max(axis=1)
    here = {**versions(), "stepper": world.spec.stepper}
    there = {**about.versions, "stepper": about.stepper}
    names = ("stepper", *DECISIVE)
    return Verification(
        steps=len(episode),
        deviation=float(away.max()),
        first_step=int(np.argmax(away > 0)) if away.any() else None,
        stepper=about.stepper,
        differences=tuple(f"{n}: recorded with {there[n]}, here {here[n]}" for n in names if there[n] != here[n]),
    )


def _world_of(episode: Episode) -> World:
    """The world that an episode was recorded in."""
    about = episode.metadata
    if about.task in SCENES:
        return SCENES[about.task].world("random", about.control_hz, about.recipe["interact"]["rationality"])
    return make_world(about.task, about.robot, about.control_hz, about.stepper, controller=about.controller)


def _pushed(policy: Policy, world: RobosuiteWorld, episode: Episode) -> Policy:
    """The policy, with the pushes that are on record."""
    push = episode.signals.get("push")
    if push is None:
        return policy
    return PushedArm(policy, RecordedPerson("recorded", push.times, push.values), world, np.inf)
