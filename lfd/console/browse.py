"""Browse: what is in the folder, where it comes from, what it looks like; play an episode, or open it in Rerun."""

import time
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.image import imread

from lfd.about import about
from lfd.console.folder import episodes_of
from lfd.console.html import block, text
from lfd.console.page import Page
from lfd.core.errors import InputError
from lfd.record.mcap_file import SUFFIX
from lfd.replay.clip import Clip, clip_of
from lfd.trace import lines_of, trace

NOTHING = "nothing yet"
SHOWN_FACTS = 40
CARD = "README.md"
LONGEST_CARD = 4000
PLAY_HZ = 25.0
KINDS = (
    "all", "recordings", "dataset", "policy", "evaluation", "dagger", "reward", "corrections", "comparison",
    "interaction",
)  # fmt: skip


def add_browse(page: Page) -> None:
    """The tab."""
    gui = page.gui
    kind = gui.add_dropdown("kind", KINDS)
    chosen = gui.add_dropdown("artifact", [NOTHING])
    facts = gui.add_html("")
    pictures = [gui.add_image(np.full((4, 4, 3), 255, np.uint8), visible=False) for _ in range(3)]
    episode = gui.add_number("episode", 0, min=0, max=1_000_000, step=1)
    time_s = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
    link = gui.add_html("")

    def refresh() -> None:
        kinds = () if kind.value == KINDS[0] else (kind.value,)
        names = [f"{one.name} ({one.kind})" for one in page.folder.artifacts(*kinds)]
        chosen.options = names or [NOTHING]

    def path() -> Path:
        if chosen.value == NOTHING:
            raise InputError("nothing is here yet: demonstrate something first, or press Look again")
        return page.folder.place(chosen.value.rpartition(" (")[0])

    def show() -> None:
        place = path()
        facts.content = card_of(place, page.folder.path)
        found = sorted(place.glob("*.png"))[: len(pictures)]
        for picture, file in zip(pictures, [*found, *[None] * len(pictures)], strict=False):
            picture.visible = file is not None
            if file is not None:
                picture.image = (255 * imread(BytesIO(file.read_bytes()))[..., :3]).astype(np.uint8)
                picture.label = file.stem.replace("_", " ")

    def play() -> None:
        clip = _clip(path(), int(episode.value))
        if clip.model is None or clip.qpos is None:
            raise InputError("it has no model to show; open it in Rerun, which plots its numbers")
        time_s.max, time_s.value = float(clip.times[-1]), 0.0
        page.start("play", lambda: _play(page, clip, time_s))

    def open_in_rerun() -> None:
        place, number = path(), int(episode.value)
        page.start("replay", lambda: _serve(page, place, number, link))

    kind.on_update(lambda _: refresh())
    page.button("Look again", refresh)
    page.button("Show", show, color="blue")
    page.button("Play", play)
    page.button("Open in Rerun", open_in_rerun)
    refresh()


def card_of(place: Path, folder: Path) -> str:
    """What a place below a folder holds and where it comes from, as HTML."""
    rows = [(key, value) for key, value in about(place).items() if not isinstance(value, (Mapping, list))]
    table = "".join(
        f"<tr><td style='opacity:0.7;padding-right:0.75em'>{text(str(key))}</td><td>{text(str(value))}</td></tr>"
        for key, value in rows[:SHOWN_FACTS]
    )
    file = place / CARD
    card = f"<b>card</b>{_plain(file.read_text(encoding='utf-8')[:LONGEST_CARD])}" if file.is_file() else ""
    chain = _plain("\n".join(lines_of(trace(place))).replace(f"{folder}/", ""))
    return block("card", f"<table>{table}</table><b>comes from</b>{chain}{card}", "font-size:0.85em")


def _plain(words: str) -> str:
    return f"<pre style='white-space:pre-wrap;font-size:0.85em'>{text(words)}</pre>"


def _clip(place: Path, episode: int) -> Clip:
    """An episode of an artifact: recordings may be some folders below it."""
    if (place / "meta" / "info.json").is_file() or any(place.glob(f"*{SUFFIX}")):
        return clip_of(place, episode)
    files = episodes_of(place)
    if not files:
        raise InputError(f"{place.name} holds no episodes to replay")
    if episode >= len(files):
        raise InputError(f"{place.name} holds episodes 0 to {len(files) - 1}, not {episode}")
    return clip_of(files[episode], 0)


def _play(page: Page, clip: Clip, slider: Any) -> str:
    """Move the scene's arm as the clip says, at the slider's time, which runs."""
    assert clip.model is not None
    assert clip.qpos is not None
    data, end = mujoco.MjData(clip.model), float(clip.times[-1])
    page.scene.load(clip.model)
    while slider.value < end:
        page.device.check()
        row = min(int(np.searchsorted(clip.times, slider.value)), len(clip.times) - 1)
        data.qpos[:] = clip.qpos[row]
        mujoco.mj_kinematics(clip.model, data)
        page.scene.move(data)
        page.tell("play", f"{clip.title}: {slider.value:.1f} of {end:.1f} s")
        time.sleep(1.0 / PLAY_HZ)
        slider.value = min(slider.value + 1.0 / PLAY_HZ, end)
    return f"{clip.title}: {end:.1f} s"


def _serve(page: Page, place: Path, episode: int, link: Any) -> str:
    """Rerun's viewer with an episode, at an address of its own, until it is stopped."""
    from lfd.replay.rerun_scene.outputs import Sheet, served

    clip = _clip(place, episode)
    with served([Sheet(clip.title, (clip,))]) as address:
        anchor = f'<a href="{text(address)}" target="_blank">{text(clip.title)} in Rerun</a>'
        link.content = block("rerun", f"{anchor}: an address of its own on the console's machine, open until Stop")
        page.tell("replay", "the link is in the Browse tab; Stop ends it")
        try:
            while True:
                page.device.check()
                time.sleep(0.1)
        finally:
            link.content = ""
