import numpy as np
import pytest

from lfd.bench.interaction import InteractionBench, bench_interaction, comparisons, sections_of
from lfd.loops.interacting import Trial


def trial(index: int, seconds: float, certain: float | None, distance: float = 2.0) -> Trial:
    return Trial(
        index=index, person="passive", success=True, seconds=seconds, collided=False, least_distance=distance,
        certain_s=certain, entropy=() if certain is None else (0.7, 0.1), offsets=((5.0, -3.5), (15.0, 0.0)),
        plan_ms=10.0, solves=5.0,
    )  # fmt: skip


def test_the_questions_are_answered_by_ratios_of_means_and_paired_differences() -> None:
    trials = {
        "obstacle": [trial(0, 8.0, None), trial(1, 12.0, None)],
        "passive": [trial(0, 7.0, 2.0), trial(1, 9.0, 4.0)],
        "active": [trial(0, 5.0, 1.0, 1.5), trial(1, 7.0, 1.0, 1.5)],
    }
    rows = comparisons(trials)
    assert rows["certain: active / passive"].startswith("0.33 (target 0.5), difference -2.00")
    assert rows["time: active / obstacle"].startswith("0.60 (target 0.7), difference -4.00")
    assert "least distance -0.50" in rows["time: active / obstacle"]
    assert rows["time: active / obstacle, passive people"] == "0.60, 2 episodes"
    planning = {"implicit": {"ms": 50.0, "solves": 8.0}, "differences": {"ms": 400.0, "solves": 88.0}}
    sections = sections_of(InteractionBench(scenes={"merge": trials}, planning=planning))
    assert "11.0x as many" in next(
        iter(sections["Interaction: a plan with implicit and with finite differences"].values())
    )


@pytest.mark.slow
def test_the_benchmark_runs_all_robots_on_the_same_people() -> None:
    measured = bench_interaction(scenes=("merge",), episodes=1, seed=1000, compared_steps=1)
    robots = measured.scenes["merge"]
    assert set(robots) == {"obstacle", "known-aggressive", "passive", "active"}
    assert len({of[0].offsets[0] for of in robots.values()}) == 1
    assert measured.planning["differences"]["solves"] > 5 * measured.planning["implicit"]["solves"]
    assert all(np.isfinite(of[0].seconds) for of in robots.values())
