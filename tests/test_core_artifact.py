import resource
import signal
from pathlib import Path

import pytest

from lfd.core.artifact import new_folder, packed, read_manifest, sha256, unpack, write_manifest
from lfd.core.errors import OutputError


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def interrupted() -> None:
        with new_folder(out, overwrite=False) as part:
            (part / "half").write_text("x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    with new_folder(out, overwrite=False) as part:
        (part / "whole").write_text("x")
        assert not out.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_nothing_is_overwritten_without_being_asked(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with new_folder(out, overwrite=False) as part:
        write_manifest(part, kind="first", recipe={}, parents={}, seed=0)
    with pytest.raises(OutputError, match="exists already; choose another --out, or add --overwrite"):
        new_folder(out, overwrite=False).__enter__()
    with new_folder(out, overwrite=True) as part:
        write_manifest(part, kind="second", recipe={}, parents={}, seed=0)
    assert (read_manifest(out) or {})["kind"] == "second"


def test_files_of_others_are_never_deleted(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="files that lfd did not make"):
        new_folder(tmp_path, overwrite=True).__enter__()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file, expected a folder"):
        new_folder(tmp_path / "file", overwrite=False).__enter__()
    with pytest.raises(OutputError, match=r"cannot make .*file"):
        new_folder(tmp_path / "file" / "out", overwrite=False).__enter__()


def test_the_hash_of_a_folder_is_of_names_and_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    first = sha256(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    assert sha256(tmp_path) == first
    (tmp_path / "a").rename(tmp_path / "b")
    assert sha256(tmp_path) != first


def test_a_folder_survives_the_way_to_another_machine(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    (here / "deep").mkdir(parents=True)
    (here / "deep" / "weights").write_bytes(b"\x00\x01")
    (here / "config.json").write_text("{}")
    unpack(packed(here), there)
    assert sha256(there) == sha256(here)


def test_files_that_cannot_be_written_get_a_sentence_and_leave_nothing_half_written(tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*large: File too large; choose another --out"):
            unpack({"a_small": b"x", "large": bytes(2000)}, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)
    assert [path.name for path in tmp_path.iterdir()] == ["a_small"]
