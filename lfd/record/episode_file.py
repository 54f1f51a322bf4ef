"""Episodes as MCAP files: the observer that records a rollout, and its reader.

Topics come from the table of channels. The observation of step t stands at time t / control_hz after the
episode's start; the action chosen in it at the same time; reward, success and done of step t at the next.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.artifact import versions
from lfd.core.channels import ARRAY, CHANNELS, IMAGE, JOINT_STATE, POSE, channel
from lfd.core.episode import Episode, EpisodeMetadata
from lfd.core.errors import EpisodeError, RecordingError
from lfd.core.protocols import Observation, Transition, World
from lfd.core.rotations import wxyz_from_xyzw, xyzw_from_wxyz
from lfd.record import cdr
from lfd.record.mcap_file import DAMAGE, SUFFIX, McapContent, McapWriter, read_mcap
from lfd.record.png import encode_png

FORMAT = "1"
STEP_LABELS = ("reward", "success", "done", "intervention")
JOINT_KINDS = ("joint", "gripper")
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
        spec, origin = world.spec, self._origin
        self._writer = McapWriter(self._path)
        self._labels, self._hz = spec.labels, spec.control_hz
        self._rows = {name: channel(name) for name in spec.labels if name != "action"}
        self._topics = {name: channel(f"{name}_picture").topic for name in spec.cameras}
        names = spec.labels["action"]
        self._grip_at = [at for at, name in enumerate(names) if name.endswith("gripper")]
        self._grips = [names[at] for at in self._grip_at]
        self._start_ns = time.time_ns()
        about = EpisodeMetadata(
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
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in asdict(about).items()}
        self._writer.metadata(BEGIN, texts | {"format": FORMAT, "labels": json.dumps(self._labels)})
        state = world.get_state()
        memory = {key: value.tolist() for key, value in state.memory.items()}
        self._writer.attachment(MODEL, "application/xml", state.model_xml.encode(), self._start_ns)
        self._writer.attachment(MEMORY, "application/json", json.dumps(memory).encode(), self._start_ns)
        self._announce()
        self._writer.message("/task", self._start_ns, cdr.pack_string(spec.instruction))
        self._event(self._start_ns, "episode_begin", policy=origin.policy, seed=origin.seed, index=origin.index)
        self._write_observation(self._start_ns, observation, state.sim)
        self._write_pictures(self._start_ns, world)
        self._steps, self._reward, self._failure = 0, 0.0, ""

    def step(self, world: World, transition: Transition) -> None:
        now = self._start_ns + round(transition.step * 1e9 / self._hz)
        then = self._start_ns + round((transition.step + 1) * 1e9 / self._hz)
        decision, result = transition.decision, transition.result
        names = self._labels["action"]
        self._writer.message("/action", now, cdr.pack_array(names, decision.action))
        if self._grips:
            self._writer.message("/gripper/command", now, cdr.pack_array(self._grips, decision.action[self._grip_at]))
        if decision.expert_action is not None:
            self._writer.message(CHANNELS["expert_action"].topic, now, cdr.pack_array(names, decision.expert_action))
        numbers = np.array([result.reward, result.success, transition.done, decision.intervention], dtype=float)
        self._writer.message("/step", then, cdr.pack_array(STEP_LABELS, numbers))
        self._write_observation(then, result.observation, world.sim_state())
        self._write_pictures(then, world)
        self._steps, self._reward = transition.step + 1, self._reward + result.reward
        self._failure = result.failure

    def end(self, success: bool) -> None:
        if not success and not self._keep_failures:
            self._writer.discard()
            return
        now = self._start_ns + round(self._steps * 1e9 / self._hz)
        self._event(now, "episode_end", success=success, steps=self._steps, failure=self._failure)
        facts = {"steps": self._steps, "success": success, "reward": self._reward, "failure": self._failure}
        self._writer.metadata(END, {key: json.dumps(value) for key, value in facts.items()})
        self._writer.finish()

    def abort(self) -> None:
        if hasattr(self, "_writer"):
            self._writer.discard()

    def _announce(self) -> None:
        for row in (*self._rows.values(), *(channel(name) for name in ("sim_state", "action", "expert_action"))):
            self._writer.channel(row.topic, row.schema, {"unit": row.unit, "frame": row.frame})
        for name, topic in self._topics.items():
            self._writer.channel(topic, IMAGE, {"unit": "1/255", "frame": name})
        self._writer.channel("/step", CHANNELS["reward"].schema, {"unit": "1", "frame": "task"})
        self._writer.channel("/gripper/command", CHANNELS["action"].schema, {"unit": "controller"})
        self._writer.channel("/tf", "tf2_msgs/msg/TFMessage", {"unit": "m", "frame": "world"})
        self._writer.channel("/task", "std_msgs/msg/String", {})
        self._writer.channel("/events", "rcl_interfaces/msg/Log", {})

    def _event(self, now: int, event: str, **facts: Any) -> None:
        self._writer.message("/events", now, cdr.pack_log(now, json.dumps({"event": event, **facts})))

    def _write_observation(self, now: int, seen: Observation, sim_state: np.ndarray) -> None:
        kinds = [joints for joints in JOINT_KINDS if f"{joints}_pos" in self._labels]  # not every arm has a gripper

        def joined(kind: str) -> np.ndarray:
            return np.concatenate([seen[f"{joints}_{kind}"] for joints in kinds])

        names = tuple(n for joints in kinds for n in self._labels[f"{joints}_pos"])
        state = cdr.JointState(names, joined("pos"), joined("vel"), joined("effort"))
        self._writer.message("/joint_states", now, cdr.pack_joint_state(now, state))
        frames = []
        for name, row in self._rows.items():
            if row.schema == POSE and row.field == "position":
                body = name.removesuffix("_pos")
                pose = seen[name], xyzw_from_wxyz(seen[f"{body}_quat"])
                self._writer.message(row.topic, now, cdr.pack_pose(now, *pose))
                frames.append((body, *pose))
            elif row.schema == ARRAY:
                self._writer.message(row.topic, now, cdr.pack_array(self._labels[name], seen[name]))
        self._writer.message("/tf", now, cdr.pack_transforms(now, frames))
        self._writer.message("/sim/state", now, cdr.pack_array(("mjSTATE_INTEGRATION",), sim_state))

    def _write_pictures(self, now: int, world: World) -> None:
        for name, picture in world.pictures().items():
            self._writer.message(self._topics[name], now, cdr.pack_image(now, name, encode_png(picture)))


def read_episode(path: Path) -> Episode:
    """The episode that `McapRecorder` wrote to `path`.

    Raises `RecordingError` for a file that is damaged, of another schema or incomplete, naming the file and
    the topic, and `EpisodeError` for numbers that are no episode.
    """
    content = read_mcap(path)
    if BEGIN not in content.metadata:
        raise RecordingError(f"{path} is an MCAP file, but no episode of lfd: it has no metadata {BEGIN!r}")
    if END not in content.metadata:
        raise RecordingError(f"{path} was never finished: it has no metadata {END!r}; record the episode again")
    about = dict(content.metadata[BEGIN])
    if about.get("format") != FORMAT:
        raise RecordingError(f"{path} has format {about.get('format')!r}, this lfd reads {FORMAT!r}")
    try:
        return _decode(content, about)
    except EpisodeError as error:
        raise EpisodeError(f"{path}: {error}; leave the file out") from error
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except DAMAGE as error:
        raise RecordingError(f"{path} cannot be decoded as an episode ({error}); leave the file out") from error


def _decode(content: McapContent, about: dict[str, str]) -> Episode:
    labels = {name: tuple(names) for name, names in json.loads(about["labels"]).items()}
    kinds = {f.name: f.type for f in fields(EpisodeMetadata)}
    metadata: dict[str, Any] = {
        key: about[key] if kind is str else json.loads(about[key]) for key, kind in kinds.items()
    }
    step_names, steps = _array(content, "/step")
    columns = dict(zip(step_names, steps.T, strict=True))
    stamps = np.array([stamp for stamp, _ in _messages(content, "/joint_states")], dtype=np.int64)
    expert = CHANNELS["expert_action"].topic
    return Episode(
        times=(stamps - stamps[0]) / 1e9,
        observations={name: _observed(content, name, labels[name]) for name in labels if name != "action"},
        actions=_array(content, "/action")[1],
        rewards=columns["reward"],
        successes=columns["success"] > 0.5,
        interventions=columns["intervention"] > 0.5,
        expert_actions=_array(content, expert)[1] if expert in content.messages else None,
        sim_states=_array(content, "/sim/state")[1],
        pictures={
            topic.removeprefix(CAMERAS): tuple(cdr.unpack_image(data) for _, data in messages)
            for topic, messages in content.messages.items()
            if topic.startswith(CAMERAS)
        },
        labels=labels,
        metadata=EpisodeMetadata(**metadata),
        model_xml=content.attachments[MODEL].decode(),
        start_memory={k: np.array(v) for k, v in json.loads(content.attachments[MEMORY]).items()},
    )


def _messages(content: McapContent, topic: str) -> list[tuple[int, bytes]]:
    if topic not in content.messages:
        raise RecordingError(f"topic {topic} is missing; it has {', '.join(sorted(content.messages))}")
    return content.messages[topic]


def _array(content: McapContent, topic: str) -> tuple[tuple[str, ...], np.ndarray]:
    decoded = [cdr.unpack_array(data) for _, data in _messages(content, topic)]
    return decoded[0][0], np.array([values for _, values in decoded])


def _observed(content: McapContent, name: str, labels: tuple[str, ...]) -> np.ndarray:
    row = channel(name)
    messages = _messages(content, row.topic)
    if row.schema == POSE:
        poses = [cdr.unpack_pose(data) for _, data in messages]
        position, orientation = np.array([p for p, _ in poses]), np.array([q for _, q in poses])
        return position if row.field == "position" else wxyz_from_xyzw(orientation)
    if row.schema == ARRAY:
        return _array(content, row.topic)[1]
    assert row.schema == JOINT_STATE
    states = [cdr.unpack_joint_state(data) for _, data in messages]
    columns = [states[0].name.index(label) for label in labels]
    return np.array([getattr(state, row.field) for state in states])[:, columns]


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
