"""What a path is: a recording, a folder of them, a dataset, a policy, an evaluation, or a recipe."""

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.core.recipe import as_table, build, describe, load_toml
from lfd.record.episode_file import BEGIN, END, read_episode
from lfd.record.mcap_file import SUFFIX, read_mcap
from lfd.record.topic_rates import topic_rates


def about(path: Path) -> dict[str, Any]:
    """Facts about the artifact at `path`, `kind` first.

    Raises `InputError` for a path that is nothing of lfd's, and what reading it raises.
    """
    if path.suffix == SUFFIX:
        return _about_recording(path)
    if path.suffix in (".hdf5", ".h5"):
        return _about_hdf5(path)
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


def _about_hdf5(path: Path) -> dict[str, Any]:
    from lfd.convert.hdf5.demo_file import read_file

    file = read_file(path, trust_rows=True)
    facts = {"kind": f"HDF5 demonstrations of {file.layout}", "bytes": path.stat().st_size}
    for key in ("env_name", "robots", "control_hz", "version", "made", "action_size"):
        facts[key] = getattr(file, key)
    return facts | {name: f"{rows} rows" for name, rows in file.lengths.items()}


def _about_recipe(path: Path) -> dict[str, Any]:
    """Every key that the recipe's tables know, with its value and its meaning."""
    from lfd.convert.features import ConvertRecipe
    from lfd.convert.foreign.mapping import ResampleRecipe, map_recipe
    from lfd.loops.dagger_recipe import DaggerRecipe
    from lfd.loops.plan_demonstrations import PlanRecipe
    from lfd.policies.registry import make_config
    from lfd.record.demonstrations import RecordRecipe
    from lfd.run.trial import EvalRecipe
    from lfd.train.recipe import TrainRecipe
    from lfd.worlds.robots import RobotConfig, RobotModel, TeleopConfig

    kinds: dict[str, type] = {
        "robot": RobotConfig,
        "model": RobotModel,
        "teleop": TeleopConfig,
        "record": RecordRecipe,
        "convert": ConvertRecipe,
        "resample": ResampleRecipe,
        "train": TrainRecipe,
        "eval": EvalRecipe,
        "dagger": DaggerRecipe,
        "plan": PlanRecipe,
    }
    facts: dict[str, Any] = {"kind": "recipe"}
    tables = load_toml(path, (*kinds, "policy", "map"))
    for name, table in tables.items():
        if name == "map":
            for channel, entry in map_recipe(tables, str(path)).entries.items():
                facts |= _about_keys(f"map.{channel}", entry)
            continue
        if name == "policy":
            facts |= _about_policy_keys(make_config(table, f"{path} [policy]"))
        else:
            facts |= _about_keys(name, build(kinds[name], table, f"{path} [{name}]"))
    return facts


def _about_keys(name: str, values: Any) -> dict[str, Any]:
    meanings = describe(type(values))
    return {f"{name}.{key}": {"value": v, "meaning": meanings[key]} for key, v in as_table(values).items()}


def _about_policy_keys(config: Any) -> dict[str, Any]:
    """The fields of a LeRobot configuration; the meaning of LeRobot's own ones is in its documentation."""
    meanings: dict[str, str] = {}
    for kind in reversed(type(config).__mro__[:-1]):
        if is_dataclass(kind):
            meanings |= describe(kind)
    plain = {field.name: getattr(config, field.name) for field in fields(config)}
    shown = {key: value for key, value in plain.items() if isinstance(value, (bool, int, float, str, list, tuple))}
    facts = {f"policy.{key}": {"value": value, "meaning": meanings.get(key, "")} for key, value in shown.items()}
    return {"policy.type": config.type, **facts}


def _about_recording(path: Path) -> dict[str, Any]:
    """What is in an MCAP file, ours or another program's."""
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
    for name, record in content.metadata.items():
        if name not in (BEGIN, END):
            facts |= {f"metadata {name} {key}": _shortened(value) for key, value in record.items()}
    facts |= {f"attachment {name}": f"{len(data)} bytes" for name, data in content.attachments.items()}
    return facts | {f"topic {rate.topic}": str(rate) for rate in topic_rates(content)}


def _shortened(text: str, most: int = 120) -> str:
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[:most]} ... ({len(text)} characters)"
