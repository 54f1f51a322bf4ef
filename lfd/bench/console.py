"""`lfd bench console`: how late the arm takes in what a page says, how soon it stands when the page is lost, and
whether memory stays bounded over reconnects.

A real page in headless Chromium demonstrates: it holds keys, says how episodes went, and is frozen and loaded anew in
the middle of them with a key held down. Chromium draws without a GPU, which takes most of a core.
"""

import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from lfd.bench.browser import MARK, browser_page
from lfd.console.console import console
from lfd.console.page import Page
from lfd.console.serving import free_port
from lfd.core.errors import InputError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import build, load_toml
from lfd.loops.dagger_recipe import DATA_TABLES
from lfd.record.demonstrations import RecordRecipe
from lfd.record.episode_file import read_episode
from lfd.record.mcap_file import SUFFIX
from lfd.record.session import record_session
from lfd.worlds.robots import load_teleop

if TYPE_CHECKING:
    from playwright.sync_api import Page as BrowserPage

RECIPE = Path("datasets/lift_panda.toml")
PATIENCE_MS = 120_000
HELD = ("r", "f", "w", "s", "a", "d")
HELD_S, EPISODE_S, AWAY_S = 0.3, 10.0, 1.0
"""How long a key is held, an episode lasts, and the page is away [s]."""
SAMPLED_S = 0.002
DRIVES = "document.documentElement.dataset.lfdDrives === 'true'"
SAYS = "text => document.querySelector('[data-lfd-status]')?.innerText.includes(text)"


@dataclass(frozen=True, kw_only=True)
class ConsoleBench:
    """What one run measured."""

    minutes: float
    episodes: int
    """Recorded, all of them read back."""
    reloads: int
    """Times that the browser was frozen in the middle of an episode, and the page loaded anew."""
    latency_ms: tuple[float, float]
    """From an event to the news that a control step has taken it in: median and 95th percentile of the latest 400."""
    stood_ms: tuple[float, float]
    """From the last that was heard of a page to the arm's last motion: median and longest."""
    memory_mb: tuple[float, float, float, float]
    """Of the process, page server and simulation: the median in each quarter."""
    page_mb: tuple[float, float, float, float]
    """Of the page's scripts: the same."""


def bench_console(*, minutes: float, reload_every_s: float, seed: int, progress: Progress = silent) -> ConsoleBench:
    """Demonstrate for some minutes, with the page loaded anew every `reload_every_s` [s].

    Raises `InputError` where there is no Playwright or Chromium.
    """
    memory: list[tuple[float, float]] = []
    stood: list[float] = []
    with TemporaryDirectory() as name, console(Path(name), recipes=Path(), port=free_port()) as running:
        out, served = Path(name) / "recordings", running.page
        with browser_page(960, 600, PATIENCE_MS) as page, progress("bench console", round(60 * minutes)) as bar:
            page.goto(running.url)
            page.wait_for_function(DRIVES)
            page.wait_for_function(SAYS, arg="choose what to do below")
            _demonstrate(served, out, seed)
            began = reloaded = told = time.monotonic()
            while (now := time.monotonic()) - began < 60 * minutes:
                page.wait_for_function(SAYS, arg=": waiting")
                page.keyboard.press("Enter")
                page.wait_for_function(SAYS, arg=": moving")
                started = time.monotonic()
                while time.monotonic() - started < EPISODE_S:
                    for key in HELD:
                        page.keyboard.down(key)
                        page.wait_for_timeout(1e3 * HELD_S)
                        page.keyboard.up(key)
                        memory.append((_resident_mb(), page.evaluate("performance.memory.usedJSHeapSize") / 1e6))
                if now - reloaded > reload_every_s:
                    reloaded = now
                    stood.append(_lose(page, served, running.url))
                page.wait_for_function(SAYS, arg=": moving")
                page.keyboard.press("y")
                bar.advance(round(time.monotonic() - told), note=f"{memory[-1][0]:.0f} MB, {len(stood)} reloads")
                told = time.monotonic()
            latencies = list(served.clients.seats.latencies_ms)
        served.stage.close()
        episodes = [read_episode(path) for path in sorted(out.glob(f"*{SUFFIX}"))]
    quarters = np.array_split(np.array(memory), 4)
    ours, pages = np.round([np.median(quarter, axis=0) for quarter in quarters], 1).T
    return ConsoleBench(
        minutes=minutes,
        episodes=len(episodes),
        reloads=len(stood),
        latency_ms=(round(float(np.median(latencies)), 1), round(float(np.percentile(latencies, 95)), 1)),
        stood_ms=(round(1e3 * float(np.median(stood))), round(1e3 * max(stood))),
        memory_mb=tuple(ours.tolist()),
        page_mb=tuple(pages.tolist()),
    )


def _demonstrate(served: Page, out: Path, seed: int) -> None:
    """Let somebody demonstrate until they are stopped, as the tab does."""
    tables = load_toml(RECIPE, DATA_TABLES)
    tables["record"] |= {"episodes": 100_000, "max_seconds": 600.0, "seed": seed}
    recipe = build(RecordRecipe, tables["record"], f"{RECIPE} [record]")

    def job() -> str:
        served.device.frame = load_teleop(recipe.robot).frame
        view = served.view(gizmo=True)
        record_session(recipe, out, served.device, tables=tables, view=view, status=served.tell)
        return "done"

    served.start("demonstrate", job)


def _lose(page: "BrowserPage", served: Page, url: str) -> float:
    """Freeze the browser with a key held down, then load the page anew.

    Returns the time from the last that was heard of it to the arm's last motion [s]: connections stay open while it is
    frozen, as they do when a network fails.
    """
    seats, hand, over = served.clients.seats, served.device.hand, threading.Event()
    moved: list[float] = []

    def sample() -> None:
        before = hand.position
        while not over.wait(SAMPLED_S):
            if hand.position is not before:
                before = hand.position
                moved.append(time.monotonic())

    page.keyboard.down("r")
    page.wait_for_timeout(500)
    sampling = threading.Thread(target=sample)
    sampling.start()
    time.sleep(AWAY_S)
    group = _group()
    os.killpg(group, signal.SIGSTOP)
    time.sleep(AWAY_S)
    heard = seats.heard_at
    over.set()
    sampling.join()
    os.killpg(group, signal.SIGCONT)
    page.goto("about:blank")
    page.keyboard.up("r")
    page.wait_for_timeout(1e3 * AWAY_S)
    page.goto(url)
    page.wait_for_function(DRIVES)
    return moved[-1] - heard


def _group() -> int:
    """The browser's group of processes."""
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if MARK.encode() in line.read_bytes().split(b"\0"):
                return os.getpgid(int(line.parent.name))
        except FileNotFoundError:  # it has just ended
            continue
    raise InputError("the browser has ended")


def _resident_mb() -> float:
    """Memory of this process [MB]; Linux tells."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1e3
