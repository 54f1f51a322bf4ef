import json
from contextlib import AbstractContextManager

import numpy as np
import pytest

from lfd.core.artifact import check_output
from lfd.core.errors import RecipeError, UnknownName
from lfd.core.protocols import Bar
from lfd.loops.sweep import combinations, rows_of, sweep, title_of
from tests.conftest import BC, LIFT
from tests.test_loops_dagger import DAGGER_LIFT


@pytest.mark.slow
def test_a_sweep_gives_the_same_policies_and_episodes_on_a_cluster(thread, tmp_path) -> None:
    from lfd.cluster import connect

    recipe = tmp_path / "recipe.toml"
    text = BC.read_text().replace("steps = 6000", "steps = 20").replace("max_seconds = 10.0", "max_seconds = 1.0")
    recipe.write_text(text)
    varied = ["train.seed=[0, 1]", "eval.episodes=[2]"]
    alone = sweep(recipe, varied, thread.dataset, tmp_path / "alone")
    with connect("local") as cluster:
        together = sweep(recipe, varied, thread.dataset, tmp_path / "ray", cluster=cluster)
    assert all(row.pop("train_seconds") > 0 for row in (*alone, *together))
    assert alone == together
    assert sorted(row["train.seed"] for row in alone) == [0, 1]
    assert len({row["loss"] for row in alone}) == 2
    for folder in ("000", "001"):
        reports = [json.loads((tmp_path / p / folder / "run" / "report.json").read_text()) for p in ("alone", "ray")]
        assert reports[0]["per_episode"] == reports[1]["per_episode"]
        assert (tmp_path / "ray" / folder / "policy" / "model.safetensors").is_file()


@pytest.mark.slow
def test_loops_are_swept_as_well(tmp_path) -> None:
    recipe = tmp_path / "recipe.toml"
    text = DAGGER_LIFT.read_text()
    for before, after in (
        ("steps = 4000", "steps = 20"), ("[256, 256]", "[8]"), ("rounds = 7", "rounds = 2"),
        ("demonstrations = 10", "demonstrations = 1"), ("episodes_per_round = 10", "episodes_per_round = 1"),
        ("episodes = 50", "episodes = 2"), ("max_seconds = 10.0", "max_seconds = 1.0"),
        ("rollout_seconds = 2.5", "rollout_seconds = 1.0"),
    ):  # fmt: skip
        assert before in text
        text = text.replace(before, after)
    recipe.write_text(text)
    rows = sweep(recipe, ["train.seed=[0, 1]"], LIFT, tmp_path / "out")
    assert all(row["labels"] > 20 for row in rows)
    assert len({row["loss"] for row in rows}) == 2
    assert {path.name for path in (tmp_path / "out" / "001").iterdir()} == {
        "policy",
        "report.json",
        "learning_curve.png",
    }
    assert title_of(recipe, LIFT) == "DAgger: recipe on Lift with panda"
    assert f"{rows[0]['labels']} labels" in rows_of(rows)[f"train.seed {rows[0]['train.seed']}"]
    with pytest.raises(RecipeError, match="a dataset recipe, not a dataset"):
        sweep(recipe, ["train.seed=[0]"], tmp_path, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_sweep_that_was_interrupted_may_be_replaced(thread, tmp_path) -> None:
    def interrupted(label: str, total: int) -> AbstractContextManager[Bar]:
        (tmp_path / "out" / "000").mkdir()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(BC, ["train.seed=[0]"], thread.dataset, tmp_path / "out", progress=interrupted)
    check_output(tmp_path / "out", overwrite=True)


def test_all_combinations_are_made() -> None:
    made = combinations(BC, ["train.seed=[0, 1]", "policy.hidden_sizes=[[8], [9, 9], [7]]"])
    assert len(made) == 6
    chosen, tables = made[4]
    assert chosen == {"train.seed": 1, "policy.hidden_sizes": [9, 9]}
    assert tables["train"]["seed"] == 1
    assert tables["policy"]["hidden_sizes"] == [9, 9]
    assert tables["train"]["steps"] == 6000
    assert np.unique([str(c) for c, _ in made]).size == 6


def test_what_cannot_be_varied_is_said_before_anything_is_trained() -> None:
    with pytest.raises(RecipeError, match=r"cannot vary 'train.seed=3'; write TABLE.KEY=\[VALUE, VALUE\]"):
        combinations(BC, ["train.seed=3"])
    with pytest.raises(RecipeError, match="cannot vary 'train.seed'"):
        combinations(BC, ["train.seed"])
    with pytest.raises(UnknownName, match="'sed'.*seed"):
        combinations(BC, ["train.sed=[1, 2]"])
