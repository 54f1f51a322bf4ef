"""Our CDR against mcap-ros2-support, which decodes by the definitions that stand in the file."""

import numpy as np
import pytest

from lfd.record import cdr


def decoded(message_type: str, data: bytes):
    from mcap_ros2._dynamic import generate_dynamic

    return generate_dynamic(message_type, cdr.schema_text(message_type))[message_type](data)


def test_every_message_is_read_by_another_decoder(rng) -> None:
    state = cdr.JointState(("a", "joint_2"), *rng.normal(size=(3, 2)))
    theirs = decoded("sensor_msgs/msg/JointState", cdr.pack_joint_state(3_000_000_007, state))
    assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == (3, 7)
    assert tuple(theirs.name) == state.name
    np.testing.assert_array_equal(theirs.velocity, state.velocity)

    position, xyzw = rng.normal(size=3), rng.normal(size=4)
    pose = decoded("geometry_msgs/msg/PoseStamped", cdr.pack_pose(1, position, xyzw))
    assert pose.header.frame_id == "world"
    assert (pose.pose.position.z, pose.pose.orientation.w) == (position[2], xyzw[3])

    tree = decoded("tf2_msgs/msg/TFMessage", cdr.pack_transforms(1, [("ee", position, xyzw), ("cube", position, xyzw)]))
    assert [frame.child_frame_id for frame in tree.transforms] == ["ee", "cube"]
    assert tree.transforms[1].transform.rotation.x == xyzw[0]

    array = decoded("std_msgs/msg/Float64MultiArray", cdr.pack_array(("x", "y", "z"), position))
    assert array.layout.dim[0].label == "x,y,z"
    np.testing.assert_array_equal(array.data, position)

    log = decoded("rcl_interfaces/msg/Log", cdr.pack_log(5, '{"event": "episode_begin"}'))
    assert (log.level, log.name, log.msg, log.line) == (20, "lfd", '{"event": "episode_begin"}', 0)
    assert decoded("std_msgs/msg/String", cdr.pack_string("lift the cube")).data == "lift the cube"


def test_what_is_packed_is_unpacked_to_the_bit(rng) -> None:
    state = cdr.JointState(("a", "bc", "def"), *rng.normal(size=(3, 3)))
    back = cdr.unpack_joint_state(cdr.pack_joint_state(1, state))
    assert back.name == state.name
    np.testing.assert_array_equal(back.effort, state.effort)
    labels, values = cdr.unpack_array(cdr.pack_array(("x", "y"), state.position[:2]))
    assert labels == ("x", "y")
    np.testing.assert_array_equal(values, state.position[:2])
    position, xyzw = cdr.unpack_pose(cdr.pack_pose(1, state.position, rng.normal(size=4)))
    np.testing.assert_array_equal(position, state.position)
    assert xyzw.shape == (4,)


def test_messages_that_end_too_soon_are_refused(rng) -> None:
    whole = cdr.pack_pose(1, rng.normal(size=3), rng.normal(size=4))
    for size in range(len(whole)):
        with pytest.raises(ValueError, match="header|ends after|unpack"):
            cdr.unpack_pose(whole[:size])
