"""Rerun's page as a person sees it, in a real headless Chromium, and the command that serves it."""

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest

from lfd.record.png import decode_png
from lfd.replay.clip import episode_clip
from lfd.replay.rerun_scene.outputs import Sheet, served
from tests.console_page import browser_page
from tests.test_replay_live_view import ends

WIDTH, HEIGHT = 1000, 640
LOADED_S = 420.0
"""How long the page may take until the robot is seen [s]: it draws without a graphics card."""
BACKGROUND = 245
DISPENSABLE = {"fonts.googleapis.com", "fonts.gstatic.com", "app.rerun.io", "tel.rerun.io"}
"""What Rerun's page asks for and does without: a font, its maker's list of examples, and usage statistics."""


def scene_above_the_table(picture: np.ndarray) -> np.ndarray:
    """The part of the page in which only the arm can be: the scene takes the left three fifths."""
    return picture[50 : int(0.36 * HEIGHT), 10 : int(0.55 * WIDTH)].astype(int)


def shows_the_arm(picture: np.ndarray) -> bool:
    """Whether shaded links and dark joints stand out from the background, above the table."""
    part = scene_above_the_table(picture)
    brightness = part.mean(axis=2)
    other = np.abs(part - BACKGROUND).max(axis=2) > 12
    return bool(other.mean() > 0.03 and (brightness < 90).mean() > 0.002 and (other & (brightness > 130)).mean() > 0.01)


def shows_curves(picture: np.ndarray) -> bool:
    """Whether lines of several colours are drawn in the plots on the right."""
    part = picture[60 : int(0.9 * HEIGHT), int(0.62 * WIDTH) :].astype(int)
    is_coloured = np.ptp(part, axis=2) > 60
    return bool(is_coloured.mean() > 0.002 and len({tuple(c // 64) for c in part[is_coloured]}) > 3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_shows_the_arm_and_its_curves_without_the_internet(recorded, tmp_path) -> None:
    outside: list[str] = []  # refused

    def only_here(route, request) -> None:
        if urlparse(request.url).hostname == "127.0.0.1":
            route.continue_()
        else:
            outside.append(request.url)
            route.abort()

    with (
        served([Sheet("recorded", (episode_clip(recorded, "recorded"),), plays=False)]) as address,
        browser_page(WIDTH, HEIGHT) as page,
    ):
        page.route("**/*", only_here)
        page.goto(address)
        deadline, png = time.monotonic() + LOADED_S, b""
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        while not (shows_the_arm(picture) and shows_curves(picture)) and time.monotonic() < deadline:
            page.wait_for_timeout(4000)
            png = page.screenshot(timeout=180_000)
            picture = decode_png(png)
        Path(tmp_path / "page.png").write_bytes(png)
    assert shows_the_arm(picture), f"see {tmp_path}/page.png"
    assert shows_curves(picture), f"see {tmp_path}/page.png"
    blank = np.full_like(picture, BACKGROUND)
    assert not shows_the_arm(blank)
    assert not shows_curves(blank)
    assert {urlparse(url).hostname for url in outside} <= DISPENSABLE


@pytest.mark.slow
def test_serving_is_on_loopback_and_ends_with_ctrl_c(thread) -> None:
    command = [sys.executable, "-m", "lfd.cli", "replay", str(thread.recordings), "--all", "--serve", "--json"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in background jobs
    ) as process:
        assert process.stderr is not None
        said = ""
        while "look at http://" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        address = urlparse(said.partition("look at ")[2].split()[0])
        assert address.hostname == "127.0.0.1"
        assert address.port is not None
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", address.port)) == 0
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert "Traceback" not in error
    assert '"served"' in out
    assert ends(address.port)
