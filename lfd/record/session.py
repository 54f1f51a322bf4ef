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

from lfd.core.artifact import check_output
from lfd.core.protocols import Observation, Observer, Progress, Transition, World, WorldState, silent
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
    return _Sitting(recipe, out, used, world, device, policy, view, status).run(first)


class _Sitting:
    """A session while it goes on."""

    def __init__(
        self,
        recipe: RecordRecipe,
        out: Path,
        used: Mapping[str, Any],
        world: World,
        device: Device,
        policy: TeleopPolicy,
        view: View | None,
        status: Status,
    ):
        self._recipe, self._out, self._used, self._world = recipe, out, used, world
        self._device, self._policy, self._view, self._status = device, policy, view, status
        self._paced, self._session = Paced(policy, recipe.control_hz), Session()

    def run(self, index: int) -> Session:
        session, said = self._session, ""
        start = self._draw(index)
        while session.successes < self._recipe.episodes and self._started(index, said):
            outcome = self._episode(index, start)
            word = self._policy.word
            said = self._count(outcome, word)
            if word is Word.QUIT:
                break
            if word is Word.REDO:
                self._world.set_state(start)
                self._show()
            elif session.successes < self._recipe.episodes:
                index += 1
                start = self._draw(index)
        session.pace = asdict(self._paced.summary())
        return session

    def _draw(self, index: int) -> WorldState:
        """Bring the world to start state number `index`, before the person starts, so that they see it."""
        self._world.reset(episode_rng(STAGE, self._recipe.seed, index))
        self._show()
        return self._world.get_state()

    def _show(self) -> None:
        if self._view is not None:
            self._view.show(self._world)

    def _started(self, index: int, said: str) -> bool:
        """Wait for the person's start; whether they did not quit instead."""
        while True:
            self._status(f"episode {index}: waiting", f"{said}{self._kept()}  {WAITING}")
            words = self._device.read().words
            if Word.START in words or Word.QUIT in words:
                return Word.QUIT not in words
            time.sleep(1.0 / self._recipe.control_hz)

    def _episode(self, index: int, start: WorldState) -> Outcome:
        recipe = self._recipe
        recorder = make_recorder(
            self._out, self._used, policy=self._policy.name, seed=recipe.seed, attempt=index, keep_failures=True
        )
        watching = [self._view] if self._view is not None else []
        return rollout(
            self._world,
            self._paced,
            [recorder, *watching, _Clock(index, recipe, self._status)],
            episode_rng(STAGE, recipe.seed, index),
            horizon=recipe.horizon,
            hold_steps=recipe.hold_steps,
            start=start,
        )

    def _count(self, outcome: Outcome, word: Word | None) -> str:
        """Count an episode; what to tell the person about it."""
        session = self._session
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
            return f"failure: {self._recipe.max_seconds:g} s are over; --set record.max_seconds=60 gives more.  "
        return f"failure{outcome.failure and f': {outcome.failure}'}.  "

    def _kept(self) -> str:
        return f"{self._session.successes} of {self._recipe.episodes} recorded, {self._session.failures} failures"


class _Clock:
    """Tells the person how long an episode has lasted."""

    def __init__(self, index: int, recipe: RecordRecipe, status: Status):
        self._index, self._recipe, self._status = index, recipe, status

    def begin(self, world: World, observation: Observation) -> None:
        """The first step follows at once."""

    def step(self, world: World, transition: Transition) -> None:
        gone = (transition.step + 1) / self._recipe.control_hz
        self._status(f"episode {self._index}: moving", f"{gone:4.1f} of {self._recipe.max_seconds:g} s  {ACTING}")

    def end(self, success: bool) -> None:
        """The session tells how it ended."""

    def abort(self) -> None:
        """The session tells that it was not kept."""
