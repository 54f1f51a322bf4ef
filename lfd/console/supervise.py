"""Supervise: look after a learner, take over and hand back, retrain. Behind it is `lfd dagger --device` (HG-DAgger)."""

from collections.abc import Sequence

import numpy as np
import viser.uplot
from viser import GuiUplotHandle

from lfd.console.folder import recipes
from lfd.console.html import hint
from lfd.console.page import Page
from lfd.core.errors import InputError
from lfd.core.recipe import load_toml
from lfd.experts.keys import Word
from lfd.loops.dagger import dagger
from lfd.loops.dagger_person import Person
from lfd.loops.dagger_recipe import DATA_TABLES, HUMAN, LEARN_TABLES, LoopRecipes
from lfd.loops.dagger_round import Row
from lfd.loops.watching import trial_of, watch
from lfd.worlds.robots import load_teleop

NONE = "none yet"
FIRST = "dagger_lift"
WORDS = (Word.START, Word.TAKE_OVER, Word.HAND_BACK, Word.GRIPPER, Word.SUCCESS, Word.FAILURE, Word.DISCARD, Word.QUIT)
HELP = """\
The learner acts. Take over by moving (keys, gamepad, gizmo)
or with <b>t</b>, hand back with <b>b</b>; what you do becomes its next lesson. <b>Enter</b> starts each rollout."""


def add_supervise(page: Page) -> None:
    """The tab."""
    gui, learn_in, data_in = page.gui, page.recipes / "policies", page.recipes / "datasets"
    gui.add_html(hint(HELP))
    policies, data = recipes(learn_in, "dagger"), recipes(data_in, "record")
    recipe = gui.add_dropdown("learner", policies, initial_value=FIRST if FIRST in policies else policies[0])
    source = gui.add_dropdown("task", data, initial_value="lift_panda" if "lift_panda" in data else data[0])
    rounds = gui.add_number("rounds", 3, min=2, max=100, step=1)
    rollouts = gui.add_number("rollouts a round", 5, min=1, max=1000, step=1)
    seconds = gui.add_number("longest [s]", 20.0, min=1.0, max=600.0, step=1.0, hint="of a rollout")
    demonstrations = gui.add_number("demonstrations at first", 10, min=1, max=1000, step=1)
    trials = gui.add_number("trials a round", 10, min=1, max=1000, step=1, hint="by which success is measured")
    steps = gui.add_number("gradient steps", 2000, min=1, max=1_000_000, step=1, hint="of each round")
    mine = gui.add_checkbox("I demonstrate", False, hint="else the scripted expert gives the demonstrations")
    name = gui.add_text("save as", "supervised")
    curve = success_plot(page)

    def begin() -> None:
        out = page.folder.place(name.value)
        learn = load_toml(learn_in / f"{recipe.value}.toml", LEARN_TABLES)
        learn["dagger"] |= {
            "rounds": int(rounds.value),
            "episodes_per_round": int(rollouts.value),
            "rollout_seconds": float(seconds.value),
            "demonstrations": int(demonstrations.value),
            "gate": HUMAN,
            "warm_steps": int(steps.value),
            "last_steps": 0,
            "evaluate": "every",
        }
        learn["train"] |= {"steps": int(steps.value)}
        learn["eval"] |= {"episodes": int(trials.value)}
        tables = load_toml(data_in / f"{source.value}.toml", DATA_TABLES)
        used = LoopRecipes.of(learn, tables, f"{recipe.value} and {source.value}:")

        rows: list[Row] = []

        def show(row: Row) -> None:
            rows.append(row)
            show_rounds(curve, rows, int(rounds.value))

        def job() -> str:
            page.device.frame = load_teleop(used.record.robot).frame
            view = page.view(gizmo=True)
            person = Person(device=page.device, view=view, status=page.tell, demonstrates=mine.value)
            report = dagger(used, out, person=person, report=show, resume=out.is_dir(), progress=page.progress)
            low, high = report["interval"]
            return (
                f"success {report['success_rate']:.0%} ({low:.0%} to {high:.0%}) after {report['labels']} labels; the "
                f"policy is {out.relative_to(page.folder.path)}/policy"
            )

        page.start("supervise", job)

    page.button("Begin", begin, color="blue", hint="goes on with the folder if it is there")
    page.words(*WORDS)
    add_watch(page)


def add_watch(page: Page) -> None:
    """A policy that is there: the same without retraining."""
    gui = page.gui
    with gui.add_folder("Or a policy that is there", expand_by_default=False):
        gui.add_html(hint("Watch it, take over, hand back: what results is recorded, with what you did as labels."))
        policy = gui.add_dropdown("policy", [NONE])
        robot = gui.add_text("on robot", "", hint="empty for the one that it was trained for")
        rollouts = gui.add_number("rollouts", 5, min=1, max=1000, step=1)
        seconds = gui.add_number("seconds of each", 20.0, min=1.0, max=600.0, step=1.0)
        name = gui.add_text("recordings", "looked_after")

        def refresh() -> None:
            policy.options = [one.name for one in page.folder.artifacts("policy")] or [NONE]

        def begin() -> None:
            if policy.value == NONE:
                raise InputError("no policy is in the folder: train one, then press Look for policies")
            out = page.folder.place(name.value)
            path = page.folder.place(policy.value)
            trial = trial_of(path, robot.value.strip() or None, longest_s=float(seconds.value))

            def job() -> str:
                page.device.frame = load_teleop(trial.robot).frame
                person = Person(device=page.device, view=page.view(gizmo=True), status=page.tell)
                done = watch(trial, out, person, rollouts=int(rollouts.value), progress=page.progress)
                return (
                    f"{done.successes} successes, {done.failures} failures are in {out.relative_to(page.folder.path)}"
                )

            page.start("watch", job)

        page.button("Watch", begin, color="blue", hint="adds to the recordings if they are there")
        page.button("Look for policies", refresh)
        refresh()


def success_plot(page: Page) -> GuiUplotHandle:
    """An empty plot of success over rounds."""
    return page.gui.add_uplot(
        (np.zeros(1), np.zeros(1)),
        (viser.uplot.Series(label="round"), viser.uplot.Series(label="success", stroke="#2563eb", width=2)),
        title="success by round",
        scales=scales(1),
        aspect=1.8,
        visible=False,
    )


def show_rounds(curve: GuiUplotHandle, rows: Sequence[Row], rounds: int) -> None:
    """Draw the success of each round so far, of a number that there will be."""
    x, y = np.array([(row["round"], row["success_rate"]) for row in rows], dtype=float).T
    curve.data, curve.scales, curve.visible = (x, y), scales(rounds - 1), True


def scales(last: int) -> dict[str, viser.uplot.Scale]:
    """Rounds up to the last one, and success; a point at an end is seen whole."""
    return {
        "x": viser.uplot.Scale(time=False, range=(-0.1, max(last, 1) + 0.1)),
        "y": viser.uplot.Scale(range=(-0.05, 1.05)),
    }
