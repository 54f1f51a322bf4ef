"""Episodes of LeRobot v3 datasets as clips: ours with their robot, others as far as their features say.

A feature of numbers becomes a plot with its components' names, pictures and videos become views. Nothing is asked of
the names of features: a dataset without `observation.state`, without statistics or without names is shown as well.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.convert.dataset.dataset_files import DatasetFiles, StoredEpisode
from lfd.core.errors import DatasetError
from lfd.replay.clip import Clip, Curve, Video, entity, expert_pieces, kept_model, named_curve, states_of
from lfd.replay.episode_video import episode_video

INFO = Path("meta") / "info.json"
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Features that say where a row is, and nothing about it."""
MOST_COMPONENTS = 64
"""Vectors with more numbers, and matrices, are no plot that anybody could read: they are left out."""
SUCCESS, INTERVENTION = "next.success", "intervention"
CAMERA = "observation.images."


def is_dataset(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def dataset_clip(root: Path, episode: int) -> Clip:
    """An episode of the dataset in the folder `root`.

    Raises `DatasetError` when there is no such episode, or it cannot be read.
    """
    files = DatasetFiles(root)
    if not 0 <= episode < len(files):
        raise DatasetError(f"{root} has episodes 0 to {len(files) - 1}, not {episode}; choose with --episode")
    stored = files.read(episode)
    rows = int(files.episodes[episode]["length"])
    times = np.arange(rows) / float(files.fps)
    is_ours = files.manifest.get("kind") == "dataset"
    parts = _components(files, stored) if is_ours else {}
    curves = _our_curves(parts) if is_ours else _curves(files, stored)
    positions = {
        name.removesuffix("_pos"): np.stack([values[axis] for axis in "xyz"], axis=1)
        for name, values in parts.items()
        if name.endswith("_pos") and set(values) == set("xyz")
    }
    model = kept_model((root / "model.xml").read_text()) if (root / "model.xml").is_file() else None
    solved, overruled = (_flag(stored, name) for name in (SUCCESS, INTERVENTION))
    return Clip(
        f"{root.name} episode {episode}",
        times,
        curves,
        positions,
        model,
        _posture(model, parts, rows) if model is not None else None,
        {_camera(name): _pictures(root, name, pngs) for name, pngs in stored.pngs.items()},
        videos=_videos(files, episode),
        states=states_of(times, solved, overruled),
        pieces={} if overruled is None else expert_pieces(positions, overruled),
        success=None if solved is None else bool(solved[-1]),
        about=_about(files, stored, rows),
    )


def _about(files: DatasetFiles, stored: StoredEpisode, rows: int) -> dict[str, str]:
    told = {
        "dataset": files.root.name,
        "task": ", ".join(stored.tasks),
        "robot": str(files.info.get("robot_type") or "not said"),
        "length": f"{rows} frames at {files.fps:g} Hz",
    }
    left_out = [name for name in stored.columns if not _is_plot(files, name)]
    why = f"no vectors, or of more than {MOST_COMPONENTS} numbers"
    return told | ({"not shown": f"{', '.join(left_out)}: {why}"} if left_out else {})


def _is_plot(files: DatasetFiles, feature: str) -> bool:
    """Whether a feature is a vector that can be read as a plot."""
    shape = tuple(files.features[feature]["shape"])
    return len(shape) <= 1 and math.prod(shape) <= MOST_COMPONENTS


def _plotted(files: DatasetFiles, stored: StoredEpisode) -> dict[str, Float[np.ndarray, "N D"]]:
    return {
        name: values.astype(float)
        for name, values in stored.columns.items()
        if name not in BOOKKEEPING and _is_plot(files, name)
    }


def _names(files: DatasetFiles, feature: str, size: int) -> tuple[str, ...]:
    """Names of a feature's components; numbers where the dataset names another number of them."""
    names = tuple(str(name) for name in files.names(feature))
    return names if len(names) == size else tuple(str(i) for i in range(size))


def _curves(files: DatasetFiles, stored: StoredEpisode) -> dict[str, Curve]:
    """A plot for each feature."""
    return {
        f"plots/{entity(name)}": Curve(values, _names(files, name, values.shape[1]), "")
        for name, values in _plotted(files, stored).items()
    }


def _components(files: DatasetFiles, stored: StoredEpisode) -> dict[str, dict[str, Float[np.ndarray, "N"]]]:
    """The channels that our datasets put into features: name to the rows of each component."""
    parts: dict[str, dict[str, np.ndarray]] = {}
    for feature, values in _plotted(files, stored).items():
        for index, name in enumerate(_names(files, feature, values.shape[1])):
            part, dot, label = name.rpartition(".")
            parts.setdefault(part if dot else feature.removeprefix("next."), {})[label] = values[:, index]
    return parts


def _our_curves(parts: Mapping[str, Mapping[str, Float[np.ndarray, "N"]]]) -> dict[str, Curve]:
    return dict(named_curve(n, np.stack(list(v.values()), axis=1), tuple(v)) for n, v in parts.items())


def _flag(stored: StoredEpisode, name: str) -> np.ndarray | None:
    values = stored.columns.get(name)
    return None if values is None else values[:, 0].astype(bool)


def _camera(feature: str) -> str:
    return f"cameras/{entity(feature.removeprefix(CAMERA))}"


def _pictures(root: Path, feature: str, files: list[bytes]) -> tuple[bytes, ...]:
    if any(picture is None for picture in files):
        raise DatasetError(
            f"{root} keeps the pictures of {feature} outside its tables, which nothing here reads; save the dataset "
            "again with LeRobot, which puts them inside"
        )
    return tuple(files)


def _videos(files: DatasetFiles, episode: int) -> dict[str, Video]:
    row, found = files.episodes[episode], {}
    for feature, told in files.features.items():
        if told["dtype"] != "video":
            continue
        place = {key: row[f"videos/{feature}/{key}"] for key in ("chunk_index", "file_index")}
        path = files.root / files.info["video_path"].format(video_key=feature, **place)
        begin_s = float(row[f"videos/{feature}/from_timestamp"])
        found[_camera(feature)] = episode_video(path, begin_s, int(row["length"]), float(files.fps))
    return found


def _posture(
    model: mujoco.MjModel, components: Mapping[str, Mapping[str, np.ndarray]], rows: int
) -> Float[np.ndarray, "N nq"]:
    """Joint and object poses named in a dataset, as the model's qpos; what is not named stays where it is."""
    qpos = np.tile(model.qpos0, (rows, 1))
    joints = {model.joint(j).name: model.joint(j) for j in range(model.njnt)}
    for name, values in components.items():
        if name in ("joint_pos", "gripper_pos"):
            for joint, column in values.items():
                qpos[:, joints[joint].qposadr[0]] = column
        elif (body := name.removesuffix("_pos").removesuffix("_quat")) and f"{body}_joint0" in joints:
            at = joints[f"{body}_joint0"].qposadr[0]
            axes, offset = ("xyz", 0) if name.endswith("_pos") else ("wxyz", 3)
            for i, axis in enumerate(axes):
                qpos[:, at + offset + i] = values[axis]
    return qpos
