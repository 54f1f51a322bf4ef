"""What comes of corrections: pictures of the weights, pushes of recordings again, datasets of what was learned."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.convert.to_lerobot import convert
from lfd.core.artifact import new_folder
from lfd.core.errors import InputError, LfdError
from lfd.core.protocols import Observation, Progress, Transition, Verdict, World, silent
from lfd.core.recipe import as_table
from lfd.experts.device import Device
from lfd.experts.impedance import Reference
from lfd.experts.keys import WAITING
from lfd.experts.pose_follower import PoseFollower, hand_poses
from lfd.experts.pushing import NAMES, RecordedPerson
from lfd.loops.correcting import CorrectionRecipe, set_up
from lfd.loops.plan_demonstrations import TASK, deviate, stand
from lfd.record.demonstrations import begin_recordings, make_recorder
from lfd.record.episode_file import read_episode
from lfd.record.session import Status, View, started
from lfd.rewards.reward_artifact import LinearReward
from lfd.worlds.cameras import load_model
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.rollout import rollout

SHOWN_HZ = 20
"""How often a person sees the world, and control steps a second of demonstrations [Hz]."""
CONVERT = {
    "state": ["joint_pos", "gripper_pos", "ee_pos", "ee_quat"],
    "environment_state": ["cube_pos"],
    "action": "action",
    "failures": False,
}
"""How these become a dataset. (The cube stands aside; LeRobot's policies want something of an environment.)"""
DEMONSTRATION_STREAM = 10
"""Part of the seeds of demonstrations of what was learned."""
DEVIATION_RAD = 0.05
"""Standard deviation of each joint of such a demonstration in the middle of its way [rad]."""


class Watching:
    """An observer that lets a person see the arm while they push it, and has it stand until they say start."""

    def __init__(self, view: View | None, status: Status, device: Device):
        self._view, self._status, self._device = view, status, device

    def begin(self, world: World, observation: Observation) -> None:
        self._every = max(1, round(world.spec.control_hz / SHOWN_HZ))
        if self._view is not None:
            self._view.show(world)
        if not started(self._device, lambda: self._status("waiting", WAITING), world.spec.control_hz):
            raise LfdError("you quit before the arm went, and nothing was kept; begin again with fewer --runs")

    def step(self, world: World, transition: Transition) -> None:
        if transition.step % self._every == 0:
            if self._view is not None:
                self._view.show(world)
            weights = transition.decision.signals["weights"]
            told = ", ".join(f"{name} {weight:.2f}" for name, weight in weights.items())
            self._status(f"{transition.step / world.spec.control_hz:4.1f} s", told)

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""


class Nobody:
    """A person who does not push."""

    name = "nobody"

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        return np.zeros(6)

    def verdict(self) -> Verdict | None:
        return None


def recorded_person(path: Path) -> RecordedPerson:
    """Whoever pushed in a recording. Raises `InputError` for one in which nobody could, and what reading it raises."""
    if not path.is_file():
        raise InputError(
            f"no recording {path}: --person takes scripted, device, console, or a recording of `lfd correct`"
        )
    signal = read_episode(path).signals.get("push")
    if signal is None or signal.names != NAMES:
        raise InputError(f"nobody pushes in {path}; `lfd correct TASK --out DIR` records pushes")
    return RecordedPerson(f"pushes of {path.name}", signal.times, signal.values)


def demonstrate_learned(
    recipe: CorrectionRecipe,
    reward: LinearReward,
    out: Path,
    count: int,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """A LeRobot dataset of `count` ways with a reward in the scene of the corrections; recordings beside it.

    They deviate smoothly from the plan, and are carried out by the robot config's own controller at 20 Hz, so that
    policies can be trained on them. Raises `LfdError` where too many deviations touch something.
    """
    setup, recordings = set_up(recipe), out.with_name(f"{out.name}_recordings")
    plan = setup.planner.plan(reward.weights, rng=np.random.default_rng([DEMONSTRATION_STREAM, recipe.seed]))
    world = make_world(TASK, recipe.robot, SHOWN_HZ)
    used = {"correct": as_table(recipe), "scene": setup.placement.table(), "convert": CONVERT}
    with new_folder(recordings, overwrite=overwrite) as part, progress("demonstrate", count) as bar:
        begin_recordings(part, used, recipe.seed)
        for number in range(count):
            rng = np.random.default_rng([DEMONSTRATION_STREAM, recipe.seed, number])
            way = deviate(setup.planner, plan.trajectory, DEVIATION_RAD, rng)
            times = np.arange(round(recipe.duration_s * SHOWN_HZ)) / SHOWN_HZ
            world.reset(rng)
            start = stand(world, way[0])
            poses = hand_poses(
                load_model(start.model_xml), world.spec.labels["joint_pos"], Reference(way, plan.dt_s).positions(times)
            )
            follower = PoseFollower(world.spec, poses)
            record = make_recorder(
                part, used, policy=follower.name, seed=recipe.seed, attempt=number, keep_failures=True
            )
            rollout(world, follower, [record], rng, horizon=follower.steps, hold_steps=follower.steps + 1, start=start)
            bar.advance()
    done = convert([recordings], out, overwrite=overwrite, progress=progress)
    return {"out": str(out), "episodes": done.episodes, "frames": done.frames, "failed": done.left_out}


def weights_picture(weights: list[Float[np.ndarray, "K"]], reward: LinearReward) -> bytes:
    """The weights before and after each push, in units of the features' ranges, as PNG."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(6, 3.5), layout="constrained")).subplots()
    axes.plot(range(len(weights)), np.array(weights) * reward.ranges, "o-", markersize=4, label=list(reward.features))
    axes.set(xlabel="pushes", ylabel="weight times range", xticks=range(len(weights)))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(file := BytesIO(), dpi=120, format="png")
    return file.getvalue()
