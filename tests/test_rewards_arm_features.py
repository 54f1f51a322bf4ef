from dataclasses import replace

import numpy as np
import pytest

from lfd.core.errors import InputError, UnknownName
from lfd.rewards.arm_features import (
    ARM_FEATURES,
    CHANNELS,
    STATE,
    Places,
    Spot,
    arm_features,
    decision_rows,
    table_force,
)

PLACES = Places(
    table_height=0.8,
    person=Spot(np.array([0.3, 0.1, 1.1]), 0.5),
    laptop=Spot(np.array([-0.1, 0.0, 0.8]), 0.3),
    goal=np.array([0.0, 0.3, 1.0]),
    obstacle=Spot(np.array([0.1, -0.1, 0.9]), 0.3),
)


def channels(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Random numbers about where the places are."""
    wide = {"gripper": 3, "elbow": 3, "cup_axis": 3, "gripper_velocity": 3}
    drawn = {name: 0.3 * rng.standard_normal((4, 9, wide.get(name, 7))) for name in CHANNELS}
    for name in ("gripper", "elbow"):
        drawn[name] += np.array([0.1, 0.05, 0.95])
    return drawn


@pytest.mark.parametrize("name", ARM_FEATURES)
def test_slopes_are_differences(name: str, rng: np.random.Generator) -> None:
    feature, drawn, step = ARM_FEATURES[name], channels(rng), 1e-6
    given = [drawn[channel] for channel in feature.channels]
    value, slopes = feature.function(PLACES, *given)
    assert value.shape == (4, 9)
    assert np.ptp(value) > 0
    for place, slope in enumerate(slopes):
        assert slope.shape == given[place].shape
        for axis in range(slope.shape[-1]):
            aside = step * np.eye(slope.shape[-1])[axis]
            more, less = (
                feature.function(PLACES, *given[:place], given[place] + sign * aside, *given[place + 1 :])[0]
                for sign in (1, -1)
            )
            np.testing.assert_allclose(slope[..., axis], (more - less) / (2 * step), atol=1e-5, rtol=1e-6)


def of(name: str, *vectors: list[float]) -> float:
    value, _ = ARM_FEATURES[name].function(PLACES, *(np.array([[vector]]) for vector in vectors))
    return float(value[0, 0])


def test_values_in_closed_form() -> None:
    assert of("table_distance", [0.0, 0.0, 1.05]) == pytest.approx(0.25)
    assert of("elbow_table_distance", [0.0, 0.0, 0.7]) == pytest.approx(-0.1)
    assert of("person_closeness", [0.3, 0.1, 1.1]) == 1.0
    assert of("person_closeness", [0.3, 0.1, 1.1 - 0.25]) == pytest.approx(0.75**2)
    assert of("person_closeness", [0.3, 0.61, 1.1]) == 0.0
    assert of("laptop_closeness", [-0.1, 0.15, 99.0]) == pytest.approx(0.75**2)  # height does not matter
    assert of("obstacle_closeness", [0.1, -0.1, 0.9]) == 1.0
    assert of("cup_tilt", [0.0, 0.0, 1.0]) == 0.0
    assert of("cup_tilt", [0.0, np.sin(1.0), np.cos(1.0)]) == pytest.approx(1 - np.cos(1.0))
    assert of("goal_distance", [0.0, 0.0, 1.0]) == pytest.approx(0.3, abs=1.1e-3)
    assert of("goal_distance", [0.0, 0.3, 1.0]) == 0.0
    assert of("gripper_speed", [0.3, 0.0, 0.4]) == pytest.approx(0.25)
    assert of("path_length", [0.3, 0.0, 0.4]) == pytest.approx(0.5, abs=1.1e-3)
    assert of("joint_speed", [1.0, 2.0]) == 5.0
    assert of("joint_effort", [0.5, 0.5]) == 0.5
    assert of("joint_jerk", [1.0, -3.0]) == 10.0
    np.testing.assert_allclose(table_force(np.array([[3.0, 0.0, 4.0]])), [5.0])


def test_decision_rows_sum_to_the_integral_whatever_the_number_of_waypoints() -> None:
    """The height z = 0.8 + t^2 over 2 s: 8/3 m s, by the trapezoid rule off by 2 dt^2 / 6; its speed 2t: 4 m."""
    for waypoints in (11, 201):
        time = np.linspace(0, 2, waypoints)
        gripper = np.zeros((1, waypoints, 3))
        gripper[0, :, 2] = 0.8 + time**2
        dt = time[1]
        known = {"gripper": gripper, "gripper_velocity": np.diff(gripper, axis=1) / dt}
        rows = decision_rows(arm_features(["table_distance", "path_length"]), PLACES, known, dt)
        assert rows.shape == (1, waypoints - 1, 2)
        counts = rows.sum(axis=1)[0]
        assert counts[0] == pytest.approx(8 / 3 + dt**2 / 3)
        assert counts[1] == pytest.approx(4.0, abs=2.1e-3)


def test_the_table_is_complete() -> None:
    for name, feature in ARM_FEATURES.items():
        assert feature.name == name == feature.function.__name__
        assert set(feature.channels) <= set(CHANNELS)
        assert f"[{feature.unit}]" in str(feature.function.__doc__) or feature.unit == "1"
        assert feature.rows == STATE or feature.channels[0].endswith(("velocity", "jerk"))


def test_unknown_missing_and_repeated_names_are_refused() -> None:
    with pytest.raises(UnknownName, match="unknown arm feature 'cup_tild'.*Did you mean 'cup_tilt'"):
        arm_features(["cup_tild"])
    with pytest.raises(InputError, match="one feature or more, each once"):
        arm_features(["cup_tilt", "cup_tilt"])
    with pytest.raises(InputError, match="one feature or more"):
        arm_features([])


def test_a_scene_without_an_obstacle_is_named() -> None:
    with pytest.raises(InputError, match="needs a scene with an obstacle"):
        ARM_FEATURES["obstacle_closeness"].function(replace(PLACES, obstacle=None), np.zeros((1, 1, 3)))
