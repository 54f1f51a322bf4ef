import json

from lfd.cli import main
from lfd.loops.results import write_section
from tests.conftest import BC, LIFT


def test_sections_are_replaced_and_others_stay(tmp_path) -> None:
    page = tmp_path / "results.md"
    write_section(page, "One", "lfd one", {"speed": 1})
    write_section(page, "Two", "lfd two", {"speed": 2})
    write_section(page, "One", "lfd one", {"speed": 3})
    text = page.read_text()
    assert text.count("## One") == text.count("## Two") == 1
    assert "| speed | 3 |" in text
    assert "| speed | 1 |" not in text
    assert text.index("| speed | 3 |") < text.index("## Two") < text.index("| speed | 2 |")


def test_the_demo_runs_the_whole_thread(tmp_path, capfd) -> None:
    """Small recipes, the real libraries: every stage's artifact is there and the report names all of them."""
    small = tmp_path / "small.toml"
    small.write_text(LIFT.read_text().replace("episodes = 50", "episodes = 2"))
    quick = tmp_path / "quick.toml"
    quick.write_text(BC.read_text().replace("steps = 6000", "steps = 20").replace("episodes = 50", "episodes = 1"))
    out, page = tmp_path / "demo", tmp_path / "results.md"
    options = ["--dataset-recipe", str(small), "--policy-recipe", str(quick), "--results", str(page)]
    assert main(["demo", "--out", str(out), "--json", *options]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert json.loads((out / "report.json").read_text()) == printed
    assert printed["replay_deviation"] == 0
    assert (printed["demonstrations"], printed["episodes"]) == (2, 1)
    assert set(printed["seconds"]) == {"record", "convert", "train", "eval", "replay"}
    for name in ("demonstration.rrd", "rollout.rrd", "policy/model.safetensors", "run/report.json"):
        assert (out / name).stat().st_size > 0
    assert "| exact replay | largest deviation 0 |" in page.read_text()
