import json

import numpy as np
import pytest

from lfd.core.errors import InputError, UnknownName
from lfd.rewards.factors import ChoiceFactor, GaussianFactor, PushFactor, check_features, factor_of, factor_table

NAMES = ("person_closeness", "cup_tilt")
GAUSSIAN = GaussianFactor(np.array([1.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))
PUSH = PushFactor(np.array([0.1, 0.0]))
CHOICE = ChoiceFactor(np.array([1.0, 0.3]), -0.7, "equal", 2.0)


@pytest.mark.parametrize("factor", [GAUSSIAN, PUSH, CHOICE])
def test_a_factor_comes_back_from_json(factor: GaussianFactor | PushFactor | ChoiceFactor) -> None:
    table = json.loads(json.dumps(factor_table(factor, NAMES)))
    found = factor_of(table, NAMES, "a file")
    assert type(found) is type(factor)
    for name, value in vars(factor).items():
        np.testing.assert_array_equal(getattr(found, name), value)


def test_a_factor_keeps_its_own_numbers() -> None:
    numbers = np.array([1.0, 2.0])
    factor = PushFactor(numbers)
    numbers[0] = 5.0
    assert factor.difference[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        factor.difference[0] = 3.0


def test_a_covariance_becomes_its_inverse_in_any_units(rng: np.random.Generator) -> None:
    root = rng.normal(size=(3, 3)) * np.array([1e-6, 1.0, 1e5])[:, None]
    found = GaussianFactor.about(np.zeros(3), root @ root.T)
    units = np.sqrt(np.diag(root @ root.T))
    np.testing.assert_allclose((found.precision @ root @ root.T) * units[:, None] / units, np.eye(3), atol=1e-9)
    with pytest.raises(InputError, match="is not positive definite; learn them again"):
        GaussianFactor.about(np.zeros(2), np.ones((2, 2)) - 2 * np.eye(2))


def test_what_is_no_factor_is_refused() -> None:
    with pytest.raises(InputError, match=r"mean\[1\] is nan: every entry must be a finite number"):
        GaussianFactor(np.array([0.0, np.nan]), np.eye(2))
    with pytest.raises(InputError, match=r"precision has shape \(3, 3\), expected \(2, 2\)"):
        GaussianFactor(np.zeros(2), np.eye(3))
    for precision in (np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1.0, 2.0], [2.0, 1.0]]), -np.eye(2)):
        with pytest.raises(InputError, match="symmetric and have no negative eigenvalue"):
            GaussianFactor(np.zeros(2), precision)
    with pytest.raises(InputError, match=r"difference\[0\] is inf"):
        PushFactor(np.array([np.inf, 0.0]))
    with pytest.raises(UnknownName, match="unknown choice 'c'; known: a, b, equal"):
        ChoiceFactor(np.ones(2), 0.0, "c", 1.0)
    with pytest.raises(InputError, match="rationality = -1.0: give a positive number"):
        ChoiceFactor(np.ones(2), 0.0, "a", -1.0)
    with pytest.raises(InputError, match="offset = nan"):
        ChoiceFactor(np.ones(2), float("nan"), "a", 1.0)
    with pytest.raises(InputError, match="compared with one of the same features says nothing about w"):
        ChoiceFactor(np.zeros(2), 1.0, "a", 1.0)


def test_files_with_other_features_or_keys_are_refused() -> None:
    table = factor_table(CHOICE, NAMES)
    with pytest.raises(
        InputError, match="has the features cup_tilt, person_closeness, the reward has person_closeness"
    ):
        factor_of(table | {"features": ["cup_tilt", "person_closeness"]}, NAMES, "a file")
    with pytest.raises(
        InputError, match="a file has 3 numbers, expected 2, one for each of person_closeness, cup_tilt"
    ):
        factor_of(table | {"difference": [1.0, 2.0, 3.0]}, NAMES, "a file")
    with pytest.raises(InputError, match="a file is no factor: its kind must be one of gaussian, push, choice"):
        factor_of(table | {"kind": "guess"}, NAMES, "a file")
    with pytest.raises(InputError, match=r"a file is no choice factor: missing \['offset'\], unknown \['ofset'\]"):
        factor_of({k.replace("offset", "ofset"): v for k, v in table.items()}, NAMES, "a file")
    with pytest.raises(InputError, match="a file has something else than numbers"):
        factor_of(table | {"offset": "much"}, NAMES, "a file")
    with pytest.raises(InputError, match="a file: rationality = 0.0"):
        factor_of(table | {"rationality": 0}, NAMES, "a file")
    with pytest.raises(InputError, match="in the same order"):
        check_features(("a",), ("b",), "it")
