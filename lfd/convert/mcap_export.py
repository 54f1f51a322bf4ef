"""Episodes of any LeRobot dataset as MCAP files, one an episode, with the recipe that converts them back.

Each feature becomes a topic: `observation.state` is on `/observation/state`, a std_msgs/Float64MultiArray that names
its components; pictures are sensor_msgs/CompressedImage. Foxglove and Rerun open the files as they are.
"""

import json
from pathlib import Path

import numpy as np

from lfd.convert.dataset.dataset_files import DatasetFiles, StoredEpisode
from lfd.core.artifact import new_folder, sha256, write_manifest
from lfd.core.channels import ARRAY, IMAGE
from lfd.core.protocols import Progress, silent
from lfd.record import cdr
from lfd.record.columns import array_pack
from lfd.record.layouts import BlockMessage, Layout, StepBlock
from lfd.record.mcap_file import SUFFIX
from lfd.record.mcap_writing import McapWriter
from lfd.record.png import encode_png

START_NS = 10**9
"""Time of the first row [ns]; stamp 0 would mean no stamp."""
OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")
RECIPE = "recipe.toml"


def export_mcap(dataset: Path, out: Path, *, overwrite: bool = False, progress: Progress = silent) -> int:
    """Write every episode of a LeRobot dataset to the folder `out`; returns how many.

    Raises `DatasetError` for a dataset that cannot be read, `OutputError` when `out` exists or cannot be written.
    """
    files = DatasetFiles(dataset)
    with new_folder(out, overwrite=overwrite) as part, progress("export", len(files)) as bar:
        for index in range(len(files)):
            _write(part / f"episode_{index:06d}{SUFFIX}", files, files.read(index))
            bar.advance()
        recipe = _recipe(files)
        (part / RECIPE).write_text(recipe, encoding="utf-8")
        write_manifest(part, kind="export", recipe={}, parents={str(dataset): sha256(dataset)}, seed=0)
    return len(files)


def topic_of(feature: str) -> str:
    """`observation.state` is on `/observation/state`."""
    return "/" + feature.replace(".", "/")


def _write(path: Path, files: DatasetFiles, episode: StoredEpisode) -> None:
    writer = McapWriter(path)
    try:
        _write_rows(writer, files, episode)
        writer.finish()
    except BaseException:
        writer.discard()
        raise


def _write_rows(writer: McapWriter, files: DatasetFiles, episode: StoredEpisode) -> None:
    columns = {name: rows for name, rows in episode.columns.items() if name not in OWN}
    pictures = {name: [encode_png(p) for p in files.video(episode.index, name)] for name in _videos(files)}
    pictures |= episode.pngs
    writer.channel("/task", "std_msgs/msg/String", {})
    for name in columns:
        units = ",".join(files.units(name))
        writer.channel(topic_of(name), ARRAY, {"feature": name, "units": units})
    for name in pictures:
        writer.channel(topic_of(name), IMAGE, {"feature": name})
    about = {"dataset": files.root.name, "episode": str(episode.index), "fps": str(files.fps)}
    writer.metadata("lfd.export", about | {"tasks": json.dumps(episode.tasks)})
    writer.message("/task", START_NS, cdr.pack_string(episode.tasks[0]))
    layouts = {name: Layout.of(array_pack(files.names(name)), rows.shape[1]) for name, rows in columns.items()}
    block = StepBlock([BlockMessage(writer.number(topic_of(name)), made, False) for name, made in layouts.items()])
    joined = np.concatenate([rows.astype(np.float64) for rows in columns.values()], axis=1)
    stamps = START_NS + np.round(np.arange(len(joined)) * (1e9 / files.fps)).astype(int)
    for row, stamp in enumerate(stamps.tolist()):
        writer.records(block.fill(joined[row : row + 1], np.array([[stamp, stamp]])))
        for name, data in pictures.items():
            writer.message(topic_of(name), stamp, cdr.pack_image(stamp, name, data[row]))


def _videos(files: DatasetFiles) -> list[str]:
    return [name for name, told in files.features.items() if told["dtype"] == "video"]


def _recipe(files: DatasetFiles) -> str:
    """The recipe by which `lfd convert` makes the same dataset of the exported files."""
    lines = [
        f"# Converts these files back: lfd convert . --recipe {RECIPE} --out DATASET",
        "[resample]",
        f"fps = {files.fps}",
        'task_topic = "/task"',
        f"robot = {json.dumps(files.info.get('robot_type') or 'unknown')}",
        f"max_gap_s = {1.5 / files.fps}",
    ]
    for name, told in files.features.items():
        if name in OWN or told["dtype"] == "string":
            continue
        is_picture = told["dtype"] in ("image", "video")
        lines += ["", f'[map."{name}"]', f"topic = {json.dumps(topic_of(name))}", f"feature = {json.dumps(name)}"]
        lines.append('method = "nearest"' if is_picture else 'field = "data"\nmethod = "hold"\nunit = "1"')
    return "\n".join(lines) + "\n"
