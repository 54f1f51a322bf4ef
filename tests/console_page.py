"""A console with a real page in headless Chromium."""

import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, sync_playwright

from lfd.console.console import Console, console

ROOT = Path(__file__).parent.parent
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE_MS = 180_000


def chromium() -> str:
    """The program; on a machine without it the test is skipped, but never in CI."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None and not os.environ.get("CI"):
        pytest.skip("no Chromium here: `make system` installs it")
    assert found is not None, "CI has no Chromium: .ci/run calls `make system`"
    return found


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def browser_page(width: int = 1280, height: int = 800) -> Iterator[Page]:
    """An empty page."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(FLAGS))
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(PATIENCE_MS)
        yield page
        browser.close()


@contextmanager
def running_console(folder: Path) -> Iterator[Console]:
    with console(folder, recipes=ROOT, port=free_port()) as running:
        yield running


class Driver:
    """Somebody before a page of the console."""

    def __init__(self, page: Page, url: str):
        self.page = page
        page.goto(url)
        page.wait_for_selector("[data-lfd-status]")

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
            field = self.page.get_by_label(label.replace("_", " "), exact=True).locator("visible=true")
            field.fill(str(value))
            field.press("Tab")

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).locator("visible=true").click()

    def hold(self, key: str, seconds: float) -> None:
        self.page.keyboard.down(key)
        self.page.wait_for_timeout(1e3 * seconds)
        self.page.keyboard.up(key)
