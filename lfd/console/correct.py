"""Correct: push the arm by dragging it while it carries out its plan. Behind it is `lfd correct --person device`."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import trimesh
import viser
import viser.uplot
from viser import GuiUplotHandle

from lfd.console.html import hint
from lfd.console.page import Page
from lfd.console.viser_scene import EYE, LOOK_AT, ViserScene
from lfd.core.artifact import sha256
from lfd.core.protocols import Observation, Observer, Transition, World
from lfd.experts.keys import Word
from lfd.experts.pushing import DevicePerson
from lfd.loops.correcting import CorrectionRecipe, Setup, learner_of, set_up, start_reward
from lfd.loops.correction_results import Watching
from lfd.loops.correction_session import Seat, correct_into
from lfd.loops.correction_tasks import FEATURES, TASKS
from lfd.planning.signed_distances import Box, Capsule, Shape
from lfd.record.pacing import Paced
from lfd.rewards.reward_artifact import load_reward
from lfd.worlds.robots import load_model, load_teleop

WIDE_EYE, WIDE_LOOK_AT = (2.0, -0.8, 1.6), (-0.25, 0.0, 1.35)
"""From where an arm is seen whole that is stretched upwards, as with a tilted cup, and what is in the middle [m]."""
SHOWN_S = 0.05
"""Time between arrows, and control steps' pictures [s]."""
PLOTTED_S = 0.25
LONGEST = 400
"""Points of a plot."""
NEW = "what the robot believes at first"
COLORS = ("#2563eb", "#16a34a", "#ea580c", "#7c3aed")
HELP = """\
The arm carries a cup along its plan, from when you say start (<b>Enter</b>). Drag a part of it, and it
is pushed that way: when you let go it has learned, and plans anew. Keys push too: <b>w s a d r f</b>.
Grey is its plan, orange what your push makes of it, green the new one."""


def add_correct(page: Page) -> None:
    """The tab."""
    gui = page.gui
    gui.add_html(hint(HELP))
    task = gui.add_dropdown("task", list(TASKS))
    told = gui.add_html(_told(task.value))
    robot = gui.add_text("robot", "panda")
    runs = gui.add_number("ways", 2, min=1, max=100, step=1)
    begin_with = gui.add_dropdown("reward", [NEW])
    name = gui.add_text("save as", "corrected")
    plot = weights_plot(page)

    @task.on_update
    def _(_event: object) -> None:
        told.content = _told(task.value)

    def refresh() -> None:
        begin_with.options = [NEW, *(one.name for one in page.folder.artifacts("reward"))]

    def begin() -> None:
        out = page.folder.place(name.value)
        recipe = CorrectionRecipe(task=task.value, robot=robot.value, runs=int(runs.value))
        recipe.check("correct:")
        old = None if begin_with.value == NEW else page.folder.place(begin_with.value)
        reward = start_reward(recipe) if old is None else load_reward(old)
        learner_of(reward, recipe)

        def job() -> str:
            setup = set_up(recipe)
            with seat_at(page, plot, recipe, setup) as seat:
                report, learned = correct_into(
                    out,
                    recipe,
                    setup,
                    reward,
                    seat,
                    parents={} if old is None else {str(old): sha256(old)},
                    progress=page.progress,
                )
            moved = ", ".join(f"{n} {w:.2f}" for n, w in zip(learned.features, learned.weights, strict=True))
            place = (out / "reward").relative_to(page.folder.path)
            return f"{report['pushes']} pushes noticed; weights: {moved}; the reward is {place}"

        page.start("correct", job)

    page.button("Begin", begin, color="blue")
    page.button("Look for rewards", refresh, hint="lists the rewards that are in the folder by now")
    page.words(Word.START)
    refresh()


@contextmanager
def seat_at(page: Page, plot: GuiUplotHandle, recipe: CorrectionRecipe, setup: Setup) -> Iterator[Seat]:
    """Whoever drives the page pushes; what they see are the arm, forces, paths and weights."""
    frame, limit = load_teleop(recipe.robot).frame, load_model(recipe.robot).push_n
    page.device.frame = frame
    view = page.view(gizmo=False)
    show_shapes(page.scene, setup.planner.scene.shapes)
    page.scene.on_drag(lambda event: _drag(page, event))
    page.look(WIDE_EYE, WIDE_LOOK_AT)

    def observers() -> list[Observer]:
        return [page.device.hand, Watching(view, page.tell, page.device), CorrectionView(page.scene, plot)]

    try:
        yield Seat(
            DevicePerson(page.device, frame, limit),
            observers=observers,
            around=lambda policy: Paced(policy, recipe.control_hz),
        )
    finally:
        page.scene.on_drag(None)
        page.scene.erase()
        page.look(EYE, LOOK_AT)


def add_pushing(page: Page, task: str) -> GuiUplotHandle:
    """What a page needs whose one purpose is a correction; returns its plot of the weights."""
    page.gui.add_html(hint(HELP))
    page.gui.add_html(_told(task))
    page.words(Word.START)
    return weights_plot(page)


def _told(task: str) -> str:
    return hint(f"You want {TASKS[task].told}.")


def _drag(page: Page, event: viser.SceneNodeDragEvent) -> None:
    """A drag of the arm: it is pulled towards the pointer."""
    if not page.clients.drives(event.client_id):
        return
    if event.phase == "end":
        page.device.let_go()
    else:
        page.device.pull(np.array(event.start_position), np.array(event.end_position))


class CorrectionView:
    """An observer that draws forces, paths and weights."""

    def __init__(self, scene: ViserScene, plot: GuiUplotHandle):
        self._scene, self._plot = scene, plot

    def begin(self, world: World, observation: Observation) -> None:
        self._hz, self._drawn, self._plotted, self._pushed = world.spec.control_hz, 0.0, 0.0, False
        self._rows: list[list[float]] = []
        self._scene.erase("path", "force")

    def step(self, world: World, transition: Transition) -> None:
        signals, now = transition.decision.signals, time.monotonic()
        for name, components in signals.items():
            if name.endswith("_path"):
                way = np.array(list(components.values())).reshape(-1, 3)
                self._scene.draw_path(name.removesuffix("_path"), way)
        force = np.array(list(signals["push"].values()))[:3]
        if now - self._drawn > SHOWN_S and (force.any() or self._pushed):
            self._drawn, self._pushed = now, bool(force.any())
            self._scene.draw_force(transition.observation["ee_pos"], force)
        if now - self._plotted > PLOTTED_S:
            self._plotted = now
            self._rows.append([transition.step / self._hz, *signals["weights"].values()])
            self._plot.data, self._plot.visible = tuple(np.array(self._rows[-LONGEST:]).T), True

    def end(self, success: bool) -> None:
        """What is drawn stays until the next way."""

    def abort(self) -> None:
        """What is drawn stays until the next way."""


def weights_plot(page: Page) -> GuiUplotHandle:
    """An empty plot of the weights over time."""
    series = [viser.uplot.Series(label="s")]
    series += [
        viser.uplot.Series(label=name, stroke=color, width=2) for name, color in zip(FEATURES, COLORS, strict=True)
    ]
    return page.gui.add_uplot(
        tuple(np.zeros(1) for _ in series),
        tuple(series),
        title="weights",
        scales={"x": viser.uplot.Scale(time=False)},
        aspect=1.6,
        visible=False,
    )


def show_shapes(scene: ViserScene, shapes: tuple[Shape, ...]) -> None:
    """Draw a scene's laptop and person: the model has its table."""
    for number, shape in enumerate(shapes):
        match shape:
            case Box(centre, half, yaw):
                pose = trimesh.transformations.rotation_matrix(yaw, (0, 0, 1))
                pose[:3, 3] = centre
                mesh = trimesh.creation.box(2 * np.array(half), pose)
            case Capsule(start, end, radius):
                mesh = trimesh.creation.capsule(float(np.linalg.norm(np.subtract(end, start))), radius, count=[12, 12])
                mesh.apply_translation(0.5 * np.add(start, end) - mesh.bounds.mean(axis=0))
            case _:
                continue
        scene.draw_shape(str(number), mesh, (110, 110, 110))
