"""A person's recording session: start, move, say how it went, again.

    waiting --start--> moving --success, failure--> kept, next start state
                              --discard-----------> nothing kept, next start state
                              --redo--------------> nothing kept, the same start state
    quit ends the session; an episode that is under way is not kept

Each episode runs in the one closed loop with the recorder that scripted experts have. It is whole on the disk
before the next one begins. Episodes have the numbers of their start states, after those that the folder holds.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lfd.core.artifact import check_output
from lfd.core.protocols import Observation, Observer, Policy, Progress, Transition, World, WorldState, silent
from lfd.core.recipe import as_table
from lfd.experts.device import Device
from lfd.experts.keys import ACTING, WAITING, Word
from lfd.experts.teleoperation import TeleopPolicy
from lfd.record.demonstrations import (
    STAGE,
    RecordRecipe,
    attempts_in,
    begin_recordings,
    make_recorder,
    numbers_in,
    take_cameras,
)
from lfd.record.pacing import Paced
from lfd.worlds.robosuite_world import make_worlds
from lfd.worlds.robots import load_robot, load_teleop
from lfd.worlds.rollout import Outcome, episode_rng, rollout
from lfd.worlds.tasks import load_task

Status = Callable[[str, str], None]
"""Shows the person a state, such as `episode 3: waiting`, and what goes with it."""
SAME = ("task", "robot", "control_hz", "seed", "cameras")
"""Keys of the recipe that must not change when a session goes on in the same folder."""


class View(Observer, Protocol):
    """What the person sees of the world."""

    def show(self, world: World) -> None:
        """Show a world that stands at a start."""
        ...


@dataclass
class Session:
    """What became of the episodes of a session."""

    successes: int = 0
    failures: int = 0
    """Kept, and marked as failures."""
    discarded: int = 0
    redone: int = 0
    steps: int = 0
    """Control steps of all episodes."""
    pace: Mapping[str, Any] | None = None
    """How well real time was kept (`lfd.record.pacing.Pace`)."""


def record_session(
    recipe: RecordRecipe,
    out: Path,
    device: Device,
    *,
    tables: Mapping[str, Any],
    view: View | None = None,
    status: Status,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Session:
    """Record demonstrations of the person at `device` into `out`, until `recipe.episodes` succeeded or they quit.

    An episode also ends as a success when the task has been solved for `recipe.hold_seconds`, and as a failure after
    `recipe.max_seconds`. `tables` is the whole recipe file. With `resume` episodes are added to those in `out`.

    Raises `OutputError` when `out` holds something already, or when `resume` does not fit what it holds.
    """
    teleop = load_teleop(recipe.robot)  # names that are unknown show before anything is touched
    load_robot(recipe.robot)
    load_task(recipe.task)
    used = {**tables, "record": as_table(recipe), "teleop": as_table(teleop)}
    first = 0
    if resume:
        attempts_in(out, recipe, SAME)
        first = max(numbers_in(out, ""), default=-1) + 1  # after what a crash left, too
    if not resume:
        check_output(out, overwrite=overwrite)
    (world,) = make_worlds(recipe.task, recipe.robot, recipe.control_hz, most=1, progress=progress)
    take_cameras(world, recipe)
    policy = TeleopPolicy(device, world.spec, teleop)
    if not resume:
        begin_recordings(out, used, recipe.seed)

    def recorder(index: int) -> Observer:
        return make_recorder(out, used, policy=policy.name, seed=recipe.seed, attempt=index, keep_failures=True)

    sitting = Sitting(
        world=world,
        device=device,
        policy=policy,
        said=lambda: policy.word,
        generator=lambda index: episode_rng(STAGE, recipe.seed, index),
        recorder=recorder,
        wanted=recipe.episodes,
        counted=lambda session: session.successes,
        view=view,
        status=status,
        horizon=recipe.horizon,
        hold_steps=recipe.hold_steps,
        longer="--set record.max_seconds=60",
    )
    return sitting.run(first)


def started(device: Device, show: Callable[[], None], hz: int) -> bool:
    """Wait for the person's start, asked for at `hz` [Hz] after each `show`; whether they did not quit instead."""
    while True:
        show()
        words = device.read().words
        if Word.START in words or Word.QUIT in words:
            return Word.QUIT not in words
        time.sleep(1.0 / hz)


@dataclass(frozen=True, kw_only=True)
class Sitting:
    """A person at a robot: what they sit before, and what becomes of their episodes."""

    world: World
    device: Device
    policy: Policy
    """What acts: the person, or somebody whom they look after."""
    said: Callable[[], Word | None]
    """What the person said to end the last episode."""
    generator: Callable[[int], np.random.Generator]
    """Start states: that of the episode with a number."""
    recorder: Callable[[int], Observer]
    """Keeps the episode with a number."""
    wanted: int
    """Episodes after which the sitting ends."""
    counted: Callable[[Session], int]
    """Which of the episodes so far count."""
    view: View | None
    status: Status
    horizon: int
    """Control steps after which an episode ends."""
    hold_steps: int
    longer: str
    """What to type for longer episodes."""

    def run(self, index: int) -> Session:
        """Episodes from number `index` on, until none is wanted or the person quits."""
        session, said = Session(), ""
        paced = Paced(self.policy, self.world.spec.control_hz)
        start = self._draw(index)
        while self._goes_on(session) and self._started(index, said + self._kept(session)):
            outcome, word = self._episode(paced, index, start), self.said()
            said = self._count(session, outcome, word)
            if word is Word.QUIT:
                break
            if word is Word.REDO:
                self.world.set_state(start)
                self._show()
            elif self._goes_on(session):
                index += 1
                start = self._draw(index)
        session.pace = asdict(paced.summary())
        return session

    def _draw(self, index: int) -> WorldState:
        """Bring the world to start state number `index`, before the person starts, so that they see it."""
        self.world.reset(self.generator(index))
        self._show()
        return self.world.get_state()

    def _show(self) -> None:
        if self.view is not None:
            self.view.show(self.world)

    def _started(self, index: int, told: str) -> bool:
        """Wait for the person's start; whether they did not quit instead."""

        def show() -> None:
            self.status(f"episode {index}: waiting", f"{told}  {WAITING}")

        return started(self.device, show, self.world.spec.control_hz)

    def _episode(self, paced: Paced, index: int, start: WorldState) -> Outcome:
        watching = [self.view] if self.view is not None else []
        clock = _Clock(index, self.world.spec.control_hz, self.horizon, self.status)
        return rollout(
            self.world,
            paced,
            [self.recorder(index), *watching, clock],
            self.generator(index),
            horizon=self.horizon,
            hold_steps=self.hold_steps,
            start=start,
        )

    def _count(self, session: Session, outcome: Outcome, word: Word | None) -> str:
        """Count an episode; what to tell the person about it."""
        session.steps += outcome.steps
        if word is Word.REDO:
            session.redone += 1
            return "again.  "
        if word in (Word.DISCARD, Word.QUIT):
            session.discarded += 1
            return "discarded.  "
        if outcome.success:
            session.successes += 1
            return "success.  "
        session.failures += 1
        if word is None and not outcome.failure:
            seconds = self.horizon / self.world.spec.control_hz
            return f"failure: {seconds:g} s are over; {self.longer} gives more.  "
        return f"failure{outcome.failure and f': {outcome.failure}'}.  "

    def _kept(self, session: Session) -> str:
        return f"{self.counted(session)} of {self.wanted} recorded, {session.failures} failures"

    def _goes_on(self, session: Session) -> bool:
        return self.counted(session) < self.wanted


class _Clock:
    """Tells the person how long an episode has lasted."""

    def __init__(self, index: int, control_hz: int, horizon: int, status: Status):
        self._index, self._hz, self._horizon, self._status = index, control_hz, horizon, status

    def begin(self, world: World, observation: Observation) -> None:
        """The first step follows at once."""

    def step(self, world: World, transition: Transition) -> None:
        gone, most = (transition.step + 1) / self._hz, self._horizon / self._hz
        self._status(f"episode {self._index}: moving", f"{gone:4.1f} of {most:g} s  {ACTING}")

    def end(self, success: bool) -> None:
        """The session tells how it ended."""

    def abort(self) -> None:
        """The session tells that it was not kept."""
