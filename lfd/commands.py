"""What each command of the command line does: from its arguments to the result that is shown.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from typing import Any

from lfd.core.errors import InputError

Result = dict[str, Any]
ALL_WORLDS = 2**16
"""More worlds than any machine has cores: as many as it has."""
MOST_NOTES = 10
"""Episodes whose notes are printed."""
USUAL = ("start_s", "pieces")
"""Notes that only matter beside others."""


def run_record(given: Namespace) -> Result:
    """Demonstrations of a task."""
    from lfd.core.recipe import build, load_toml
    from lfd.record.demonstrations import RecordRecipe, record
    from lfd.terminal import progress_bar

    tables = load_toml(given.recipe, ("record", "convert", "video"), given.set)
    _put(tables, "record", episodes=given.episodes, seed=given.seed)
    recipe = build(RecordRecipe, tables.get("record", {}), f"{given.recipe} [record]")
    if given.device is not None:
        return _record_person(given, recipe, tables)
    if given.no_view:
        raise InputError("--no-view is for people: choose their device with --device keyboard, spacemouse or gamepad")
    with _machines(given.cluster) as cluster:
        done = record(
            recipe,
            given.out,
            tables=tables,
            most_worlds=given.worlds,
            cluster=cluster,
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


def _record_person(given: Namespace, recipe: Any, tables: dict[str, Any]) -> Result:
    """Demonstrations of the person at a device."""
    from lfd.core.artifact import check_output
    from lfd.experts.registry import open_device
    from lfd.record.session import record_session
    from lfd.terminal import StatusLine, progress_bar

    if given.cluster is not None or 1 < given.worlds < ALL_WORLDS:
        option = "--cluster" if given.cluster is not None else f"--worlds {given.worlds}"
        raise InputError(f"a person moves one robot at a time: leave out {option}, or --device {given.device}")
    if not given.resume:
        check_output(given.out, overwrite=given.overwrite)
    with open_device(given.device) as device, _live_view(not given.no_view) as view, closing(StatusLine()) as status:
        done = record_session(
            recipe,
            given.out,
            device,
            tables=tables,
            view=view,
            status=status,
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


@contextmanager
def _live_view(wanted: bool) -> Iterator[Any]:
    """What a person sees of the world, with a word on where; or nothing."""
    if not wanted:
        yield None
        return
    from lfd.replay.live_view import live_view

    with live_view() as view:
        if view.address:
            print(
                f"live view: {view.address}\n(over SSH: forward both ports, see docs/teleoperation.md)", file=sys.stderr
            )
        yield view


def run_convert(given: Namespace) -> Result:
    """A dataset from recordings."""
    from lfd.convert.sources import SourceRecipe
    from lfd.convert.to_lerobot import convert
    from lfd.terminal import progress_bar

    with _machines(given.cluster) as cluster:
        done = convert(
            given.sources,
            given.out,
            recipe=SourceRecipe.load(given.recipe, trust_rows=given.trust_rows),
            append=given.append,
            skip_bad=given.skip_bad,
            jobs=given.jobs,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    result = {"out": str(given.out), **asdict(done)}
    if given.json:
        return result
    notes = {name: told for name, note in result.pop("notes").items() if (told := _noteworthy(note))}
    shown = {f"episode {name}": note for name, note in list(notes.items())[:MOST_NOTES]}
    if len(notes) > MOST_NOTES:
        shown["further episodes"] = f"{len(notes) - MOST_NOTES} with notes like these in {given.out}/manifest.json"
    return {key: value for key, value in result.items() if value not in ((), 0)} | shown


def _noteworthy(note: Result) -> str:
    """What a person should know of a converted episode: gaps, a recovery, how far a replay went away."""
    plain = {k: v for k, v in note.items() if isinstance(v, (str, int, float)) and v != "" and k not in USUAL}
    listed = {k: f"{len(v)} ({v[0]})" for k, v in note.items() if isinstance(v, (list, tuple)) and v}
    return ", ".join(f"{k} {_short(v)}" for k, v in {**plain, **listed}.items())


def run_verify(given: Namespace) -> Result:
    """Whether a dataset holds its sources."""
    from lfd.convert.sources import SourceRecipe
    from lfd.convert.verify import verify
    from lfd.terminal import progress_bar

    recipe = SourceRecipe.load(given.recipe) if given.recipe else None
    compared = verify(given.dataset, given.sources, recipe=recipe, progress=progress_bar)
    return {"dataset": str(given.dataset), "numbers_equal": compared}


def run_export(given: Namespace) -> Result:
    """Episodes in another program's format."""
    from lfd.convert.exporting import export
    from lfd.terminal import progress_bar

    done = export(
        given.sources,
        given.out,
        to=given.to,
        seed=given.seed,
        trust_rows=given.trust_rows,
        overwrite=given.overwrite,
        progress=progress_bar,
    )
    return asdict(done)


def run_trace(given: Namespace) -> Result:
    """Where an artifact comes from."""
    from lfd.trace import as_json, lines_of, trace

    origin = trace(given.path)
    return as_json(origin) if given.json else {"lines": lines_of(origin)}


def run_recover(given: Namespace) -> Result:
    """Episodes from what a crash left."""
    from lfd.record.recover import recover
    from lfd.terminal import progress_bar

    rows = [asdict(row) for row in recover(given.folder, progress=progress_bar)]
    if given.json:
        return {"files": rows}
    if not rows:
        return {str(given.folder): "every recording is whole"}
    return {row["path"]: f"{row['episode'] or 'nothing saved'}\n{row['note']}" for row in rows}


def run_train(given: Namespace) -> Result:
    """A policy from a dataset."""
    from lfd.core.recipe import build, load_toml
    from lfd.run.evaluate import EvalRecipe
    from lfd.terminal import progress_bar
    from lfd.train.behavior_cloning import TrainRecipe, train

    tables = load_toml(given.recipe, ("policy", "train", "eval"), given.set)
    _put(tables, "train", steps=given.steps, seed=given.seed)
    recipe = build(TrainRecipe, tables.get("train", {}), f"{given.recipe} [train]")
    build(EvalRecipe, tables.get("eval", {}), f"{given.recipe} [eval]")  # a mistake in it shows before training
    done = train(
        tables.get("policy", {}),
        recipe,
        given.dataset,
        given.out,
        tables=tables,
        overwrite=given.overwrite,
        progress=progress_bar,
    )
    return {"out": str(given.out), **asdict(done)}


def run_evaluate(given: Namespace) -> Result:
    """How often a policy succeeds."""
    from lfd.core.recipe import build
    from lfd.policies.acting import about_policy
    from lfd.run.evaluate import EvalRecipe, evaluate
    from lfd.terminal import progress_bar

    tables = about_policy(given.policy)["recipe"]
    _put(tables, "eval", episodes=given.episodes, seed=given.seed)
    recipe = build(EvalRecipe, tables["eval"], f"{given.policy} [eval]")
    with _machines(given.cluster) as cluster:
        done = evaluate(
            given.policy,
            recipe,
            given.out,
            most_worlds=given.worlds,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    report = asdict(done)
    del report["per_episode"]
    return {"out": str(given.out), **report}


def run_sweep(given: Namespace) -> Result:
    """Policies for every combination of some values."""
    from lfd.loops.sweep import sweep
    from lfd.terminal import progress_bar

    with _machines(given.cluster) as cluster:
        rows = sweep(
            given.recipe,
            given.vary,
            given.dataset,
            given.out,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    if given.json:
        return {"out": str(given.out), "rows": rows}
    best = {row.pop("folder"): ", ".join(f"{k} {_short(v)}" for k, v in row.items()) for row in rows}
    return {"out": str(given.out), **best}


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_short, value)) + "]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def run_replay(given: Namespace) -> Result:
    """An episode in Rerun, or its exact replay."""
    from lfd.replay.clip import clip_of
    from lfd.replay.rerun_scene import replay
    from lfd.replay.verify import verify_replay

    if given.verify:
        found = asdict(verify_replay(given.source, given.episode))
        found["failed"] = found["deviation"] > 0
        return found
    clip = clip_of(given.source, given.episode)
    replay(clip, save=given.save, overwrite=given.overwrite)
    shown = {"saved": str(given.save), "bytes": given.save.stat().st_size} if given.save else {"viewer": "opened"}
    return {"episode": clip.title, "seconds": float(clip.times[-1]), **shown}


def run_info(given: Namespace) -> Result:
    """What a file or folder holds."""
    from lfd.about import about

    return about(given.path)


def run_doctor(given: Namespace) -> Result:
    """What of this machine works."""
    del given
    from lfd.doctor import examine

    checks = examine()
    marks = {c.name: f"{'ok' if c.works else 'BROKEN' if c.needed else 'no'}: {c.detail}" for c in checks}
    return {**marks, "failed": any(c.needed and not c.works for c in checks)}


def run_demo(given: Namespace) -> Result:
    """The whole thread at once."""
    from lfd.loops.demo import demo, rows_of
    from lfd.loops.results import write_section
    from lfd.terminal import progress_bar

    recipes = given.dataset_recipe, given.policy_recipe
    measured = demo(*recipes, given.out, overwrite=given.overwrite, progress=progress_bar)
    if given.results is not None:
        write_section(given.results, "The thread on Lift with a Panda", "lfd demo", rows_of(measured))
    return measured if given.json else dict(rows_of(measured))


def run_bench(given: Namespace) -> Result:
    """Speed, side by side."""
    from lfd.bench.suites import SUITES
    from lfd.loops.results import write_section

    measured, sections = SUITES[given.suite](given)
    if given.results is not None:
        command = f"lfd bench {given.suite}" + " --quick" * given.quick + " --full" * given.full
        for title, rows in sections.items():
            write_section(given.results, title, command, rows)
    return measured


@contextmanager
def _machines(address: str | None) -> Iterator[Any]:
    """The cluster that was asked for, or none."""
    if address is None:
        yield None
        return
    from lfd.cluster import connect

    with connect(address) as cluster:
        print(f"{cluster.cpus} cores in the Ray cluster {address}", file=sys.stderr)
        yield cluster


def _put(tables: dict[str, dict[str, Any]], table: str, **values: Any) -> None:
    """Put the options that were given over the recipe's keys."""
    tables.setdefault(table, {}).update({key: value for key, value in values.items() if value is not None})
