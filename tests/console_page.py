"""A console with a real page in headless Chromium."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Locator, Page

from lfd.bench import browser
from lfd.bench.browser import chromium
from lfd.console.console import Console, console
from lfd.console.page import Page as ConsolePage
from lfd.console.serving import free_port
from lfd.core.rotations import matrix_from_wxyz

ROOT = Path(__file__).parent.parent
PATIENCE_MS = 240_000


def need_chromium() -> None:
    """On a machine without it the test is skipped, but never in CI."""
    if chromium() is None and not os.environ.get("CI"):
        pytest.skip("no Chromium here: `make system` installs it")


@contextmanager
def browser_page(width: int = 960, height: int = 600) -> Iterator[Page]:
    """An empty page."""
    need_chromium()
    with browser.browser_page(width, height, PATIENCE_MS) as page:
        yield page


@contextmanager
def running_console(folder: Path) -> Iterator[Console]:
    with console(folder, recipes=ROOT, port=free_port()) as running:
        yield running


class Driver:
    """Somebody before a page of the console."""

    def __init__(self, page: Page, url: str):
        self.page = page
        page.set_default_timeout(PATIENCE_MS)
        self.arrive(url)

    def arrive(self, url: str) -> None:
        """Open the page, and put away what hides the arm."""
        self.page.goto(url)
        self.page.wait_for_selector("[data-lfd-status]")
        browser.put_notice_away(self.page)

    def told(self) -> str:
        """What the page says of what goes on."""
        return self.page.inner_text("[data-lfd-status]")

    def wait_for(self, text: str) -> str:
        """Wait until the page says something."""
        self.page.wait_for_function(
            "text => document.querySelector('[data-lfd-status]').innerText.includes(text)", arg=text
        )
        return self.told()

    def drives(self) -> None:
        """Wait until this page drives."""
        self.page.wait_for_function("document.documentElement.dataset.lfdDrives === 'true'")

    def open_tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def fill(self, **values: object) -> None:
        """Fill in the open tab's fields, each by its label with _ for spaces."""
        for label, value in values.items():
            field = self._field(label.replace("_", " "))
            field.fill(str(value))
            field.press("Tab")
            # the page sends one value in 50 ms, the newest: nobody types faster, but a test does
            self.page.evaluate("new Promise(done => setTimeout(done, 120))")

    def _field(self, label: str) -> Locator:
        """The input of the open tab that stands beside a label."""
        rows = f"xpath=//label[text()='{label}']/ancestor::div[.//input or .//textarea][1]"
        return self.page.locator(rows).locator("input, textarea").locator("visible=true").first

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).locator("visible=true").click()

    def hold(self, key: str, seconds: float) -> None:
        self.page.keyboard.down(key)
        self.page.wait_for_timeout(1e3 * seconds)
        self.page.keyboard.up(key)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a dropdown."""
        self._field(label).click()
        self.page.get_by_role("option", name=option, exact=True).locator("visible=true").click()

    def seat(self) -> str:
        """What the page says of who drives."""
        return self.page.inner_text("[data-lfd-seat]")

    def latency_ms(self) -> float:
        """The median latency that the page shows."""
        told = self.page.inner_text("[data-lfd-latency]")
        found = re.search(r"median ([0-9]+) ms", told)
        assert found is not None, told
        return float(found[1])

    def drag_gizmo(self, console: ConsolePage, metres: float) -> None:
        """Drag the gizmo's arrow that lies most along the world's y by a length."""
        hand = console.device.hand
        axes = matrix_from_wxyz(hand.wxyz).T
        axis = max(axes, key=lambda axis: abs(axis[1]))
        begin = hand.position + 0.17 * axis
        self._drag(console, begin, begin + metres * np.sign(axis[1]) * axis, moves=10)

    def drag_arm(self, console: ConsolePage, way: tuple[float, float, float]) -> None:
        """Drag the shoulder, which hardly moves by itself, by a way [m]."""
        begin = np.array(console.scene._bodies["robot0_link2"].position)
        self._drag(console, begin, begin + np.array(way), moves=2)

    def _drag(self, console: ConsolePage, begin: np.ndarray, end: np.ndarray, moves: int) -> None:
        self.page.mouse.move(*self._pixel(console, begin))
        self.page.wait_for_timeout(300)
        self.page.mouse.down()
        for share in np.arange(1, moves + 1) / moves:
            self.page.mouse.move(*self._pixel(console, begin + share * (end - begin)))
            self.page.wait_for_timeout(60)
        self.page.wait_for_timeout(800)
        self.page.mouse.up()

    def _pixel(self, console: ConsolePage, point: np.ndarray) -> tuple[float, float]:
        """Where a point of the world is on the page."""
        (camera,) = (client.camera for client in console.server.get_clients().values())
        x, y, z = matrix_from_wxyz(camera.wxyz).T @ (point - camera.position)
        box = self.page.locator("canvas").first.bounding_box()
        assert box is not None
        focal = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
        return box["x"] + 0.5 * box["width"] + focal * x / z, box["y"] + 0.5 * box["height"] + focal * y / z
