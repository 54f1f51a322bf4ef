"""The code of the documentation's pages, and running a page's code from its top to its end.

`python -m tests.docs_snippets PAGE` runs a page where it stands, with the lfd that is imported there.
"""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[1]
BASH, PYTHON, TOML, DIFF, TEXT, MERMAID = "bash", "python", "toml", "diff", "text", "mermaid"
PROGRAMS = (
    "lfd", "lerobot-train", "lerobot-eval", "rerun", "python", "pytest", "torchrun", "make", "source", "export", "ls",
    "ray", "ssh", "pip", "git",
)  # fmt: skip
"""What a line of a block without a language begins with if the block is commands."""

NOT_RUN = {
    r"lfd .*--device": "needs a person at a device; test_record_session.py and test_loops_dagger_person.py stand in",
    r"lfd compare (?!.*--person)": "asks the person at the terminal; test_loops_comparing.py answers",
    r"lfd replay (?!.*--(save|verify))": "opens a window; test_replay.py looks at what it would show",
    r"lfd bench": "measures for minutes or hours; test_bench.py and its neighbours run the suites small",
    r"lfd .*--cluster": "needs a cluster; test_cluster.py starts one",
    r"lfd console": "serves a page until Ctrl-C; test_console_page.py drives it",
    r"lfd convert SOURCE": "says what the arguments are",
    r"lerobot-train": "takes a minute; test_policies_adoption.py runs it",
    r"lerobot-eval": "takes a minute; test_run_lerobot_env.py runs it",
    r"lfd eval outputs/train": "needs what lerobot-train made; test_policies_adoption.py runs it",
    r"lfd .*demo\.hdf5": "needs a file of robosuite's users; test_convert_hdf5_replay.py makes one",
    r"make|source|export": "sets up the shell that the tests run in",
    r"ssh|ray": "needs another machine",
}
"""Commands that no page's test runs, by how they begin, and why."""

SMALLER = {
    "record": {"--episodes": "2"},
    "train": {"--steps": "20"},
    "eval": {"--episodes": "2"},
    "dagger": {"--rounds": "2"},
    "plan": {"--demonstrations": "2"},
    "compare": {"--questions": "6", "--plans": "20"},
    "correct": {"--runs": "1"},
    "interact": {"--episodes": "1"},
}
"""What commands are given in tests, in place of what their pages say; one more with --resume."""
SMALLER_IF_GIVEN = {"replay": {"--episode": "0"}, "irl": {"--holdout": "1"}}
SET = {
    "dagger": [
        "train.steps=20",
        "dagger.demonstrations=2",
        "dagger.episodes_per_round=1",
        "dagger.warm_steps=10",
        "eval.episodes=2",
        "eval.max_seconds=1.0",
    ],
}
"""Keys of recipes that tests make smaller."""
VARIED = {"sweep": ("--vary", "train.steps=[20]", "--vary", "eval.episodes=[1]")}
IN_PLACE = ("recover", "undo", "--resume", "--append")
"""Words of commands that change what is there."""


@dataclass(frozen=True)
class Block:
    """A block of code of a page."""

    page: str
    line: int
    language: str
    title: str
    """Path of the file that it is, or that it changes."""
    text: str


@dataclass
class Cache:
    """What commands wrote, by the command and by how its inputs came about: pages share commands."""

    written: dict[tuple, Path] = field(default_factory=dict)


def pages() -> list[str]:
    """Paths of all pages with code, from the root of the repository; results.md is written by commands."""
    found = sorted(path for path in (ROOT / "docs").glob("*.md") if path.name != "results.md")
    return ["README.md", *(f"docs/{path.name}" for path in found)]


def blocks(page: str) -> list[Block]:
    """The blocks of code of a page, in order; those without a language are commands or text, by their lines."""
    found = []
    for token in MarkdownIt().enable("table").parse((ROOT / page).read_text(encoding="utf-8")):
        if token.type not in ("fence", "code_block"):
            continue
        language, _, rest = token.info.strip().partition(" ")
        title = re.search(r'title="([^"]+)"', rest)
        if not language:
            is_bash = any(_program(line.removeprefix("$ ")) for line in token.content.splitlines())
            language = BASH if is_bash else TEXT
        assert token.map
        found.append(Block(page, token.map[0] + 1, language, title[1] if title else "", token.content))
    return found


def commands(block: Block) -> list[str]:
    """The commands of a block, without its comments; where some lines begin with $, the others are what is printed."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if any(line.startswith("$ ") for line in lines):
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    return [shlex.join(words) for line in lines if (words := shlex.split(line, comments=True))]


def why_not_run(command: str) -> str | None:
    """The pattern of `NOT_RUN` that a command matches."""
    return next((pattern for pattern in NOT_RUN if re.match(pattern, command)), None)


def smaller(command: str) -> list[str]:
    """The arguments of a command of lfd, with less to do."""
    name, *arguments = shlex.split(command)[1:]
    more = int("--resume" in arguments)
    for option, value in (SMALLER.get(name, {}) | SMALLER_IF_GIVEN.get(name, {})).items():
        if option in arguments:
            arguments[arguments.index(option) + 1] = str(int(value) + more)
        elif option in SMALLER.get(name, {}):
            arguments += [option, str(int(value) + more)]
    for assignment in SET.get(name, ()):
        arguments += ["--set", assignment]
    arguments += VARIED.get(name, ())
    return [name, *arguments]


def run(page: str, cache: Cache, given: Sequence[str] = ()) -> Iterator[str]:
    """Run a page's commands and Python, and write its files, in the current folder; yields what is run next.

    `given` are commands to run before.
    """
    names: dict[str, object] = {"__name__": page}
    origin: dict[str, tuple] = {}
    for command in given:
        yield command
        _command(command, origin, cache)
    for block in blocks(page):
        yield f"{page}:{block.line}"
        if block.language == PYTHON and not block.title:
            exec(compile("\n" * block.line + block.text, page, "exec"), names)
        elif block.language == DIFF:
            _change(Path(block.title), block)
        elif block.title:
            Path(block.title).parent.mkdir(parents=True, exist_ok=True)
            Path(block.title).write_text(block.text, encoding="utf-8")
        elif block.language == BASH:
            for command in commands(block):
                if why_not_run(command) is None:
                    yield command
                    _command(command, origin, cache)


def _command(command: str, origin: dict[str, tuple], cache: Cache) -> None:
    """Run a command, or take over what it wrote for another page from the same inputs."""
    from lfd.cli import main

    if not command.startswith("lfd "):
        name, *arguments = shlex.split(command)
        beside = Path(sys.executable).parent / name  # the environment that the tests run in may not be the shell's
        subprocess.run([str(beside) if beside.is_file() else name, *arguments], check=True)
        return
    arguments = smaller(command)
    before = {word: made for word in arguments for name, made in origin.items() if _is_in(word, name)}
    written = [Path(word) for option, word in pairwise(arguments) if option in ("--out", "--save")]
    key = (*sorted(arguments), *sorted(before.items()))
    changes = any(word in arguments for word in IN_PLACE)
    if written and not changes and all((key, str(path)) in cache.written for path in written):
        for path in written:
            _copy(cache.written[key, str(path)], path)
    else:
        assert main(arguments) == 0, command
        for path in () if changes else written:
            cache.written[key, str(path)] = path.resolve()
    for path in arguments if changes else map(str, written):
        origin[path] = key


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy(source, target)


def _is_in(path: str, folder: str) -> bool:
    return path == folder or path.startswith(f"{folder}/")


def _change(path: Path, block: Block) -> None:
    """Apply a diff without line numbers: what it takes away and keeps must stand in the file exactly once."""
    lines = block.text.splitlines()
    old = "\n".join(line[1:] for line in lines if not line.startswith("+"))
    new = "\n".join(line[1:] for line in lines if not line.startswith("-"))
    text = path.read_text(encoding="utf-8")
    assert text.count(f"{old}\n") == 1, f"{block.page}:{block.line}: {path} does not have, once:\n{old}"
    path.write_text(text.replace(f"{old}\n", f"{new}\n"), encoding="utf-8")


def _program(line: str) -> bool:
    return line.partition(" ")[0] in PROGRAMS


if __name__ == "__main__":
    for step in run(sys.argv[1], Cache()):
        print(step, flush=True)
