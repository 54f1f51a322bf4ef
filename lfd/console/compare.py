"""Compare: two motions side by side, which is better? Behind it is `lfd compare`."""

import time
from io import BytesIO
from queue import Empty, Queue

import mujoco
import numpy as np
from matplotlib.image import imread
from viser import GuiImageHandle

from lfd.console.correct import show_shapes
from lfd.console.folder import recipes
from lfd.console.html import hint
from lfd.console.page import Page
from lfd.console.viser_scene import EYE, LOOK_AT, ViserScene
from lfd.loops.comparing import Comparison, Question, Reply, Rules, ask
from lfd.loops.comparison_folder import STATE, resumed
from lfd.loops.comparison_pictures import SHOWN_S, posterior_picture, question_clip
from lfd.loops.comparison_session import begin as begin_comparison
from lfd.loops.comparison_session import finish
from lfd.replay.clip import Clip

APART_M = 0.75
"""Distance of each of the two arms to the middle [m]."""
BACK = (2.2, 0.0, 2.0)
"""From where both are seen [m]."""
PICTURES_HZ = 25.0
REPLIES: dict[str, Reply] = {"Left": "a", "About equal": "equal", "Right": "b", "Undo": "undo"}
STOP_BELOW = 0.05
"""A question that is expected to tell less is not asked [bits]."""
HELP = """\
Both arms show how they would carry the cup. Say which way you
like better; the next question is the one whose answer tells most."""


def add_compare(page: Page) -> None:
    """The tab."""
    gui, folder = page.gui, page.recipes / "datasets"
    gui.add_html(hint(HELP))
    pool = gui.add_dropdown("motions", recipes(folder, "plan"))
    plans = gui.add_number("motions to choose from", 30, min=3, max=200, step=1)
    questions = gui.add_number("questions", 15, min=1, max=500, step=1)
    name = gui.add_text("save as", "preferred")
    replies: Queue[Reply] = Queue()
    page.choices("which is better?", REPLIES, replies.put)
    picture = gui.add_image(np.full((60, 200, 3), 255, np.uint8), label="what is known of the weights", visible=False)

    def begin() -> None:
        out, source = page.folder.place(name.value), folder / f"{pool.value}.toml"

        def job() -> str:
            if (out / STATE).is_file():
                kept = resumed(out)
            else:
                rules = Rules(criterion="information_gain", rationality=1.0, batch=1, seed=0)
                kept = begin_comparison(out, source, rules, plans=int(plans.value), progress=page.progress)
            comparison = kept.comparison
            with _Pair(page, comparison) as pair:

                def person(question: Question) -> Reply:
                    show_belief(picture, comparison)
                    page.tell(
                        f"question {question.number + 1} of {int(questions.value)}",
                        f"which do you like better? {question.bits:.2f} bits expected",
                    )
                    return _reply(page, replies, pair, question)

                def save(_: Comparison) -> None:
                    kept.replies += 1
                    kept.save()

                ended = ask(
                    comparison, person, questions=int(questions.value), stop_below=STOP_BELOW, save=save,
                    tell=lambda text: page.tell("compare", text),
                )  # fmt: skip
            show_belief(picture, comparison)
            finish(kept, ended=ended)
            return f"{ended}; the reward is {out.relative_to(page.folder.path)}"

        while not replies.empty():
            replies.get_nowait()
        page.start("compare", job)

    page.button("Begin", begin, color="blue", hint="goes on with the folder if it is there")


def _reply(page: Page, replies: "Queue[Reply]", pair: "_Pair", question: Question) -> Reply:
    """Show a question until there is an answer."""
    pair.load(question)
    while True:
        page.device.check()
        pair.show(time.monotonic())
        try:
            return replies.get(timeout=1.0 / PICTURES_HZ)
        except Empty:
            continue


class _Pair:
    """Two arms beside each other, in the place of the one."""

    def __init__(self, page: Page, comparison: Comparison):
        self._page, self._comparison = page, comparison
        self._scenes = [
            ViserScene(page.server, root, (0.0, side * APART_M, 0.0)) for root, side in (("/left", -1), ("/right", 1))
        ]

    def __enter__(self) -> "_Pair":
        self._page.scene.show(False)
        self._page.look(BACK, LOOK_AT)
        return self

    def __exit__(self, *_: object) -> None:
        for scene in self._scenes:
            scene.close()
        self._page.scene.show(True)
        self._page.look(EYE, LOOK_AT)

    def load(self, question: Question) -> None:
        """The two motions of a question: A on the left."""
        clip, shapes = question_clip(self._comparison.pool, question)
        assert clip.model is not None
        assert clip.qpos is not None
        self._motions = np.split(clip.qpos, 2)
        self._model, self._data, self._began = clip.model, mujoco.MjData(clip.model), time.monotonic()
        for scene, name, way in zip(self._scenes, "ab", _ways(clip), strict=True):
            scene.load(clip.model)
            scene.draw_path(name, way)
            show_shapes(scene, shapes)

    def show(self, now: float) -> None:
        """Both arms where they are at a time; the motions begin again and again."""
        share = (now - self._began) / SHOWN_S % 1.2  # a moment of rest at the end
        for scene, motion in zip(self._scenes, self._motions, strict=True):
            self._data.qpos[:] = motion[min(int(share * len(motion)), len(motion) - 1)]
            mujoco.mj_kinematics(self._model, self._data)
            scene.move(self._data)


def _ways(clip: Clip) -> list[np.ndarray]:
    """The gripper's paths of A and of B, of which each is repeated while the other one is shown."""
    half = len(clip.times) // 2
    return [clip.positions["a"][:half], clip.positions["b"][half:]]


def show_belief(picture: GuiImageHandle, comparison: Comparison) -> None:
    """Draw what the answers so far say of the weights."""
    png = posterior_picture(comparison, comparison.reward(), truth=None, aligned=())
    picture.image = (255 * imread(BytesIO(png))[..., :3]).astype(np.uint8)
    picture.visible = True
