"""A real page in headless Chromium, for benchmarks, pictures and tests of pages."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lfd.core.errors import InputError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserType, Page

MARK = "--lfd"
"""By which the browser is found among the processes."""
FLAGS = (MARK, "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""It draws without a GPU."""
NOTICE = "Software WebGL rendering"
"""How viser's page begins to complain about that, over what it shows."""


def chromium() -> str | None:
    """The program, if it is there."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def launched(kind: "BrowserType") -> "Browser":
    """A browser of its own: of two pages of one browser, one would be behind the other and not be drawn.

    Raises `InputError` where there is none.
    """
    program = chromium()
    if program is None:
        raise InputError("no Chromium here: make system installs it")
    return kind.launch(executable_path=program, args=list(FLAGS))


@contextmanager
def browser_page(width: int, height: int, patience_ms: float) -> Iterator["Page"]:
    """An empty page [pixels], whose waiting ends in an error after `patience_ms` [ms].

    Raises `InputError` where there is no Playwright or Chromium.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError as error:
        raise InputError("no Playwright here, which drives the page: pip install 'lfd[dev]'") from error
    with sync_playwright() as playwright:
        browser = launched(playwright.chromium)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(patience_ms)
        yield page
        browser.close()


def put_notice_away(page: "Page") -> None:
    """Close the notice that hides the arm, when it comes."""
    page.get_by_text(NOTICE).locator("xpath=../../..//button").first.click()
