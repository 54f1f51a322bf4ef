"""Makes the pictures of the console in the documentation (`make pictures`): its real page, in Chromium."""

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import Page

from lfd.bench.browser import browser_page, put_notice_away
from lfd.console.console import console
from lfd.console.serving import free_port

PICTURES = Path("docs/pictures")
WIDTH, HEIGHT = 1200, 750
LONGEST_MS = 300_000


def demonstrate(page: Page) -> None:
    """The arm is on its way down."""
    _begin(page, "Demonstrate", "episode 0: waiting")
    page.keyboard.press("Enter")
    _wait(page, "episode 0: moving")
    page.keyboard.down("f")
    page.wait_for_timeout(4000)
    page.keyboard.up("f")


def correct(page: Page) -> None:
    """The arm was pushed down, and has learned."""
    _begin(page, "Correct", "waiting")
    page.keyboard.press("Enter")
    _wait(page, "cup_tilt")
    page.wait_for_timeout(1000)
    page.keyboard.down("f")
    page.wait_for_timeout(1200)
    page.keyboard.up("f")
    _wait(page, "cup_tilt -")


def compare(page: Page) -> None:
    """The first question."""
    _begin(page, "Compare", "question 1 of")
    page.wait_for_timeout(6000)


def supervise(page: Page) -> None:
    """A learner is taken over in the last of three rounds; the page is long enough for the plot."""
    page.set_viewport_size({"width": WIDTH, "height": 1020})
    page.get_by_role("tab", name="Supervise").click()
    for label, value in SMALL.items():
        rows = page.locator(f"xpath=//label[text()='{label}']/ancestor::div[.//input][1]")
        field = rows.locator("input").locator("visible=true").first
        field.fill(str(value))
        field.press("Tab")
        page.wait_for_timeout(200)  # the page sends one value in 50 ms
    _begin(page, "Supervise", "episode 0: waiting")
    page.keyboard.press("Enter")
    page.wait_for_function("() => !document.querySelector('[data-lfd-status]').innerText.includes('episode')")
    _wait(page, "episode 0: waiting")
    page.keyboard.press("Enter")
    page.keyboard.down("f")
    _wait(page, "episode 0: moving")
    page.wait_for_timeout(1500)


def browse(page: Page) -> None:
    """Where a demonstration comes from."""
    demonstrate(page)
    page.keyboard.press("y")
    _wait(page, "episode 1: waiting")
    page.keyboard.press("q")
    _wait(page, "demonstrate: done")
    page.get_by_role("tab", name="Browse").click()
    for button in ("Look again", "Show"):
        page.get_by_role("button", name=button, exact=True).locator("visible=true").click()
        page.wait_for_timeout(1000)
    page.locator("[data-lfd-card]").wait_for()


SMALL = {
    "rounds": 3,
    "rollouts a round": 1,
    "longest [s]": 60,
    "demonstrations at first": 5,
    "trials a round": 5,
    "gradient steps": 500,
}
"""What is filled in before Supervise begins."""
SHOWN: dict[str, Callable[[Page], None]] = {
    "console_demonstrate": demonstrate,
    "console_correct": correct,
    "console_compare": compare,
    "console_supervise": supervise,
    "console_browse": browse,
}


def main(names: list[str]) -> None:
    """Make the pictures of some names, or all."""
    for name in names or SHOWN:
        with (
            TemporaryDirectory() as folder,
            console(Path(folder), port=free_port()) as running,
            browser_page(WIDTH, HEIGHT, LONGEST_MS) as page,
        ):
            page.goto(running.url)
            page.wait_for_function("document.documentElement.dataset.lfdDrives === 'true'")
            _wait(page, "choose what to do below")
            put_notice_away(page)
            SHOWN[name](page)
            running.page.show_latency()
            page.screenshot(path=PICTURES / f"{name}.png")


def _begin(page: Page, mode: str, told: str) -> None:
    page.get_by_role("tab", name=mode).click()
    page.get_by_role("button", name="Begin", exact=True).locator("visible=true").click()
    _wait(page, told)


def _wait(page: Page, told: str) -> None:
    page.wait_for_function("told => document.querySelector('[data-lfd-status]').innerText.includes(told)", arg=told)


if __name__ == "__main__":
    main(sys.argv[1:])
