"""What a path is: a recording, a folder of them, a dataset, a policy, an evaluation, or a recipe."""

from pathlib import Path
from typing import Any

from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.core.recipe import as_table, build, describe, load_toml
from lfd.record.episode_file import BEGIN, END, read_episode
from lfd.record.mcap_file import SUFFIX, read_mcap


def about(path: Path) -> dict[str, Any]:
    """Facts about the artifact at `path`, `kind` first.

    Raises `InputError` for a path that is nothing of lfd's, and what reading it raises.
    """
    if path.suffix == SUFFIX:
        return _about_recording(path)
    if path.suffix == ".toml":
        return _about_recipe(path)
    if not path.is_dir():
        raise InputError(f"nothing that lfd knows at {path}; give a recording, recipe, dataset, policy or run")
    manifest = read_manifest(path)
    if manifest is None and not (path / "meta" / "info.json").is_file() and not any(path.glob(f"*{SUFFIX}")):
        raise InputError(f"{path} holds no manifest.json, no LeRobot dataset and no recordings")
    facts: dict[str, Any] = {"kind": "folder"} if manifest is None else dict(manifest)
    facts["parents"] = len(facts.get("parents", {}))
    recordings = sorted(path.rglob(f"*{SUFFIX}"))
    if recordings:
        facts["recordings"] = len(recordings)
    if (path / "meta" / "info.json").is_file():
        from lfd.data.frames import load_frames

        frames = load_frames(path)
        facts |= {"frames": len(frames), "episodes": int(frames.episode_index.max()) + 1, "fps": frames.fps}
        facts |= {name: ", ".join(names) for name, names in frames.names.items()}
    return facts


def _about_recipe(path: Path) -> dict[str, Any]:
    """Every key that the recipe's tables know, with its value and its meaning."""
    from lfd.convert.features import ConvertRecipe
    from lfd.policies.registry import recipe_class
    from lfd.record.demonstrations import RecordRecipe
    from lfd.run.evaluate import EvalRecipe
    from lfd.train.behavior_cloning import TrainRecipe
    from lfd.worlds.robots import RobotConfig

    kinds: dict[str, type] = {
        "robot": RobotConfig,
        "record": RecordRecipe,
        "convert": ConvertRecipe,
        "train": TrainRecipe,
        "eval": EvalRecipe,
    }
    facts: dict[str, Any] = {"kind": "recipe"}
    for name, table in load_toml(path, (*kinds, "policy")).items():
        kind = kinds[name] if name != "policy" else recipe_class(table, f"{path} [policy]")
        values = as_table(build(kind, table, f"{path} [{name}]"))
        meanings = describe(kind)
        facts |= {f"{name}.{key}": {"value": value, "meaning": meanings[key]} for key, value in values.items()}
    return facts


def _about_recording(path: Path) -> dict[str, Any]:
    content = read_mcap(path)
    facts: dict[str, Any] = {"kind": "recording", "bytes": path.stat().st_size}
    stamps = [stamp for messages in content.messages.values() for stamp, _ in messages]
    seconds = (max(stamps) - min(stamps)) / 1e9 if stamps else 0.0
    facts["seconds"] = round(seconds, 3)
    if BEGIN in content.metadata:
        episode = read_episode(path)
        keys = ("task", "robot", "controller", "policy", "control_hz", "stage", "seed", "index", "stepper", "started")
        facts |= {key: getattr(episode.metadata, key) for key in keys}
        facts |= dict(content.metadata[END])
    for topic, messages in sorted(content.messages.items()):
        span = (messages[-1][0] - messages[0][0]) / 1e9
        rate = f", {(len(messages) - 1) / span:.1f} Hz" if span > 0 else ""
        facts[f"topic {topic}"] = f"{len(messages)} messages{rate}"
    return facts
