"""The documentation's site: built without a warning, whole, and without anything from another host."""

import os
import re
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.conftest import ROOT
from tests.console_page import browser_page

PAGES = sorted(path.stem for path in (ROOT / "docs").glob("*.md"))
CHAPTERS = {
    "10.2": "behaviour_cloning",
    "10.3": "dagger",
    "10.4": "inverse_rl",
    "10.5.1": "comparisons",
    "10.5.2": "corrections",
    "10.6.1": "interaction",
    "10.6.2": "intent_inference",
}
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "use": "href"}
"""What a browser fetches by itself when it shows a page: element to its attribute."""


@dataclass
class Html(HTMLParser):
    """What a page links to, loads and can be linked to."""

    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    classes: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        self.classes.update(found.get("class", "").split())
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if LOADED.get(tag) in found and "canonical" not in found.get("rel", ""):
            self.loaded.append(found[LOADED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", out],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return out


class Quiet(SimpleHTTPRequestHandler):
    """Serves files, and says nothing of it."""

    def log_message(self, format: str, *args: object) -> None:
        del format, args


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address of a server of this machine that has the folder's files."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Html]:
    found = {}
    for path in sorted(site.glob("*.html")):
        found[path.name] = Html()
        found[path.name].feed(path.read_text(encoding="utf-8"))
    return found


def test_every_page_is_there_and_in_the_navigation_of_every_other(pages: dict[str, Html]) -> None:
    assert set(pages) == {f"{name}.html" for name in PAGES} | {"404.html"}
    for name in set(pages) - {"404.html"}:
        linked = {urlsplit(link).path or name for link in pages[name].links}
        assert {f"{page}.html" for page in PAGES} <= linked, name


def test_every_link_picture_and_script_is_there(site: Path, pages: dict[str, Html]) -> None:
    for name in set(pages) - {"404.html"}:  # its links are from the server's root
        for url in (*pages[name].links, *pages[name].loaded):
            parts = urlsplit(url)
            if parts.scheme:
                continue
            target = unquote(parts.path) or name
            assert (site / target).is_file(), f"{name}: {url}"
            if parts.fragment and target in pages:
                assert parts.fragment in pages[target].anchors, f"{name}: {url}"


def test_nothing_is_loaded_from_another_host(site: Path, pages: dict[str, Html]) -> None:
    for name, page in pages.items():
        assert not [url for url in page.loaded if re.match(r"(\w+:)?//", url)], name
        assert not page.classes["mermaid"], f"{name}: its script would come from the internet"
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert "@import" not in text
        assert not re.search(r"url\(['\"]?(https?:)?//", text), style


@pytest.mark.parametrize("name", CHAPTERS.values())
def test_a_page_of_the_chapter_has_mathematics_code_a_measured_result_and_a_picture(name: str, site: Path) -> None:
    page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    number = next(number for number, page in CHAPTERS.items() if page == name)
    assert re.search(rf"chapters? .*{re.escape(number)}|\({re.escape(number)}\)", page)
    assert re.search(r"^ {4}\S.*( = |<-|max_)", page, re.MULTILINE), "no equation"
    assert re.search(r"`lfd/\w+/\w+\.py`", page) or "```python" in page, "no code"
    assert "](results.md" in page, "no measured result"
    assert re.search(r"^!\[.+\]\(pictures/\w+\.png\)$", page, re.MULTILINE), "no picture"
    assert "<img" in (site / f"{name}.html").read_text(encoding="utf-8")


def test_a_page_that_refers_to_a_section_of_the_results_shows_its_table(site: Path) -> None:
    for page in (ROOT / "docs").glob("*.md"):
        for anchor in re.findall(
            r"^\[[^\]\n]+\]\(results\.md#([\w-]+)\)$", page.read_text(encoding="utf-8"), re.MULTILINE
        ):
            results, shown = ((site / f"{name}.html").read_text(encoding="utf-8") for name in ("results", page.stem))
            section = results.partition(f'id="{anchor}"')[2]
            first = re.findall(r"<td>(.*?)</td>", section, re.DOTALL)[:2]
            assert len(first) == 2, f"{page.name}: {anchor}"
            assert all(f"<td>{cell}</td>" in shown for cell in first), f"{page.name}: {anchor}"


@pytest.mark.slow
def test_a_browser_shows_the_pages_and_finds_words_without_asking_another_host(site: Path) -> None:
    with serving(site) as address, browser_page() as page:
        asked, complaints = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        for name in ("index", "corrections", "adding_a_task"):
            page.goto(f"{address}/{name}.html", wait_until="networkidle")
            widths = page.eval_on_selector_all("article img", "pictures => pictures.map(p => p.naturalWidth)")
            assert all(width > 100 for width in widths), name
        page.locator("input.md-search__input").first.press_sequentially("tightrope")
        page.wait_for_selector("a.md-search-result__link[href*='dagger.html']")
    assert asked
    assert not [url for url in asked if not url.startswith(address) and not url.startswith(("blob:", "data:"))]
    assert not complaints
