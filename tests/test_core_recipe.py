import pickle
from dataclasses import dataclass
from pathlib import Path

import pytest

from lfd.core.errors import RecipeError, UnknownName
from lfd.core.recipe import as_table, build, describe, load_toml


@dataclass(frozen=True, kw_only=True)
class Table:
    steps: int
    """How many."""
    rate: float
    """How fast [1/s]."""
    sizes: tuple[int, ...] = (1,)
    """How large."""


def write(folder: Path, text: str) -> Path:
    path = folder / "recipe.toml"
    path.write_text(text)
    return path


def test_a_table_becomes_its_dataclass(tmp_path: Path) -> None:
    tables = load_toml(write(tmp_path, "[train]\nsteps = 3\nrate = 2\nsizes = [4, 5]"), ["train"], ["train.steps=7"])
    made = build(Table, tables["train"], "here")
    assert made == Table(steps=7, rate=2.0, sizes=(4, 5))
    assert isinstance(made.rate, float)
    assert as_table(made) == {"steps": 7, "rate": 2.0, "sizes": [4, 5]}


def test_fields_are_described_by_the_sentence_below_them() -> None:
    assert describe(Table)["rate"] == "How fast [1/s]."


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"steps": 1, "rate": 1.0, "stepz": 2}, r"unknown key in here: 'stepz'; known: rate, sizes, steps\."),
        ({"steps": 1}, r"here lacks rate: How fast \[1/s\]"),
        ({"steps": "1", "rate": 1.0}, "here steps = '1': expected int, got str"),
        ({"steps": True, "rate": 1.0}, "here steps = True: expected int, got bool"),
        ({"steps": 1.5, "rate": 1.0}, "here steps = 1.5: expected int, got float"),
        ({"steps": 1, "rate": 1.0, "sizes": [1, "2"]}, r"here sizes\[1\] = '2': expected int"),
        ({"steps": 1, "rate": 1.0, "sizes": 3}, "expected an array of int, got int"),
    ],
)
def test_what_does_not_fit_is_said(table: dict, message: str) -> None:
    with pytest.raises((RecipeError, UnknownName), match=message):
        build(Table, table, "here")


@pytest.mark.parametrize(
    ("text", "overrides", "message"),
    [
        ("steps = ", [], "is no TOML"),
        ("[trian]\n", [], r"unknown recipe table in .*: '\[trian\]'; known: \[train\]"),
        ("train = 3\n", [], "write it as"),
        ("[train]\n", ["steps=3"], "write TABLE.KEY=VALUE"),
    ],
)
def test_files_that_are_no_recipe(tmp_path: Path, text: str, overrides: list[str], message: str) -> None:
    with pytest.raises((RecipeError, UnknownName), match=message):
        load_toml(write(tmp_path, text), ["train"], overrides)


def test_a_missing_recipe_lists_its_neighbours(tmp_path: Path) -> None:
    write(tmp_path, "")
    with pytest.raises(RecipeError, match="no recipe .*lift.toml; in .*: recipe.toml"):
        load_toml(tmp_path / "lift.toml", ["train"])


def test_an_unknown_name_survives_the_way_from_another_process() -> None:
    error = UnknownName("task", "Lif", ["Lift"], "Look here.")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is UnknownName
    assert str(again) == str(error)
