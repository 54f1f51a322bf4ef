"""The whole thread once: record, convert, train, evaluate, replay."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.convert.to_lerobot import convert
from lfd.core.artifact import check_output, write_json, write_manifest
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import build, load_toml
from lfd.record.demonstrations import RecordRecipe, record
from lfd.replay.clip import clip_of
from lfd.replay.rerun_scene import replay
from lfd.replay.verify import verify_replay
from lfd.run.evaluate import evaluate
from lfd.run.judging import rollout_judge
from lfd.run.trial import EvalRecipe
from lfd.train.behavior_cloning import train
from lfd.train.recipe import TrainRecipe


def demo(
    dataset_recipe: Path, policy_recipe: Path, out: Path, *, overwrite: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Make a policy from a dataset recipe and a policy recipe; everything lands in the folder `out`.

    Returns what `report.json` holds: success rate with its interval, episodes, and seconds of each stage.
    """
    check_output(out, overwrite=overwrite)
    data = load_toml(dataset_recipe, ("record", "convert", "video"))
    learn = load_toml(policy_recipe, ("policy", "train", "eval"))
    recipes = {
        "record": build(RecordRecipe, data.get("record", {}), f"{dataset_recipe} [record]"),
        "train": build(TrainRecipe, learn.get("train", {}), f"{policy_recipe} [train]"),
        "eval": build(EvalRecipe, learn.get("eval", {}), f"{policy_recipe} [eval]"),
    }
    out.mkdir(parents=True, exist_ok=True)
    write_manifest(out, kind="demo", recipe=data | learn, parents={}, seed=recipes["record"].seed)
    seconds: dict[str, float] = {}
    began = time.perf_counter()

    def lap(stage: str) -> None:
        seconds[stage] = round(time.perf_counter() - began - sum(seconds.values()), 2)

    recordings, dataset, policy, run = (out / name for name in ("recordings", "dataset", "policy", "run"))
    options: dict[str, Any] = {"overwrite": overwrite, "progress": progress}
    recorded = record(recipes["record"], recordings, tables=data, **options)
    lap("record")
    converted = convert([recordings], dataset, **options)
    lap("convert")
    tried, judged = recipes["eval"], recipes["train"].judge_episodes
    judge = rollout_judge(tried, judged) if judged else None
    trained = train(learn.get("policy", {}), recipes["train"], dataset, policy, tables=learn, judge=judge, **options)
    lap("train")
    report = evaluate(policy, recipes["eval"], run, **options)
    lap("eval")
    with progress("replay", 3) as bar:
        replay(clip_of(recordings, 0), save=out / "demonstration.rrd", overwrite=overwrite)
        bar.advance(note="demonstration.rrd")
        replay(clip_of(run, 0), save=out / "rollout.rrd", overwrite=overwrite)
        bar.advance(note="rollout.rrd")
        verified = verify_replay(sorted(recordings.glob("*.mcap"))[0])
        bar.advance(note=f"deviation {verified.deviation}")
    lap("replay")
    measured = {
        "success_rate": report.success_rate,
        "interval": list(report.interval),
        "episodes": report.episodes,
        "mean_steps": report.mean_steps,
        "demonstrations": recorded.episodes,
        "failed_attempts": recorded.failures,
        "frames": converted.frames,
        "numbers_compared": converted.compared,
        "training": asdict(trained),
        "replay_deviation": verified.deviation,
        "control_steps_per_second": {
            "record": recorded.steps_per_second,
            "eval": report.steps_per_second,
        },
        "seconds": seconds,
    }
    write_json(out / "report.json", measured)
    return measured


def rows_of(measured: dict[str, Any]) -> dict[str, str]:
    """A demo's report as lines of a table."""
    low, high = measured["interval"]
    speed = measured["control_steps_per_second"]
    return {
        "success": f"{measured['success_rate']:.0%} of {measured['episodes']} unseen starts, "
        f"95% interval {low:.1%} to {high:.1%}",
        "mean episode": f"{measured['mean_steps']:.1f} control steps",
        "demonstrations": f"{measured['demonstrations']}, {measured['failed_attempts']} attempts failed",
        "dataset": f"{measured['frames']} frames, {measured['numbers_compared']} numbers read back equal",
        "training": f"{measured['training']['steps']} steps, loss {measured['training']['loss']:.1e}, "
        f"{measured['training']['parameters']} parameters",
        "exact replay": f"largest deviation {measured['replay_deviation']:g}",
        "speed": f"{speed['record']} control steps/s recording, {speed['eval']} evaluating",
        "time": ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in measured["seconds"].items()),
    }
