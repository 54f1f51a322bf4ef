"""MCAP files of other programs (ROS 2 bags, Foxglove, JSON) to episodes, through the mapping of a recipe.

    bags = bags_in([Path("demos")])                         # each a file, or the files of one ROS 2 bag
    recipe = map_recipe(load_toml(path, TABLES), str(path))  # lfd.convert.foreign.mapping
    episodes = frames_of_mcap(bags[0], recipe)               # one, or the pieces between gaps

The rows are made by `frames_of_samples(recipe, source, samples_of)` of `sampled_frames`, which takes any source:
`samples_of(entry)` returns the `Samples` that it has for a `[map.NAME]`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lfd.convert.foreign.mapping import MapEntry, MapRecipe
from lfd.convert.foreign.message_decoding import decode_message, decoder_of
from lfd.convert.foreign.message_samples import samples_of_topic
from lfd.convert.foreign.sampled_frames import frames_of_samples
from lfd.convert.foreign.samples import Samples
from lfd.convert.frames import EpisodeFrames
from lfd.core.errors import RecordingError
from lfd.record.mcap_file import SUFFIX, McapContent, Topic, read_mcap

BAG = "metadata.yaml"
"""What makes a folder a ROS 2 bag."""


def frames_of_mcap(paths: Sequence[Path], recipe: MapRecipe) -> list[EpisodeFrames]:
    """The episodes in a file, or in the files that make up one bag.

    Raises `RecordingError` for files that cannot be read, topics that are missing or cannot be decoded, and what
    `frames_of_samples` raises; the message names file, topic and time.
    """
    return frames_of_content(joined(paths), str(paths[0] if len(paths) == 1 else paths[0].parent), recipe)


def frames_of_content(content: McapContent, source: str, recipe: MapRecipe) -> list[EpisodeFrames]:
    """The episodes in the content of the recording `source`; raises what `frames_of_mcap` does."""
    if not any(content.messages.values()):
        raise RecordingError(f"{source} holds no messages; leave it out (--skip-bad)")
    _refuse_missing(source, content, recipe)
    if topic := recipe.resample.task_topic:
        told = replace(recipe.resample, task=_text_of(content, topic, source), task_topic="")
        recipe = replace(recipe, resample=told)

    def samples_of(entry: MapEntry) -> Samples:
        topic, messages = content.topics[entry.topic], content.messages[entry.topic]
        where = f"{source}, topic {entry.topic}"
        samples = samples_of_topic(topic, messages, where, entry, recipe.resample.clock)
        if samples.clock == "log" and entry.topic in content.jumps:
            before, after = content.jumps[entry.topic]
            raise RecordingError(
                f"{where}: the log clock jumps back by {(before - after) / 1e9:.6g} s at log time {before / 1e9:.6f} "
                "s; leave the recording out (--skip-bad)"
            )
        return samples

    return frames_of_samples(recipe, source, samples_of)


def _text_of(content: McapContent, topic: str, source: str) -> str:
    """The text of the first message on a topic."""
    if not content.messages.get(topic):
        raise RecordingError(f"{source} has no messages on topic {topic}, which [resample] task_topic names")
    time_ns, data = content.messages[topic][0]
    where = f"{source}, topic {topic}"
    message = decode_message(decoder_of(content.topics[topic], where), data, where, time_ns)
    text = getattr(message, "data", None)
    if not isinstance(text, str) or not text.strip():
        raise RecordingError(f"{where} holds no text in its field data; name the task in [resample] task")
    return text


def _refuse_missing(source: str, content: McapContent, recipe: MapRecipe) -> None:
    for name, entry in recipe.entries.items():
        if not content.messages.get(entry.topic):
            has = ", ".join(
                f"{t} ({_type(topic)})" for t, topic in sorted(content.topics.items()) if content.messages.get(t)
            )
            raise RecordingError(
                f"{source} has no messages on topic {entry.topic}, which [map.{name}] wants; it has {has}; "
                "correct topic, or leave the recording out (--skip-bad)"
            )


def _type(topic: Topic) -> str:
    return topic.schema or topic.encoding


def joined(paths: Sequence[Path]) -> McapContent:
    """The content of all files, messages in the order of the files' first ones."""
    contents = [read_mcap(path) for path in paths]
    order = sorted(
        range(len(paths)), key=lambda i: min((m[0][0] for m in contents[i].messages.values() if m), default=0)
    )
    messages: dict[str, list[tuple[int, bytes]]] = {}
    topics: dict[str, Topic] = {}
    for i in order:
        for name, topic in contents[i].topics.items():
            first = topics.setdefault(name, topic)
            if (first.schema, first.encoding) != (topic.schema, topic.encoding):
                raise RecordingError(
                    f"{paths[i]}, topic {name} holds {_type(topic)}, in the files before it {_type(first)}; "
                    "these are no files of one bag: convert them one by one"
                )
        for name, some in contents[i].messages.items():
            messages.setdefault(name, []).extend(some)
    jumps = {topic: jump for i in reversed(order) for topic, jump in contents[i].jumps.items()}
    return McapContent(messages, topics, jumps, contents[0].metadata, contents[0].attachments)


def bags_in(sources: Sequence[Path]) -> list[tuple[Path, ...]]:
    """The recordings among files and folders: a file each, or the files of a folder that is a ROS 2 bag.

    Raises `RecordingError` for a place without recordings, and for bags of a kind that lfd does not read.
    """
    found = [bag for source in sources for bag in (_bags_below(source) if source.is_dir() else [_single(source)])]
    return list({tuple(path.resolve() for path in bag): bag for bag in found}.values())


def _single(path: Path) -> tuple[Path, ...]:
    if path.suffix == ".db3":
        raise RecordingError(f"{path} is a bag in SQLite; {_CONVERT}")
    if path.suffix == ".bag":
        raise RecordingError(
            f"{path} is a bag of ROS 1; `rosbags-convert --src {path} --dst FOLDER` makes one of ROS 2"
        )
    return (path,)


_CONVERT = (
    "write a file out.yaml with `output_bags: [{uri: out, storage_id: mcap, all: true}]`, and "
    "`ros2 bag convert -i BAG -o out.yaml` makes one in MCAP"
)


def _bags_below(folder: Path) -> list[tuple[Path, ...]]:
    if (folder / BAG).is_file():
        return [_files_of_bag(folder)]
    files = [(path,) for path in sorted(folder.glob(f"*{SUFFIX}"))]
    inside = sorted(path for path in folder.iterdir() if path.is_dir())
    bags = files + [bag for path in inside if _holds_recordings(path) for bag in _bags_below(path)]
    if not bags:
        for path in sorted(folder.glob("*.db3")) + sorted(folder.glob("*.bag")):
            _single(path)
        raise RecordingError(f"{folder} holds no {SUFFIX} file")
    return bags


def _holds_recordings(folder: Path) -> bool:
    return any(folder.rglob(f"*{SUFFIX}")) or any(folder.rglob(BAG))


def _files_of_bag(folder: Path) -> tuple[Path, ...]:
    """The files that the bag's metadata names, in that order.

    `metadata.yaml` is written by a program, one file a line; no more of YAML is needed.
    """
    listed: list[str] = []
    inside = False
    for line in (folder / BAG).read_text(encoding="utf-8").splitlines():
        text = line.strip()
        if inside and text.startswith("- "):
            listed.append(text.removeprefix("- ").strip("'\""))
        else:
            inside = text == "relative_file_paths:"
    if not listed:
        raise RecordingError(f"{folder / BAG} names no files; `ros2 bag reindex {folder} mcap` writes it anew")
    for name in listed:
        if name.endswith(".db3"):
            raise RecordingError(f"{folder} is a bag in SQLite ({name}); {_CONVERT}")
        if not name.endswith(SUFFIX):
            raise RecordingError(f"{folder} has the compressed file {name}; decompress it with `zstd -d`, then reindex")
        if not (folder / name).is_file():
            raise RecordingError(f"{folder / name} is missing, which {BAG} names; complete the bag, or leave it out")
    return tuple(folder / name for name in listed)
