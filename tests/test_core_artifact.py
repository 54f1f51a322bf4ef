from pathlib import Path

import pytest

from lfd.core.artifact import new_folder, read_manifest, sha256, write_manifest
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
