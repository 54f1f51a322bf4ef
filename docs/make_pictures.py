"""Makes the pictures of Rerun in the documentation (`make pictures`): real artifacts in Rerun's page, in Chromium.

What is shown is made first, into outputs/pictures, unless it is there. It works without a screen and without a graphics
card; Chromium is the one of the system (`make system`).
"""

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page

from lfd.bench.browser import browser_page
from lfd.cli import main as lfd
from lfd.loops.replaying import listing
from lfd.replay.rerun_scene.outputs import Sheet, served

MADE, PICTURES = Path("outputs/pictures"), Path("docs/pictures")
WIDTH, HEIGHT = 1200, 700
STILL_MS, LONGEST_MS = 20_000, 600_000
"""The page is finished when nothing of it has changed for so long; it may take this long."""
COMMANDS = {
    "recordings": ("record", "datasets/lift_panda.toml", "--episodes", "6", "--seed", "3"),
    "corrected": ("correct", "laptop", "--runs", "1"),
    "merge": ("interact", "merge", "--robot-kind", "obstacle", "active", "--person", "passive", "--episodes", "1"),
    "table": ("interact", "shared_table", "--robot-kind", "active", "--person", "middle-insists", "--episodes", "1"),
    "preferred": ("compare", "datasets/cup_panda.toml", "--person", "simulated", "--questions", "3", "--plans", "12"),
}
"""What is shown, and how it is made."""
SHOWN = {
    "replay": ("recordings", (0,)),
    "replay_beside": ("recordings", (0, 2, 3)),
    "replay_correction": ("corrected", (0,)),
    "replay_interaction": ("merge", (0, 1)),
    "replay_table": ("table", (0,)),
    "replay_comparison": ("preferred", (1,)),
}
"""Picture to what is seen on it: of which artifact, and the numbers of its episodes side by side."""


def main(names: list[str]) -> None:
    """Make the pictures of some names, or all."""
    for name in names or SHOWN:
        source, numbers = SHOWN[name]
        if not (MADE / source).is_dir() and lfd([*COMMANDS[source], "--out", str(MADE / source)]) != 0:
            sys.exit(f"{source} cannot be made")
        clips = tuple(clip for entry in listing(MADE / source).chosen(numbers).values() for clip in entry.open())
        with (
            served([Sheet(name, clips, plays=False)]) as address,
            browser_page(WIDTH, HEIGHT, LONGEST_MS) as page,
        ):
            page.goto(address)
            *_, last = _changes(page)
            Image.fromarray(last).save(PICTURES / f"{name}.png", optimize=True)


def _changes(page: Page) -> Iterator[np.ndarray]:
    """The page, again whenever it has changed, until it stays as it is; then once more."""
    before, still = np.zeros(0), 0
    for _ in range(LONGEST_MS // 5000):
        page.wait_for_timeout(5000)
        now = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=LONGEST_MS))).convert("RGB"))
        changed = now.shape != before.shape or np.abs(now.astype(int) - before).max() > 0
        before, still = now.astype(int), 0 if changed else still + 5000
        yield now
        if still >= STILL_MS and np.unique(now.reshape(-1, 3), axis=0).shape[0] > 500:
            return


if __name__ == "__main__":
    main(sys.argv[1:])
