import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfd.core.protocols import Verdict
from lfd.experts.device import DeviceState
from lfd.experts.keys import Word
from lfd.experts.pushing import LEVER_M, DevicePerson, RecordedPerson, _turn, bounded


def test_a_bounded_vector_keeps_its_direction() -> None:
    np.testing.assert_allclose(bounded(np.array([3.0, 0.0, 4.0]), 2.5), [1.5, 0.0, 2.0])
    np.testing.assert_array_equal(bounded(np.array([1.0, 0.0, 0.0]), 2.5), [1.0, 0.0, 0.0])


def test_the_turn_takes_one_direction_to_the_other(rng) -> None:
    for _ in range(5):
        one, other = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        np.testing.assert_allclose(Rotation.from_rotvec(_turn(one, other)).apply(one), other, atol=1e-12)
    up = np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(_turn(up, up), np.zeros(3))


def test_recorded_pushes_are_those_of_their_times() -> None:
    wrenches = np.arange(18.0).reshape(3, 6)
    person = RecordedPerson("again", np.array([0.0, 0.1, 0.2]), wrenches)
    person.reset(np.random.default_rng(0))
    np.testing.assert_array_equal(person.wrench(0.0, {}), wrenches[0])
    np.testing.assert_array_equal(person.wrench(0.15, {}), wrenches[1])
    np.testing.assert_array_equal(person.wrench(0.2, {}), wrenches[2])


class Stick:
    """A device that is held to one side."""

    name = "stick"

    def __init__(self, *words: Word):
        self.words = words

    def read(self) -> DeviceState:
        return DeviceState(translation=np.array([1.0, 0.0, 0.5]), rotation=np.array([0.0, 0.5, 0.0]), words=self.words)


@pytest.mark.parametrize(("frame", "along"), [("view", -1.0), ("base", 1.0)])
def test_a_device_pushes_in_the_direction_that_its_person_sees(frame, along) -> None:
    person = DevicePerson(Stick(), frame, 40.0)
    person.reset(np.random.default_rng(0))
    wanted = [along * 40.0, 0.0, 20.0, 0.0, along * 0.5 * 40.0 * LEVER_M, 0.0]
    np.testing.assert_allclose(person.wrench(0.0, {}), wanted)
    assert person.verdict() is None


def test_a_word_at_the_device_ends_the_run() -> None:
    person = DevicePerson(Stick(Word.FASTER, Word.DISCARD), "view", 40.0)
    person.reset(np.random.default_rng(0))
    person.wrench(0.0, {})
    assert person.verdict() is Verdict.DISCARD
