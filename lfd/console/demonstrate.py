"""Demonstrate: drive the arm, record, say how it went. Behind it is `lfd record --device`."""

from lfd.console.folder import recipes
from lfd.console.html import hint
from lfd.console.page import Page
from lfd.core.recipe import build, load_toml
from lfd.experts.keys import Word
from lfd.record.demonstrations import RecordRecipe
from lfd.record.session import record_session
from lfd.worlds.robots import load_teleop

WORDS = (Word.START, Word.SUCCESS, Word.FAILURE, Word.DISCARD, Word.REDO, Word.GRIPPER, Word.QUIT)
HELP = """\
Drag the gizmo at the gripper, use a gamepad, or keys:
<b>w s a d</b> away, back, left, right; <b>r f</b> up, down; <b>u o j l i k</b> turn; <b>space</b> gripper;
<b>Enter</b> start, <b>y</b> success, <b>n</b> failure, <b>x</b> discard, <b>z</b> redo, <b>q</b> quit."""


def add_demonstrate(page: Page) -> None:
    """The tab."""
    gui, folder = page.gui, page.recipes / "datasets"
    gui.add_html(hint(HELP))
    known = recipes(folder, "record")
    recipe = gui.add_dropdown("recipe", known, initial_value="lift_panda" if "lift_panda" in known else known[0])
    episodes = gui.add_number("successes", 10, min=1, max=1000, step=1)
    seconds = gui.add_number("longest [s]", 30.0, min=1.0, max=600.0, step=1.0)
    name = gui.add_text("save as", "demonstrations")

    def begin() -> None:
        out, file = page.folder.place(name.value), folder / f"{recipe.value}.toml"
        tables = load_toml(file, ("record", "convert", "video"))
        tables["record"] |= {"episodes": int(episodes.value), "max_seconds": float(seconds.value)}
        used = build(RecordRecipe, tables["record"], f"{file.name} [record]")

        def job() -> str:
            page.device.frame = load_teleop(used.robot).frame
            done = record_session(
                used,
                out,
                page.device,
                tables=tables,
                view=page.view(gizmo=True),
                status=page.tell,
                resume=out.is_dir(),
                progress=page.progress,
            )
            return f"{done.successes} successes and {done.failures} failures are in {out.relative_to(page.folder.path)}"

        page.start("demonstrate", job)

    page.button("Begin", begin, color="blue", hint="adds to the folder if it is there")
    page.words(*WORDS)
