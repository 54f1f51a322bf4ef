"""Every block of code of the README and of docs/ is run, or there is a reason why not."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lfd.cli import _parser
from tests.conftest import ROOT
from tests.docs_snippets import (
    BASH,
    DIFF,
    MERMAID,
    NOT_RUN,
    PYTHON,
    TEXT,
    TOML,
    Cache,
    blocks,
    commands,
    pages,
    run,
    why_not_run,
)

RECORDED = "lfd record datasets/lift_panda.toml --out outputs/recordings"
CONVERTED = "lfd convert outputs/recordings --out outputs/dataset"
GIVEN = {
    "docs/behaviour_cloning.md": (RECORDED, CONVERTED),
    "docs/conversion.md": (RECORDED, CONVERTED),
}
"""What pages take to be there: other pages make it."""
CHANGING = [page for page in pages() if any(block.language == DIFF or block.title for block in blocks(page))]
"""Pages that add to the sources."""
RUNNING = [
    page
    for page in pages()
    if page not in CHANGING
    and any(
        block.language == PYTHON or (block.language == BASH and not all(map(why_not_run, commands(block))))
        for block in blocks(page)
    )
]
SLOW = {
    page for page in RUNNING if any(not why_not_run(c) for b in blocks(page) if b.language == BASH for c in commands(b))
}
COMMANDS = [
    (block, command)
    for page in pages()
    for block in blocks(page)
    if block.language == BASH
    for command in commands(block)
]


@pytest.fixture(scope="session")
def cache() -> Cache:
    return Cache()


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the recipes of the checkout, as the present one."""
    for name in ("datasets", "policies", "robot_configs", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow) if page in SLOW else page for page in RUNNING]
)
def test_the_code_of_a_page_runs(page: str, workspace: Path, cache: Cache) -> None:
    for step in run(page, cache, given=GIVEN.get(page, ())):
        print(step)


@pytest.mark.slow
@pytest.mark.parametrize("page", CHANGING)
def test_what_a_page_adds_to_the_sources_works(page: str, tmp_path: Path) -> None:
    """In a copy of the checkout, with a process of its own; compiled code is copied, too."""
    for name in ("lfd", "datasets", "policies", "robot_configs", "tests", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    for name in ("README.md", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "tests.docs_snippets", page],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


@pytest.mark.parametrize("page", pages())
def test_every_block_says_what_it_is(page: str) -> None:
    for block in blocks(page):
        assert block.language in (BASH, PYTHON, TOML, DIFF, TEXT, MERMAID), f"{page}:{block.line}: {block.language}"
        if block.language == TOML:
            tomllib.loads(block.text)


@pytest.mark.parametrize(("block", "command"), COMMANDS, ids=[command for _, command in COMMANDS])
def test_a_command_that_is_not_run_can_be_typed(block, command: str) -> None:
    words = shlex.split(command)
    if why_not_run(command) is None or words[0] != "lfd" or "SOURCE..." in words:
        return
    _parser().parse_args(words[1:])
    for word in words:
        if word.startswith(("datasets/", "policies/", "robot_configs/")):
            assert (ROOT / word).is_file(), f"{block.page}:{block.line}"


def test_every_reason_not_to_run_is_in_use_and_names_tests_that_are_there() -> None:
    assert {why_not_run(command) for _, command in COMMANDS} - {None} == set(NOT_RUN)
    for reason in NOT_RUN.values():
        for name in re.findall(r"test_\w+\.py", reason):
            assert (ROOT / "tests" / name).is_file()
