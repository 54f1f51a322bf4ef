import json
import shutil
from pathlib import Path

import pytest

from lfd.cli import main
from lfd.convert.to_lerobot import convert
from lfd.core.artifact import sha256, write_manifest
from lfd.core.errors import InputError
from lfd.record.episode_file import recordings_in
from lfd.trace import SHOWN, as_json, lines_of, trace


def test_the_chain_goes_from_a_policy_to_its_recordings(thread, capfd) -> None:
    recordings = recordings_in([thread.recordings])
    policy = trace(thread.policy)
    (dataset,) = policy.parents
    assert (policy.kind, dataset.kind) == ("policy", "dataset")
    assert [policy.path, dataset.path] == [str(thread.policy), str(thread.dataset)]
    assert [parent.path for parent in dataset.parents] == [str(path) for path in recordings]
    assert {parent.kind for parent in dataset.parents} == {"file"}
    assert {origin.state for origin in (policy, dataset, *dataset.parents)} == {"intact"}
    assert trace(thread.run).parents[0].path == str(thread.policy)

    assert main(["trace", str(thread.policy)]) == 0
    shown = capfd.readouterr().out
    at = [shown.index(str(path)) for path in (thread.policy, thread.dataset, *recordings)]
    assert at == sorted(at)  # child first
    assert "seed 0" in shown
    assert main(["trace", str(thread.policy), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == json.loads(json.dumps(as_json(policy)))


@pytest.fixture
def chain(tmp_path: Path) -> list[Path]:
    """A policy, its dataset, and five recordings, with manifests like those of the stages."""
    recordings = [tmp_path / "recordings" / f"{i}.mcap" for i in range(SHOWN + 2)]
    recordings[0].parent.mkdir()
    for path in recordings:
        path.write_text(path.name)
    dataset, policy = tmp_path / "dataset", tmp_path / "policy"
    for folder, kind, parents in ((dataset, "dataset", recordings), (policy, "policy", [dataset])):
        folder.mkdir()
        (folder / "content").write_text(kind)
        hashes = {str(path): sha256(path) for path in parents}
        write_manifest(folder, kind=kind, recipe={}, parents=hashes, seed=3)
    return [policy, dataset, *recordings]


def test_many_recordings_are_summed_up_and_those_that_are_not_intact_named(chain) -> None:
    policy, dataset, *recordings = chain
    lines = lines_of(trace(policy))
    assert [line.split(" (")[0] for line in lines] == [
        f"policy {policy}: intact",
        f"  dataset {dataset}: intact",
        f"    {len(recordings)} files in {recordings[0].parent}: {len(recordings)} intact",
    ]
    recordings[1].write_text("another")
    recordings[2].unlink()
    lines = lines_of(trace(policy))
    assert lines[2:] == [
        f"    5 files in {recordings[0].parent}: 3 intact, 1 changed, 1 missing",
        f"      {recordings[1]}: changed",
        f"      {recordings[2]}: missing",
    ]


def test_a_parent_that_has_changed_or_is_gone_is_said(chain) -> None:
    policy, dataset, *_ = chain
    (dataset / "content").write_text("grown")
    (origin,) = trace(policy).parents
    assert origin.state == "changed"
    assert len(origin.parents) == SHOWN + 2  # what it was made of is known all the same
    shutil.rmtree(dataset)
    (origin,) = trace(policy).parents
    assert (origin.state, origin.kind, origin.parents) == ("missing", "unknown", ())
    assert lines_of(origin) == [f"unknown {dataset}: missing"]


def test_paths_without_an_origin_are_refused(tmp_path, thread) -> None:
    with pytest.raises(InputError, match="nothing at .*none; give a dataset, policy, evaluation or export"):
        trace(tmp_path / "none")
    with pytest.raises(InputError, match="has no manifest.json, so nothing is known of its origin"):
        trace(tmp_path)
    with pytest.raises(InputError, match="has no manifest.json"):
        trace(recordings_in([thread.recordings])[0])
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="manifest.json is no JSON"):
        trace(tmp_path)


def test_a_chain_noted_with_relative_paths_is_found_from_anywhere(thread, tmp_path, monkeypatch) -> None:
    shutil.copytree(thread.recordings, tmp_path / "work" / "recordings")
    monkeypatch.chdir(tmp_path / "work")
    convert([Path("recordings")], Path("dataset"))
    monkeypatch.chdir(tmp_path)
    assert {parent.state for parent in trace(Path("work/dataset")).parents} == {"intact"}
