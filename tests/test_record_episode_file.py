import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from lfd.core.channels import channel
from lfd.core.errors import EpisodeError, OutputError, RecordingError
from lfd.core.protocols import Decision
from lfd.experts.playback import PlaybackPolicy
from lfd.record import cdr
from lfd.record.episode_file import McapRecorder, Origin, read_episode, recordings_in
from lfd.record.mcap_file import read_mcap
from lfd.record.mcap_writing import McapWriter
from lfd.worlds.rollout import rollout

ORIGIN = Origin(stage="record", policy="test", seed=1, index=2, recipe={})


def record_steps(world, path: Path, actions: np.ndarray) -> list[dict]:
    """Record given actions; returns the observations as the world gave them."""
    seen = []

    class Watch:
        def begin(self, world, observation):
            seen.append(observation)

        def step(self, world, transition):
            seen.append(transition.result.observation)

        def end(self, success):
            pass

        def abort(self):
            pass

    recorder = McapRecorder(path, ORIGIN, keep_failures=True)
    rollout(
        world,
        PlaybackPolicy(actions),
        [Watch(), recorder],
        np.random.default_rng(8),
        horizon=len(actions),
        hold_steps=len(actions) + 1,
    )
    return seen


def test_an_episode_is_read_back_to_the_bit(lift_world, tmp_path, rng) -> None:
    path, actions = tmp_path / "episode.mcap", rng.uniform(-1, 1, (6, 7))
    seen = record_steps(lift_world, path, actions)
    episode = read_episode(path)
    np.testing.assert_array_equal(episode.actions, actions)
    for name, values in episode.observations.items():
        np.testing.assert_array_equal(values, [observation[name] for observation in seen], err_msg=name)
    np.testing.assert_allclose(episode.times, np.arange(7) / 20, atol=1e-9)
    assert episode.sim_states is not None
    np.testing.assert_array_equal(episode.sim_states[-1], lift_world.sim_state())
    assert episode.expert_actions is None
    assert episode.labels == lift_world.spec.labels
    assert (episode.metadata.seed, episode.metadata.index, episode.metadata.stepper) == (1, 2, lift_world.step_backend)
    assert '"robosuite/models/assets' in episode.model_xml
    assert "/site-packages/" not in episode.model_xml
    assert list(tmp_path.iterdir()) == [path]


def test_a_standard_ros2_reader_understands_the_file(thread) -> None:
    path = recordings_in([thread.recordings])[0]
    topics: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            topics.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
        assert {record.name for record in reader.iter_metadata()} == {"lfd.episode", "lfd.episode_end"}
        assert "model.xml" in {record.name for record in reader.iter_attachments()}
    episode = read_episode(path)
    for topic in ("/joint_states", "/ee_pose", "/tf", "/sim/state", "/objects/cube/pose"):
        assert len(topics[topic]) == len(episode) + 1
    for topic in ("/action", "/gripper/command", "/step", "/expert/action"):
        assert len(topics[topic]) == len(episode)
    assert topics["/task"][0][2].data == "lift the red cube off the table"
    schema, _, first = topics["/joint_states"][0]
    assert schema == "sensor_msgs/msg/JointState"
    assert list(first.name)[-1] == "gripper0_right_finger_joint2"
    events = [json.loads(log.msg)["event"] for _, _, log in topics["/events"]]
    assert events == ["episode_begin", "episode_end"]
    stamps = np.diff([stamp for _, stamp, _ in topics["/joint_states"]])
    np.testing.assert_allclose(stamps, 5e7, atol=1)


def test_failures_are_thrown_away_unless_wanted(lift_world, tmp_path) -> None:
    class Still:
        name = "still"

        def reset(self, rng):
            pass

        def act(self, observation):
            return Decision(np.zeros(7))

    for keep in (False, True):
        recorder = McapRecorder(tmp_path / "episode.mcap", ORIGIN, keep_failures=keep)
        outcome = rollout(lift_world, Still(), [recorder], np.random.default_rng(0), horizon=3, hold_steps=1)
        assert not outcome.success
        assert [p.name for p in tmp_path.iterdir()] == (["episode.mcap"] if keep else [])


def test_an_interrupted_episode_leaves_nothing(lift_world, tmp_path) -> None:
    class Stops:
        name = "stops"

        def reset(self, rng):
            pass

        def act(self, observation):
            raise KeyboardInterrupt

    recorder = McapRecorder(tmp_path / "episode.mcap", ORIGIN, keep_failures=True)
    with pytest.raises(KeyboardInterrupt):
        rollout(lift_world, Stops(), [recorder], np.random.default_rng(0), horizon=3, hold_steps=1)
    assert list(tmp_path.iterdir()) == []


def test_a_vanished_folder_is_said(lift_world, tmp_path) -> None:
    recorder = McapRecorder(tmp_path / "gone" / "episode.mcap", ORIGIN, keep_failures=True)
    with pytest.raises(OutputError, match=r"cannot write .*episode.mcap.part: No such file or directory"):
        rollout(
            lift_world, PlaybackPolicy(np.zeros((1, 7))), [recorder], np.random.default_rng(0), horizon=1, hold_steps=1
        )


@pytest.fixture
def whole(thread) -> bytes:
    return recordings_in([thread.recordings])[0].read_bytes()


def test_damaged_files_are_refused_wherever_the_damage_is(whole, tmp_path, rng) -> None:
    """Either the file is refused, or the flipped bit was one that no number depends on."""
    path = tmp_path / "episode.mcap"
    path.write_bytes(whole)
    reference = read_episode(path)
    refused = 0
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            episode = read_episode(path)
        except (RecordingError, EpisodeError):
            refused += 1
        else:
            np.testing.assert_array_equal(episode.actions, reference.actions)
            np.testing.assert_array_equal(episode.sim_states, reference.sim_states)
    assert refused > 0
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(RecordingError, match=r"episode.mcap is truncated, damaged or no MCAP file"):
            read_episode(path)
    path.write_bytes(rng.bytes(5000))
    with pytest.raises(RecordingError, match="no MCAP file"):
        read_episode(path)


def test_an_mcap_file_of_another_schema_is_refused(tmp_path) -> None:
    path = tmp_path / "other.mcap"
    writer = Writer(str(path))
    writer.start()
    schema = writer.register_schema("thing", "jsonschema", b"{}")
    channel = writer.register_channel("/thing", "json", schema)
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    with pytest.raises(RecordingError, match=r"other.mcap is an MCAP file, but no episode of lfd"):
        read_episode(path)


def rewrite(path: Path, topic: str, row: int, data: bytes | None) -> None:
    """The recording with one message replaced, or left out."""
    content = read_mcap(path)
    writer = McapWriter(path)
    for name in ("joint_pos", "ee_pos", "cube_pos", "action", "reward", "sim_state"):
        written = channel(name).topic
        writer.channel(written, channel(name).schema, {})
        for number, (stamp, original) in enumerate(content.messages[written]):
            changed = data if (written, number) == (topic, row) else original
            if changed is not None:
                writer.message(written, stamp, changed)
    for name, values in content.metadata.items():
        writer.metadata(name, values)
    for name, attached in content.attachments.items():
        writer.attachment(name, "", attached, 0)
    writer.finish()


def test_numbers_that_are_no_episode_are_refused_with_their_place(lift_world, tmp_path) -> None:
    path = tmp_path / "episode.mcap"
    record_steps(lift_world, path, np.zeros((3, 7)))
    rewrite(path, "/action", 1, cdr.pack_array(("a",) * 7, np.full(7, np.nan)))
    with pytest.raises(
        EpisodeError, match=r"episode.mcap: channel 'action' is not finite at step 1; leave the file out"
    ):
        read_episode(path)
    record_steps(lift_world, path, np.zeros((3, 7)))
    rewrite(path, "/ee_pose", 2, None)
    with pytest.raises(EpisodeError, match=r"episode.mcap: channel 'ee_pos' has 3 rows, 3 actions need 4"):
        read_episode(path)
    record_steps(lift_world, path, np.zeros((3, 7)))
    rewrite(path, "/action", 0, cdr.pack_array(("a",) * 5, np.zeros(5)))
    with pytest.raises(RecordingError, match=r"episode.mcap cannot be decoded as an episode"):
        read_episode(path)


def test_recordings_given_twice_count_once(thread) -> None:
    paths = recordings_in([thread.recordings])
    assert recordings_in([paths[1], thread.recordings]) == [paths[1], paths[0]]
    with pytest.raises(RecordingError, match="no recording"):
        read_episode(thread.recordings / "episode_000099.mcap")
