"""The suites of `lfd bench`: with which sizes each runs, and the table that it makes."""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.terminal import progress_bar

Measured = dict[str, Any]
Suite = Callable[[Namespace], tuple[Measured, Measured]]
"""From the command's options to all that was measured, and to the rows of each section of a results page."""


def _cameras(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.cameras import bench_cameras

    measured = asdict(
        bench_cameras(
            task=given.task,
            robot=given.robot,
            control_hz=20,
            cameras=("agentview", "robot0_eye_in_hand"),
            sizes=(84, 256),
            states=10 if given.quick else 40,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    rows = measured["ratios"] | {"mean difference [1/255]": measured["mean_difference"]}
    rows |= {f"frames/s, {name}": rate for name, rate in measured["frames_per_second"].items()}
    return measured, {f"Cameras: {given.task} with {given.robot}": rows}


def _record(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.record import bench_record

    measured = asdict(
        bench_record(
            task=given.task,
            robot=given.robot,
            control_hz=20,
            episodes=5 if given.quick else 30,
            seconds=2.0 if given.quick else 20.0,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    rows = {
        f"simulation with recording, episodes of {length}": f"{x}x the time" for length, x in measured["cost"].items()
    }
    rows |= measured["ratios"]
    for name, speed in measured["writers"].items():
        rows[f"writer: {name}"] = ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in speed.items())
    keep_up = ", ".join(f"{name} {value:g}" for name, value in measured["real_time"].items())
    rows["1000 Hz joint states and two 256x256 cameras at 30 Hz, in real time"] = keep_up
    return measured, {f"Recording: {given.task} with {given.robot}": rows}


def _convert(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.convert import bench_convert

    episodes = 5 if given.quick else 50
    measured = asdict(
        bench_convert(
            task=given.task,
            robot=given.robot,
            episodes=episodes,
            many=10 if given.quick else 1000,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    rows = {"episodes": episodes, "frames": measured["frames"]} | measured["ratios"]
    rows |= {f"frames/s, {name}": rate for name, rate in measured["frames_per_second"].items()}
    rows |= {f"largest memory at {n} episodes of 200 frames [MB]": x for n, x in measured["memory_mb"].items()}
    return measured, {f"Conversion: {given.task} with {given.robot}": rows}


def _sim(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.matrix import bench_matrix, success_rates, whole_matrix
    from lfd.bench.sim import bench_everywhere, bench_sim

    common: dict[str, Any] = {"control_hz": 20, "seed": given.seed, "progress": progress_bar}
    episodes = 2 if given.quick else 20
    measured = asdict(bench_sim(task=given.task, robot=given.robot, episodes=episodes, **common))
    sections = {
        f"Simulation: {given.task} with {given.robot}": measured["ratios"]
        | {f"steps/s, {name}": rate for name, rate in measured["steps_per_second"].items()}
    }
    if given.full:
        measured["everywhere"] = bench_everywhere(**common)
        measured["matrix"] = asdict(bench_matrix(whole_matrix(), steps=10, **common))
        rates = success_rates(task="Lift", robot="panda", episodes=100, **common)
        measured["success"] = rates
        said = {
            name: f"{won} of 100, 95% interval {low:.1%} to {high:.1%}" for name, (won, (low, high)) in rates.items()
        }
        sections["Simulation: success of a noisy expert on both steppers"] = said
        sections["Simulation: every task with a Panda, every robot on Lift"] = {
            pair: ", ".join(f"{name} {value}" for name, value in ratios.items())
            for pair, ratios in measured["everywhere"].items()
        }
        sections["Simulation: same numbers as robosuite, every robot x controller x task"] = measured["matrix"]
    return measured, sections


def _train(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.train import bench_train

    measured = asdict(
        bench_train(
            episodes=10 if given.quick else 50,
            turns=3 if given.quick else 9,
            seconds=0.2 if given.quick else 1.0,
            peers=not given.quick,
            workers=not given.quick,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    loading: Measured = {"frames in the dataset, episodes of 200": measured["frames"]}
    for kind, ratios in measured["loading_ratios"].items():
        loading |= {f"{kind}: lfd {name}": f"{ratio:g}x" for name, ratio in ratios.items()}
        loading |= {f"{kind}: frames/s, {name}": x for name, x in measured["frames_per_second"][kind].items()}
    steps: Measured = {"robomimic and imitation": f"left out: {measured['missing']}"} if measured["missing"] else {}
    for kind, ratios in measured["step_ratios"].items():
        steps |= {f"{kind}: lfd {name}": f"{ratio:g}x" for name, ratio in ratios.items()}
        steps |= {f"{kind}: gradient steps/s, {name}": x for name, x in measured["steps_per_second"][kind].items()}
    return measured, {"Training: loading in batches of 64": loading, "Training: behaviour cloning": steps}


def _compounding(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.compounding import bench_compounding, plot, rows_of
    from lfd.bench.stretched_lift import Setting

    lift = Setting(
        robot=given.robot,
        control_hz=20,
        demonstrations=4 if given.quick else 20,
        episodes=4 if given.quick else 20,
        gradient_steps=300 if given.quick else 2000,
    )
    measured = bench_compounding(
        epsilon=1e-4,
        horizons=(10, 20, 50, 100, 200, 500, 1000),
        rounds=2,
        lift=lift,
        speeds=(1.0, 0.5) if given.quick else (1.0, 0.5, 0.25),
        seeds=range(given.seed, given.seed + (1 if given.quick else 3)),
        progress=progress_bar,
    )
    if given.results is not None:
        plot(measured, Path("docs/pictures/compounding.png"))
    return asdict(measured), {"Compounding error": rows_of(measured)}


def _dagger(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.dagger import bench_dagger, plot, rows_of, setting_of

    seeds = (given.seed,) if given.quick else tuple(range(given.seed, given.seed + 5))
    measured = bench_dagger(setting_of(given.task, quick=given.quick), seeds=seeds, progress=progress_bar)
    if given.results is not None:
        plot(measured, Path("docs/pictures/dagger_labels.png"))
    return asdict(measured), {f"DAgger: {given.task} by labels": rows_of(measured)}


def _comparisons(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.comparisons import bench_comparisons, plot, rows_of

    measured = bench_comparisons(
        features=(4,) if given.quick else (4, 7, 10),
        people=4 if given.quick else 30,
        questions=10 if given.quick else 40,
        seed=given.seed,
        progress=progress_bar,
    )
    if given.results is not None:
        plot(measured, Path("docs/pictures/comparisons.png"))
    curves = {
        case: {name: each.mean(axis=0).tolist() for name, each in found.items()}
        for case, found in measured.alignment.items()
    }
    return {"people": measured.people, "mean_alignment": curves}, {"Comparisons": rows_of(measured)}


def _irl(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.irl import bench_irl, plot, sections_of

    measured = bench_irl(
        size=16 if given.quick else 32,
        counts=(4, 64) if given.quick else (4, 16, 64, 256, 1024),
        seeds=range(given.seed, given.seed + (2 if given.quick else 10)),
        grids=0 if given.quick else 3,
        peer_size=30,
        arm=((1,), 1, range(given.seed, given.seed + 1))
        if given.quick
        else ((1, 3, 6), 3, range(given.seed, given.seed + 3)),
        progress=progress_bar,
    )
    if given.results is not None:
        plot(measured, Path("docs/pictures/inverse_rl.png"))
    return asdict(measured), sections_of(measured)


def _corrections(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.corrections import ROBOTS, bench_corrections, plot, sections_of

    measured = bench_corrections(
        robots=ROBOTS[:1] if given.quick else ROBOTS,
        people=1 if given.quick else 20,
        quiet_runs=2 if given.quick else 34,
        seed=given.seed,
        progress=progress_bar,
    )
    if given.results is not None:
        plot(measured, Path("docs/pictures/corrections.png"))
    return asdict(measured), sections_of(measured)


def _interaction(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.interaction import bench_interaction
    from lfd.bench.interaction_report import as_dict, plot, sections_of
    from lfd.interaction.scenes import SCENES

    measured = bench_interaction(
        scenes=("merge",) if given.quick else tuple(SCENES),
        episodes=10 if given.quick else 200,
        seed=given.seed,
        compared_steps=10 if given.quick else 30,
        progress=progress_bar,
    )
    if given.results is not None:
        plot(measured, Path("docs/pictures/interaction.png"))
    return as_dict(measured), sections_of(measured)


def _replay(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.bootstrap import in_words
    from lfd.bench.replay import bench_replay

    measured = asdict(
        bench_replay(
            task=given.task,
            robot=given.robot,
            repeats=3 if given.quick else 20,
            pairs=1 if given.quick else 10,
            episodes=2,
            gradient_steps=100 if given.quick else 300,
            every_kind=not given.quick,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    rows: Measured = {f"recording to Rerun file, {k}": f"{x:g}x real time" for k, x in measured["real_time"].items()}
    rows |= {f"once for a model: {name}": f"{x:g} s" for name, x in measured["once"].items()}
    rows |= {f"size: {kind}": f"{x:g} MB" for kind, x in measured["megabytes"].items()}
    rows |= {f"--live: {name}": in_words(values) for name, values in measured["live"].items()}
    return measured, {f"Replay: {given.task} with {given.robot}": rows}


def _console(given: Namespace) -> tuple[Measured, Measured]:
    from lfd.bench.console import bench_console

    minutes, reload_every_s = (1.0, 20.0) if given.quick else (30.0, 60.0)
    measured = asdict(
        bench_console(minutes=minutes, reload_every_s=reload_every_s, seed=given.seed, progress=progress_bar)
    )
    rows: Measured = {"minutes": minutes, "episodes recorded": measured["episodes"], "reloads": measured["reloads"]}
    rows["from an event to its control step: median, 95% within [ms]"] = _listed(measured["latency_ms"])
    rows["from a page's last sign of life to the arm's rest: median, longest [ms]"] = _listed(measured["stood_ms"])
    rows["memory of the server in each quarter [MB]"] = _listed(measured["memory_mb"])
    rows["memory of the page's scripts in each quarter [MB]"] = _listed(measured["page_mb"])
    return measured, {"Console: a page that is lost and loaded anew": rows}


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


SUITES: dict[str, Suite] = {
    "sim": _sim,
    "cameras": _cameras,
    "record": _record,
    "convert": _convert,
    "train": _train,
    "compounding": _compounding,
    "dagger": _dagger,
    "irl": _irl,
    "comparisons": _comparisons,
    "corrections": _corrections,
    "interaction": _interaction,
    "replay": _replay,
    "console": _console,
}
"""Name to suite."""
