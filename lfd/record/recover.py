"""What a crash left becomes episodes again.

A killed recording leaves a `.part` file of whole chunks, and damage leaves a file of which some chunks are whole. The
longest run of control steps of which everything is there becomes a valid episode, marked as recovered.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from lfd.core.channels import CHANNELS, IMAGE, channel
from lfd.core.errors import EpisodeError, RecordingError
from lfd.core.protocols import Progress, silent
from lfd.record.columns import arrays
from lfd.record.episode_file import BEGIN, END, MEMORY, read_episode
from lfd.record.journal import SUFFIX as JOURNAL
from lfd.record.journal import LeftSteps, journal_of, read_journal
from lfd.record.mcap_file import DAMAGE, SUFFIX, McapContent, Topic, salvage_mcap
from lfd.record.mcap_writing import McapWriter
from lfd.record.messages import step_messages

PART = f"{SUFFIX}.part"
RECOVERED = f".recovered{SUFFIX}"
"""Ending of an episode that is being made."""
DAMAGED = ".damaged"
"""What is appended to the name of a damaged file that has steps which its recovered episode has not."""


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What became of one file."""

    path: str
    """The file that was looked at."""
    episode: str
    """The episode that was made of it; empty when nothing could be saved."""
    steps: int
    """Control steps of the episode."""
    dropped_steps: int
    """Control steps that are whole but not in the episode: those on the other side of a hole."""
    lost_bytes: int
    """Bytes of the file that could not be read."""
    note: str
    """What happened, in words."""


def recover(folder: Path, *, progress: Progress = silent) -> list[Recovered]:
    """Recover every unfinished or damaged recording in a folder; what is whole is not touched.

    Raises `RecordingError` when the folder does not exist.
    """
    if not folder.is_dir():
        raise RecordingError(f"no folder {folder}")
    for unfinished in folder.rglob(f"*{RECOVERED}*"):  # of a recovery that was killed
        unfinished.unlink()
    for journal in folder.rglob(f"*{SUFFIX}{JOURNAL}"):
        if not journal.with_name(journal.name.removesuffix(JOURNAL) + ".part").exists():
            journal.unlink()  # its recording was finished at the last moment
    found = sorted([*folder.rglob(f"*{PART}"), *folder.rglob(f"*{SUFFIX}")])
    done = []
    with progress("recover", len(found)) as bar:
        for path in found:
            if path.name.endswith(PART) or not _is_whole(path):
                done.append(_recover_file(path))
            bar.advance(note=f"{sum(bool(r.episode) for r in done)} recovered")
    return done


def _is_whole(path: Path) -> bool:
    """Whether a recording can be read; one of another program counts as whole when its bytes are."""
    try:
        read_episode(path)
    except RecordingError as error:
        return "no episode of lfd" in str(error)
    except EpisodeError:
        return False
    return True


def _recover_file(path: Path) -> Recovered:
    target = path.with_name(path.name.removesuffix(".part"))
    if path != target and target.exists():
        return _nothing(path, f"{target.name} is there already; move one of them away")
    try:
        content, lost = salvage_mcap(path)
        _add_left_steps(content, read_journal(journal_of(target)))
        steps = _steps_of(content)
    except (RecordingError, *DAMAGE) as error:
        return _nothing(path, str(error))
    begin, end = _longest_run(steps.whole)
    if begin == end:
        return _nothing(path, "not one control step of it is whole")
    dropped = int(steps.whole.sum()) - (end - begin)
    note = f"cut off: {end - begin} steps from step {begin}, {lost} bytes could not be read"
    made = target.with_name(target.name.removesuffix(SUFFIX) + RECOVERED)
    _write(made, content, steps, begin, end, note)
    if path == target or dropped:
        path = path.rename(target.with_name(target.name + DAMAGED))
        made.rename(target)
    else:
        made.rename(target)
        path.unlink()
        journal_of(target).unlink(missing_ok=True)
    return Recovered(
        path=str(path), episode=str(target), steps=end - begin, dropped_steps=dropped, lost_bytes=lost, note=note
    )


def _add_left_steps(content: McapContent, left: LeftSteps | None) -> None:
    """Add the messages of the steps that a killed recording had not written yet."""
    if left is None or BEGIN not in content.metadata:
        return
    labels = tuple((name, tuple(names)) for name, names in json.loads(content.metadata[BEGIN]["labels"]).items())
    about = left.about
    signals = tuple((name, tuple(components)) for name, components in about["signals"])
    made = step_messages(labels, about["sim_size"], has_expert=about["has_expert"], signals=signals)
    written = {stamp for stamp, _ in content.messages.get(CHANNELS["reward"].topic, [])}
    for _, now, then, numbers in left.rows:
        if then in written or len(numbers) != made.size:
            continue
        for messages, stamp in ((made.early, now), (made.late, then)):
            for message in messages:
                told = Topic("cdr", message.schema, "ros2msg", b"", message.about)
                content.topics.setdefault(message.topic, told)
                data = message.pack(stamp, numbers[message.places])
                content.messages.setdefault(message.topic, []).append((stamp, data))
    for rows in content.messages.values():
        rows.sort(key=lambda row: row[0])


def _nothing(path: Path, why: str) -> Recovered:
    return Recovered(path=str(path), episode="", steps=0, dropped_steps=0, lost_bytes=path.stat().st_size, note=why)


@dataclass(frozen=True)
class _Steps:
    """Which control steps of a file are whole."""

    whole: Bool[np.ndarray, "T"]
    start_ns: int
    """Time of the first observation that was saved."""
    period_ns: float
    has_beginning: bool
    """Whether the first observation that was saved is the episode's first."""

    def of(self, stamp: int) -> int:
        """The step that a time belongs to."""
        return round((stamp - self.start_ns) / self.period_ns)


def _steps_of(content: McapContent) -> _Steps:
    """Step t is whole when action t, the observations t and t + 1 and what followed it are there.

    Raises `RecordingError` for a file that has lost what its messages mean.
    """
    if BEGIN not in content.metadata:
        raise RecordingError(f"its description {BEGIN!r} is lost")
    about = content.metadata[BEGIN]
    sim = CHANNELS["sim_state"].topic
    if not content.messages.get(sim):
        raise RecordingError("not one observation of it is whole")
    start, period = content.messages[sim][0][0], 1e9 / json.loads(about["control_hz"])
    begun = any(stamp == start for stamp, _ in content.messages.get("/task", []))
    seen = {sim} | {channel(name).topic for name in json.loads(about["labels"]) if name != "action"}
    seen |= {topic for topic, told in content.topics.items() if told.schema == IMAGE}
    decided = {CHANNELS["action"].topic} | ({CHANNELS["expert_action"].topic} & set(content.topics))
    count = 1 + round((content.messages[sim][-1][0] - start) / period)

    def present(topic: str) -> Bool[np.ndarray, "count"]:
        there = np.zeros(count, dtype=bool)
        at = [round((stamp - start) / period) for stamp, _ in content.messages.get(topic, [])]
        there[[step for step in at if 0 <= step < count]] = True
        return there

    observed = np.all([present(topic) for topic in seen], axis=0)
    acted = np.all([present(topic) for topic in decided], axis=0)
    after = present(CHANNELS["reward"].topic)
    return _Steps(observed[:-1] & observed[1:] & acted[:-1] & after[1:], start, period, begun)


def _longest_run(whole: Bool[np.ndarray, "T"]) -> tuple[int, int]:
    """Begin and end of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]])))
    if not len(edges):
        return 0, 0
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest])


def _write(path: Path, content: McapContent, steps: _Steps, begin: int, end: int, note: str) -> None:
    """Write the steps from `begin` to `end` as an episode of its own."""
    writer = McapWriter(path)
    for topic, told in content.topics.items():
        writer.channel(topic, told.schema, told.about)
    writer.metadata(BEGIN, {**content.metadata[BEGIN], "recovered": note})
    for name, data in content.attachments.items():
        if name != MEMORY or (begin == 0 and steps.has_beginning):  # it belongs to the episode's first observation
            writer.attachment(name, "", data, steps.start_ns)
    kept = _kept(content, steps, begin, end)
    for stamp, topic, data in kept:
        writer.message(topic, stamp, data)
    labels, rows = arrays([data for _, topic, data in kept if topic == CHANNELS["reward"].topic])
    columns = dict(zip(labels, rows.T, strict=True))
    facts = {"steps": end - begin, "success": False, "reward": columns["reward"].sum(), "failure": note}
    writer.metadata(END, {key: json.dumps(value) for key, value in facts.items()} | {"recovered": note})
    writer.finish()


def _kept(content: McapContent, steps: _Steps, begin: int, end: int) -> list[tuple[int, str, bytes]]:
    """The messages of some steps in the order of time: observations to `end`, what was decided to the step before."""
    late = {CHANNELS["reward"].topic}
    early = {"/gripper/command", *(CHANNELS[n].topic for n in ("action", "expert_action", "teleop_axes", "pace"))}
    kept = []
    for topic, messages in content.messages.items():
        for stamp, data in messages:
            at = steps.of(stamp)
            first, last = (begin + 1, end) if topic in late else (begin, end - (topic in early))
            if first <= at <= last:
                kept.append((stamp, topic, data))
    return sorted(kept, key=lambda message: message[0])
