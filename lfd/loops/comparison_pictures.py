"""What a comparison shows: the two paths of a question, the plan that it ends with, the belief as curves."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from io import BytesIO

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.loops.arm_evidence import resampled
from lfd.loops.comparing import Comparison, Question
from lfd.loops.comparison_pool import Pool
from lfd.loops.plan_demonstrations import ASIDE_M, CUBE, TASK
from lfd.planning.arm_model import CONTROL_HZ
from lfd.planning.arm_planner import Plan
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.signed_distances import Shape
from lfd.replay.clip import Clip, Curve
from lfd.rewards.arm_features import arm_features
from lfd.rewards.reward_artifact import LinearReward
from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task

SHOWN_S, ROWS = 6.0, 61
"""Time that a motion is shown in [s], and rows of it; all motions of a pool take the same time, often a minute."""
BESIDE = 12
"""Most paths of the pool beside the plan."""
SAMPLES = 4000
"""Of the belief, in its picture."""


def question_clip(pool: Pool, question: Question) -> tuple[Clip, tuple[Shape, ...]]:
    """The arm moving as A and then as B, both paths of the gripper, each feature's rate, and the scene."""
    scene = int(pool.scene_of[question.a])
    motions = [resampled(pool.trajectories[number], ROWS) for number in (question.a, question.b)]
    a, b = (forward(pool.arm, motion).points[:, GRIPPER] for motion in motions)
    paths = {"a": np.concatenate([a, np.repeat(a[-1:], ROWS, axis=0)])}
    paths["b"] = np.concatenate([np.repeat(b[:1], ROWS, axis=0), b])
    return _clip(pool, scene, f"question {question.number + 1}: first A, blue, then B, orange", motions, paths)


def pair_clips(pool: Pool, question: Question) -> tuple[Clip, Clip]:
    """A and B of a question, each moving in a clip of its own; their curves lie over one another."""
    scene = int(pool.scene_of[question.a])
    made = []
    for name, number in (("a", question.a), ("b", question.b)):
        motion = resampled(pool.trajectories[number], ROWS)
        path = forward(pool.arm, motion).points[:, GRIPPER]
        clip, shapes = _clip(pool, scene, name.upper(), [motion], {name: path})
        curves = {place: replace(curve, names=(name.upper(),)) for place, curve in clip.curves.items()}
        made.append(replace(clip, curves=curves, shapes=shapes, about={"plan": pool.names[number]}))
    return made[0], made[1]


def plan_clip(pool: Pool, plan: Plan, scene: int) -> tuple[Clip, tuple[Shape, ...]]:
    """The plan that follows from a comparison, its path in green beside some of the pool in its scene."""
    others = np.flatnonzero(pool.scene_of == scene)[:BESIDE]
    paths = {f"pool_{n}": forward(pool.arm, resampled(pool.trajectories[n], ROWS)).points[:, GRIPPER] for n in others}
    motion = resampled(plan.trajectory, ROWS)
    paths["planned"] = forward(pool.arm, motion).points[:, GRIPPER]
    return _clip(pool, scene, "the plan that the answers imply", [motion], paths)


def _clip(
    pool: Pool, scene: int, title: str, motions: Sequence[Float[np.ndarray, "N D"]], paths: dict[str, np.ndarray]
) -> tuple[Clip, tuple[Shape, ...]]:
    """Motions one after the other."""
    planner = pool.planner(scene)
    seen = planner.rows(np.stack([resampled(motion, planner.waypoints) for motion in motions])) / planner.dt_s
    rates = np.concatenate([resampled(np.concatenate([one, one[-1:]]), ROWS) for one in seen])
    curves = {
        f"plots/{feature.name}": Curve(rates[:, k : k + 1], ("rate",), feature.unit)
        for k, feature in enumerate(arm_features(pool.features))
    }
    model, rest, places = _arm_at_table(pool.recipe.robot)
    qpos = np.repeat(rest[None], len(rates), axis=0)
    qpos[:, places] = np.concatenate(motions)
    times = np.linspace(0.0, SHOWN_S * len(motions), len(rates))
    return Clip(title, times, curves, paths, model, qpos), planner.scene.shapes


@cache
def _arm_at_table(robot: str) -> tuple[mujoco.MjModel, Float[np.ndarray, "nq"], list[int]]:
    """The model of the world that plans are run in, a posture of it with the cube aside, the arm's places in it."""
    environment = make_environment(load_task(TASK), load_robot(robot), CONTROL_HZ)
    model, qpos = environment.sim.model._model, np.array(environment.sim.data.qpos)
    cube = int(model.joint(CUBE).qposadr[0])
    qpos[cube : cube + 2] = ASIDE_M
    return model, qpos, [int(model.joint(name).qposadr[0]) for name in environment.robots[0].robot_joints]


def posterior_picture(
    comparison: Comparison, reward: LinearReward, *, truth: Float[np.ndarray, "K"] | None, aligned: Sequence[float]
) -> bytes:
    """Marginals of the weights over their ranges before and after, and the alignment over questions, as PNG.

    `truth` and `aligned` are a simulated person's weights and how well they were known; None and empty for others.
    """
    from matplotlib.figure import Figure

    rng, names = np.random.default_rng(7), reward.features
    after = comparison.belief().sample(SAMPLES, rng) * reward.ranges
    before = comparison.belief(0).sample(SAMPLES, rng) * reward.ranges
    count = len(names) + bool(aligned)
    columns = min(3, count)
    figure = Figure(figsize=(3.4 * columns, 2.6 * -(-count // columns)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(-(-count // columns), columns, squeeze=False).ravel())
    for k, (name, axes) in enumerate(zip(names, panels, strict=False)):
        low, high = np.quantile(after[:, k], [0.001, 0.999])
        room = 0.5 * (high - low)
        bins = np.linspace(min(low - room, 0.0), max(high + room, 0.0), 60)
        axes.hist(before[:, k], bins, density=True, color="0.8", label="before")
        axes.hist(after[:, k], bins, density=True, histtype="stepfilled", alpha=0.7, label="after")
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        if truth is not None:
            axes.axvline(truth[k] * reward.ranges[k], color="C3", label="the person's")
        axes.set(title=name, xlabel="weight x range", yticks=[])
    panels[0].legend(fontsize="small")
    if aligned:
        panels[len(names)].plot(np.arange(len(aligned)), aligned, "o-", markersize=3)
        panels[len(names)].set(title="alignment", xlabel="answers", ylim=(min(0.0, *aligned), 1.02))
        panels[len(names)].grid(alpha=0.3)
    for axes in panels[count:]:
        axes.set_axis_off()
    figure.savefig(file := BytesIO(), dpi=120, format="png")
    return file.getvalue()
