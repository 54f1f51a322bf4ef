"""Episodes as MCAP files: the observer that records a rollout, and its reader.

Topics come from the table of channels. The observation of step t stands at time t / control_hz after the
episode's start; the action chosen in it at the same time; reward, success and done of step t at the next.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.artifact import versions
from lfd.core.channels import ARRAY, CHANNELS, IMAGE, JOINT_STATE, POSE, channel, signal_of
from lfd.core.episode import Episode, EpisodeMetadata, Signal
from lfd.core.errors import EpisodeError, RecordingError
from lfd.core.protocols import Observation, Transition, World, WorldSpec, WorldState
from lfd.core.rotations import wxyz_from_xyzw
from lfd.record import cdr
from lfd.record.columns import arrays, joint_states, poses
from lfd.record.journal import Journal, journal_of
from lfd.record.mcap_file import DAMAGE, SUFFIX, McapContent, metadata_of, read_mcap
from lfd.record.mcap_writing import McapWriter
from lfd.record.messages import Components, Labels, step_messages
from lfd.record.png import encode_png

FORMAT = "1"
BEGIN, END = "lfd.episode", "lfd.episode_end"
CAMERAS = CHANNELS["{camera}_picture"].topic.removesuffix("{camera}")
MODEL, MEMORY = "model.xml", "controller_memory.json"


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What a recording says of its run."""

    stage: str
    policy: str
    seed: int
    index: int
    recipe: Mapping[str, Any]


class McapRecorder:
    """Records one rollout to `path`.

    A failed episode is kept only when `keep_failures` says so. Raises `OutputError` when the place cannot be
    written.
    """

    def __init__(self, path: Path, origin: Origin, *, keep_failures: bool) -> None:
        self._path, self._origin, self._keep_failures = path, origin, keep_failures

    def begin(self, world: World, observation: Observation) -> None:
        spec, origin, state = world.spec, self._origin, world.get_state()
        self._writer = McapWriter(self._path)
        self._labels, self._hz = spec.labels, spec.control_hz
        self._topics = {name: channel(f"{name}_picture").topic for name in spec.cameras}
        self._steps, self._reward, self._failure = 0, 0.0, ""
        self._start_ns = time.time_ns()
        self._observed = [name for name in self._labels if name != "action"]
        self._key, self._sim_size = tuple(self._labels.items()), len(state.sim)
        self._journal: Journal | None = None
        """Steps that are not in the file yet."""
        self._kind: tuple[bool, Components] = False, ()
        """Whether those steps have an expert's action, and which signals."""
        first = step_messages(self._key, self._sim_size, has_expert=False, signals=()).late[1:]
        for message in first:
            self._writer.channel(message.topic, message.schema, message.about)
        for name, topic in self._topics.items():
            self._writer.channel(topic, IMAGE, {"unit": "1/255", "frame": name})
        self._writer.channel("/task", "std_msgs/msg/String", {})
        self._writer.channel("/events", "rcl_interfaces/msg/Log", {})
        write_about(self._writer, self._about(spec), self._labels, state, self._start_ns)
        self._writer.message("/task", self._start_ns, cdr.pack_string(spec.instruction))
        self._event(self._start_ns, "episode_begin", policy=origin.policy, seed=origin.seed, index=origin.index)
        numbers = np.concatenate([*(observation[name] for name in self._observed), state.sim])
        for message in first:
            self._writer.message(message.topic, self._start_ns, message.pack(self._start_ns, numbers[message.places]))
        self._write_pictures(self._start_ns, world)
        self._writer.flush()

    def step(self, world: World, transition: Transition) -> None:
        decision, result = transition.decision, transition.result
        now = self._start_ns + round(transition.step * 1e9 / self._hz)
        then = self._start_ns + round((transition.step + 1) * 1e9 / self._hz)
        numbers = [result.observation[name] for name in self._observed]
        numbers += [world.sim_state(), (result.reward, result.success, transition.done, decision.intervention)]
        numbers.append(decision.action)
        if decision.expert_action is not None:
            numbers.append(decision.expert_action)
        numbers += [list(components.values()) for components in decision.signals.values()]
        signals = tuple((name, tuple(components)) for name, components in decision.signals.items())
        kind = decision.expert_action is not None, signals
        if self._journal is None or kind != self._kind:
            self._begin_journal(kind)
        assert self._journal is not None
        self._journal.add(transition.step, (now, then), numbers)
        if self._journal.is_full:
            self._write_waiting()
        self._write_pictures(then, world)
        self._steps, self._reward = transition.step + 1, self._reward + result.reward
        self._failure = result.failure

    def end(self, success: bool) -> None:
        if not success and not self._keep_failures:
            self.abort()
            return
        self._write_waiting()
        now = self._start_ns + round(self._steps * 1e9 / self._hz)
        self._event(now, "episode_end", success=success, steps=self._steps, failure=self._failure)
        facts = {"steps": self._steps, "success": success, "reward": self._reward, "failure": self._failure}
        self._writer.metadata(END, {key: json.dumps(value) for key, value in facts.items()})
        self._writer.finish()
        self._end_journal()

    def abort(self) -> None:
        if hasattr(self, "_writer"):
            self._writer.discard()
            if self._journal is not None:
                self._journal.remove()
                self._journal = None

    def _about(self, spec: WorldSpec) -> EpisodeMetadata:
        origin = self._origin
        return EpisodeMetadata(
            task=spec.task,
            instruction=spec.instruction,
            robot=spec.robot,
            controller=spec.controller,
            policy=origin.policy,
            control_hz=spec.control_hz,
            stage=origin.stage,
            seed=origin.seed,
            index=origin.index,
            stepper=spec.stepper,
            started=datetime.fromtimestamp(self._start_ns / 1e9, UTC).isoformat(),
            versions=versions(),
            recipe=origin.recipe,
        )

    def _begin_journal(self, kind: tuple[bool, Components]) -> None:
        """Have a journal for steps with or without an expert's action, and with some signals."""
        self._end_journal()
        has_expert, signals = self._kind = kind
        about = {"has_expert": has_expert, "signals": signals, "sim_size": self._sim_size}
        self._messages = step_messages(self._key, self._sim_size, has_expert=has_expert, signals=signals)
        for message in self._messages.all:
            self._writer.channel(message.topic, message.schema, message.about)
        self._block = self._messages.block(tuple(self._writer.number(m.topic) for m in self._messages.all))
        self._journal = Journal(journal_of(self._path), self._messages.size, about)

    def _write_waiting(self) -> None:
        """Write the steps that wait, at a time: together they cost little more than one of them."""
        if self._journal is not None and self._journal.count:
            numbers, times = self._journal.take()
            self._writer.records(self._block.fill(numbers[:, self._messages.places], times))
            self._writer.flush()
            self._journal.clear()

    def _end_journal(self) -> None:
        if self._journal is not None:
            self._write_waiting()
            self._journal.remove()
            self._journal = None

    def _event(self, now: int, event: str, **facts: Any) -> None:
        self._writer.message("/events", now, cdr.pack_log(now, json.dumps({"event": event, **facts})))

    def _write_pictures(self, now: int, world: World) -> None:
        for name, picture in world.pictures().items():
            self._writer.message(self._topics[name], now, cdr.pack_image(now, name, encode_png(picture)))


def write_about(
    writer: McapWriter, about: EpisodeMetadata, labels: Labels, state: WorldState | None, start_ns: int
) -> None:
    """Write what an episode is: its metadata and, where there is one, the simulation that it began in."""
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in asdict(about).items()}
    writer.metadata(BEGIN, texts | {"format": FORMAT, "labels": json.dumps(labels)})
    if state is not None:
        memory = {key: value.tolist() for key, value in state.memory.items()}
        writer.attachment(MODEL, "application/xml", state.model_xml.encode(), start_ns)
        writer.attachment(MEMORY, "application/json", json.dumps(memory).encode(), start_ns)


def read_episode(path: Path) -> Episode:
    """The episode that `McapRecorder` wrote to `path`.

    Raises `RecordingError` for a file that is damaged, of another schema or incomplete, naming the file and
    the topic, and `EpisodeError` for numbers that are no episode.
    """
    return episode_of(read_mcap(path), path)


def recipe_in(path: Path) -> dict[str, Any]:
    """The recipe that a recording keeps; nothing for a file that is none, or cannot be read."""
    try:
        return json.loads(metadata_of(path).get(BEGIN, {}).get("recipe", "{}"))
    except RecordingError:
        return {}


def episode_of(content: McapContent, path: Path, *, with_states: bool = True) -> Episode:
    """The episode in the content of the file `path`, with or without the simulation's states, which are most of it.

    Raises what `read_episode` does.
    """
    if BEGIN not in content.metadata:
        raise RecordingError(f"{path} is an MCAP file, but no episode of lfd: it has no metadata {BEGIN!r}")
    if END not in content.metadata:
        raise RecordingError(f"{path} was never finished: it has no metadata {END!r}; try `lfd recover {path.parent}`")
    about = dict(content.metadata[BEGIN])
    if about.get("format") != FORMAT:
        raise RecordingError(f"{path} has format {about.get('format')!r}, this lfd reads {FORMAT!r}")
    try:
        return _decode(content, about, with_states)
    except EpisodeError as error:
        raise EpisodeError(f"{path}: {error}; leave the file out") from error
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except DAMAGE as error:
        raise RecordingError(f"{path} cannot be decoded as an episode ({error}); leave the file out") from error


def _decode(content: McapContent, about: dict[str, str], with_states: bool) -> Episode:
    labels = {name: tuple(names) for name, names in json.loads(about["labels"]).items()}
    kinds = {f.name: f.type for f in fields(EpisodeMetadata)}
    metadata: dict[str, Any] = {
        key: about[key] if kind is str else json.loads(about[key])
        for key, kind in kinds.items()
        if key != "recovered" or key in about
    }
    step_names, steps = arrays(_data(content, "/step"))
    columns = dict(zip(step_names, steps.T, strict=True))
    stamps = np.array([stamp for stamp, _ in _messages(content, "/joint_states")], dtype=np.int64)
    return Episode(
        times=(stamps - stamps[0]) / 1e9,
        observations=_observed(content, labels),
        actions=arrays(_data(content, "/action"))[1],
        rewards=columns["reward"],
        successes=columns["success"] > 0.5,
        interventions=columns["intervention"] > 0.5,
        expert_actions=_expert_actions(content),
        sim_states=arrays(_data(content, "/sim/state"))[1] if with_states else None,
        pictures={
            topic.removeprefix(CAMERAS): tuple(cdr.unpack_image(data) for _, data in messages)
            for topic, messages in content.messages.items()
            if topic.startswith(CAMERAS)
        },
        labels=labels,
        signals={
            name: _signal(messages, int(stamps[0]))
            for topic, messages in content.messages.items()
            if (name := signal_of(topic)) is not None and name not in labels and messages
        },
        metadata=EpisodeMetadata(**metadata),
        model_xml=content.attachments[MODEL].decode(),
        declared=json.loads(content.metadata[END].get("success", "null")),
        start_memory=_memory(content.attachments.get(MEMORY)),
    )


def _signal(messages: list[tuple[int, bytes]], start_ns: int) -> Signal:
    names, values = arrays([data for _, data in messages])
    return Signal((np.array([stamp for stamp, _ in messages], dtype=np.int64) - start_ns) / 1e9, values, names)


def _memory(attached: bytes | None) -> Mapping[str, np.ndarray] | None:
    return None if attached is None else {key: np.array(value) for key, value in json.loads(attached).items()}


def _messages(content: McapContent, topic: str) -> list[tuple[int, bytes]]:
    if topic not in content.messages:
        raise RecordingError(f"topic {topic} is missing; it has {', '.join(sorted(content.messages))}")
    return content.messages[topic]


def _data(content: McapContent, topic: str) -> list[bytes]:
    return [data for _, data in _messages(content, topic)]


def _expert_actions(content: McapContent) -> np.ndarray | None:
    """A row for each step, of NaN where the expert was not asked: its message has the time of the action."""
    expert = CHANNELS["expert_action"].topic
    if expert not in content.messages:
        return None
    steps = np.array([stamp for stamp, _ in _messages(content, "/action")], dtype=np.int64)
    asked = np.array([stamp for stamp, _ in _messages(content, expert)], dtype=np.int64)
    strange = np.setdiff1d(asked, steps)
    if len(strange):
        raise RecordingError(f"topic {expert} has a message at {strange[0]} ns, when there is no action")
    said = arrays(_data(content, expert))[1]
    rows = np.full((len(steps), said.shape[1]), np.nan)
    rows[np.searchsorted(steps, asked)] = said
    return rows


def _observed(content: McapContent, labels: Labels) -> dict[str, np.ndarray]:
    """The observation's channels; a topic that holds several of them is decoded once."""
    decoded: dict[str, Any] = {}
    found = {}
    for name, components in labels.items():
        if name == "action":
            continue
        row = channel(name)
        if row.topic not in decoded:
            decoded[row.topic] = DECODERS[row.schema](_data(content, row.topic))
        if row.schema == POSE:
            rows = decoded[row.topic]
            found[name] = rows[:, :3] if row.field == "position" else wxyz_from_xyzw(rows[:, 3:])
        elif row.schema == ARRAY:
            found[name] = decoded[row.topic][1]
        else:
            names, states = decoded[row.topic]
            which = ("position", "velocity", "effort").index(row.field)
            found[name] = states[:, which][:, [names.index(label) for label in components]]
    return found


DECODERS: Mapping[str, Callable[[list[bytes]], Any]] = {POSE: poses, ARRAY: arrays, JOINT_STATE: joint_states}
"""Message type to what makes columns of its messages."""


def recordings_in(sources: list[Path]) -> list[Path]:
    """The recordings among files and folders, folders in the order of names.

    Raises `RecordingError` when a source does not exist or holds none.
    """
    found: list[Path] = []
    for source in sources:
        inside = sorted(source.rglob(f"*{SUFFIX}")) if source.is_dir() else [source]
        if not inside:
            raise RecordingError(f"{source} holds no {SUFFIX} file; `lfd record RECIPE --out {source}` makes some")
        found += inside
    return list({path.resolve(): path for path in found}.values())  # a file and its folder may both be given


def recording_in(source: Path, index: int) -> Path:
    """The recording `source`, or number `index` of the folder `source`.

    Raises `RecordingError` when there is none.
    """
    paths = recordings_in([source])
    if not 0 <= index < len(paths):
        raise RecordingError(f"{source} has episodes 0 to {len(paths) - 1}, not {index}; choose with --episode")
    return paths[index]
