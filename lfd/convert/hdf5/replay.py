"""A demonstration of simulator states as an episode: each state is shown to the simulator and observed.

A file has T states, each before one of T actions; an episode has T + 1 observations. Row T is where the last action
leads from the last state, as the simulator here computes it. (robosuite recorded that state too, and left it out.)
Efforts are in no file: they are those of the controls with which the simulator got from the state before near to the
present one.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.convert.hdf5.demo_file import SKIP, Demo, DemoFile
from lfd.convert.hdf5.demo_setting import setting_of
from lfd.convert.hdf5.demo_start import DemoStart, start_of
from lfd.core.artifact import versions
from lfd.core.episode import Episode, EpisodeMetadata
from lfd.core.errors import EpisodeError
from lfd.core.protocols import Observation, StepResult, Transition, World
from lfd.experts.playback import PlaybackPolicy
from lfd.worlds.robosuite_world import RobosuiteWorld, kept_world
from lfd.worlds.rollout import rollout


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """How far the simulator here is from the one that recorded a demonstration."""

    one_step_qpos: float
    """Largest difference in any position after executing one action from a recorded state [rad or m]."""
    one_step_ee_m: float
    """The same of the end effectors' positions [m]."""
    open_loop_ee_m: float
    """Largest distance of an end effector after executing all actions from the first state [m]."""
    solved_by_states: bool
    """Whether the recorded states solve the task at some step."""
    solved_by_actions: bool
    """Whether executing all actions from the first state does."""
    model: str
    """Which model was used: the recorded one, or today's and what of the recorded one it took over."""
    model_ee_m: float | None
    """Largest distance of a grip site between the recorded model and the one used, over all states [m]."""
    model_objects_m: float | None
    """The same of everything but robots [m]; both are None where the file has no model."""
    clipped: int
    """Actions beyond the controller's limits, which robosuite clips; the episode has them clipped."""
    controller: str
    """What of the recorded controller differs from the one that executed the actions; empty if nothing."""


@dataclass(frozen=True)
class Replayed:
    """A demonstration that went through the simulator."""

    episode: Episode
    deviation: Deviation


def replay_demo(file: DemoFile, demo: Demo) -> Replayed:
    """Show a demonstration's states to robosuite, and measure how far its actions lead away from them.

    Raises `EpisodeError` for states or a model that do not fit the task, naming file and demonstration, and
    `UnknownName` for an environment, robot or controller that lfd does not know.
    """
    setting = setting_of(file, demo)
    config = replace(setting.robot, controller=setting.controller)
    world = kept_world(setting.task, setting.robot_name, config, setting.control_hz)
    try:
        actions = _clipped(world, demo)
        start = start_of(world, demo, actions)
    except EpisodeError as error:
        raise EpisodeError(f"{file.path} {demo.name}: {error}; {SKIP}") from error
    shown, one_step_qpos, one_step_ee = _show(start, actions)
    episode = _episode(file, demo, start, actions, shown)
    away, solved = _open_loop(start, episode)
    deviation = Deviation(
        one_step_qpos=one_step_qpos,
        one_step_ee_m=one_step_ee,
        open_loop_ee_m=away,
        solved_by_states=bool(episode.successes.any()),
        solved_by_actions=solved,
        model=start.model,
        model_ee_m=start.model_ee_m,
        model_objects_m=start.model_objects_m,
        clipped=int((actions != demo.actions).any(axis=1).sum()),
        controller=setting.controller_differs,
    )
    return Replayed(episode, deviation)


def _clipped(world: RobosuiteWorld, demo: Demo) -> Float[np.ndarray, "T Da"]:
    low, high = world.spec.action_low, world.spec.action_high
    if demo.actions.shape[1] != len(low):
        names = ", ".join(world.spec.labels["action"])
        raise EpisodeError(
            f"'actions' has {demo.actions.shape[1]} components, {world.spec.controller} of {world.spec.robot} takes "
            f"{len(low)}: {names}"
        )
    return np.clip(demo.actions, low, high)


def _show(start: DemoStart, actions: np.ndarray) -> tuple[list[tuple[StepResult, np.ndarray]], float, float]:
    """What each of the T + 1 states shows, and how far one action from each leads from the next [rad or m, m]."""
    world, states = start.world, start.states
    world.set_state(start.state)
    shown = [(world.show(states[0]), world.sim_state())]
    hands = [name for name in world.layout if name.endswith("ee_pos")]
    nq = start.positions
    qpos_away = ee_away = 0.0
    for t, action in enumerate(actions):
        result = world.step(action)
        if t + 1 == len(states):
            shown.append((result, world.sim_state()))
            break
        reached = world.sim_state()[1 : 1 + nq]  # mjSTATE_INTEGRATION begins with time and qpos
        qpos_away = max(qpos_away, float(np.abs(reached - states[t + 1, 1 : 1 + nq]).max()))
        there = {name: result.observation[name].copy() for name in hands}
        shown.append((world.show(states[t + 1]), world.sim_state()))
        now = shown[-1][0].observation
        ee_away = max(ee_away, *(float(np.linalg.norm(there[name] - now[name])) for name in hands))
    return shown, qpos_away, ee_away


class _Hands:
    """Watches the end effectors and success."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    def begin(self, world: World, observation: Observation) -> None:
        self.rows, self.solved = [self._positions(observation)], False

    def step(self, world: World, transition: Transition) -> None:
        self.rows.append(self._positions(transition.result.observation))
        self.solved |= transition.result.success

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""

    def _positions(self, observation: Observation) -> np.ndarray:
        return np.array([observation[name] for name in self._names])


def _open_loop(start: DemoStart, episode: Episode) -> tuple[float, bool]:
    """Execute all actions from the first state: how far the end effectors go from the recorded path [m], solved?"""
    names = [name for name in episode.observations if name.endswith("ee_pos")]
    hands = _Hands(names)
    rollout(
        start.world,
        PlaybackPolicy(episode.actions),
        [hands],
        np.random.default_rng(0),
        horizon=len(episode),
        hold_steps=len(episode) + 1,
        start=start.state,
    )
    path = np.stack([episode.observations[name] for name in names], axis=1)
    reached = np.array(hands.rows)  # shorter where the physics became unstable
    return float(np.linalg.norm(reached - path[: len(reached)], axis=2).max()), hands.solved


def _episode(
    file: DemoFile,
    demo: Demo,
    start: DemoStart,
    actions: np.ndarray,
    shown: list[tuple[StepResult, np.ndarray]],
) -> Episode:
    spec = start.world.spec
    results = [result for result, _ in shown]
    origin: dict[str, Any] = {
        "file": file.path.name,
        "demo": demo.name,
        "env_name": file.env_name,
        "robots": list(file.robots),
        "controller_configs": dict(file.controllers),
    }
    about = EpisodeMetadata(
        task=spec.task,
        instruction=spec.instruction,
        robot=spec.robot,
        controller=spec.controller,
        policy="human",
        control_hz=spec.control_hz,
        stage="record",
        seed=0,
        index=file.demos.index(demo.name),
        stepper=spec.stepper,
        started=file.made,
        versions={**versions(), "robosuite": file.version or "unknown", "mujoco": "unknown", "numpy": "unknown"},
        recipe={"hdf5": origin},
    )
    return Episode(
        times=np.arange(len(shown)) / spec.control_hz,
        observations={
            name: np.array([result.observation[name] for result in results]) for name in spec.labels if name != "action"
        },
        actions=actions,
        rewards=np.array([result.reward for result in results[1:]]),
        successes=np.array([result.success for result in results[1:]]),
        interventions=np.zeros(len(actions), dtype=bool),
        sim_states=np.array([sim for _, sim in shown]),
        labels=dict(spec.labels),
        metadata=about,
        model_xml=start.state.model_xml,
        start_memory=start.state.memory,
    )
