"""What a path is: a recording, a folder of them, a dataset, a policy, an evaluation, or a recipe."""

from pathlib import Path
from typing import Any

from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.core.recipe import load_toml
from lfd.record.episode_file import BEGIN, END, read_episode
from lfd.record.mcap_file import SUFFIX, read_mcap

TABLES = ("robot", "record", "convert", "policy", "train", "eval")


def about(path: Path) -> dict[str, Any]:
    """Facts about the artifact at `path`, `kind` first.

    Raises `InputError` for a path that is nothing of lfd's, and what reading it raises.
    """
    if path.suffix == SUFFIX:
        return _about_recording(path)
    if path.suffix == ".toml":
        tables = load_toml(path, TABLES)
        return {"kind": "recipe"} | {f"{t}.{key}": value for t, keys in tables.items() for key, value in keys.items()}
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
        rate = (len(messages) - 1) / seconds if seconds and len(messages) > 1 else 0.0
        facts[f"topic {topic}"] = f"{len(messages)} messages, {rate:.1f} Hz"
    return facts
