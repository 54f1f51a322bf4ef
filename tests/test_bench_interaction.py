import numpy as np
import pytest

from lfd.bench.bootstrap import median_interval, ratio_interval
from lfd.bench.interaction import InteractionBench, bench_interaction
from lfd.bench.interaction_report import (
    beliefs,
    comparisons,
    entropy_rows,
    plot,
    sections_of,
)
from lfd.loops.interacting import Trial


def trial(index: int, seconds: float, certain: float | None, distance: float = 2.0) -> Trial:
    return Trial(
        index=index, person="passive", success=True, seconds=seconds, collided=False, least_distance=distance,
        certain_s=certain, entropy=() if certain is None else (0.7,) * (index + 1) + (0.1,),
        offsets=((5.0, -3.5), (15.0, 0.0)), plan_ms=10.0, solves=5.0, per_gradient=1.0,
    )  # fmt: skip


TRIALS = {
    "obstacle": [trial(0, 8.0, None), trial(1, 12.0, None)],
    "passive": [trial(0, 7.0, 2.0), trial(1, 9.0, 4.0)],
    "active": [trial(0, 5.0, 1.0, 1.5), trial(1, 7.0, 1.0, 1.5)],
}


def test_the_questions_are_answered_by_ratios() -> None:
    rows = comparisons(TRIALS)
    assert rows["certain: active / passive"].startswith("medians 0.33 [0.25, 0.50] (target 0.5)")
    assert rows["time: active / obstacle"].startswith("means 0.60 [0.58, 0.62] (target 0.7)")
    assert "least distance -0.50" in rows["time: active / obstacle"]
    assert rows["time: active / obstacle, passive people"] == "means 0.60 [0.58, 0.62], 2 episodes"


def test_a_page_and_a_picture_hold_every_scene(tmp_path) -> None:
    cost = {"implicit": {"ms": 50.0, "solves": 8.0, "per_gradient": 1.0}}
    cost["differences"] = {"ms": 400.0, "solves": 88.0, "per_gradient": 21.0}
    measured = InteractionBench(scenes={"merge": TRIALS, "crossing": TRIALS}, planning={"merge": cost})
    sections = sections_of(measured)
    assert list(sections)[:2] == ["Interaction: merge", "Interaction: crossing"]
    planning = sections["Interaction: a plan with implicit and with finite differences"]
    assert "11.0x as many" in planning["merge: best responses of a plan, all starts included"]
    assert "21.0x as many" in planning["merge: best responses of a gradient"]
    plot(measured, tmp_path / "interaction.png")
    assert (tmp_path / "interaction.png").stat().st_size > 10_000


def test_beliefs_are_told_by_medians_and_entropy_that_stays_when_an_episode_has_ended() -> None:
    np.testing.assert_array_equal(entropy_rows(TRIALS["passive"]), [[0.7, 0.1, 0.1], [0.7, 0.7, 0.1]])
    rows = beliefs(TRIALS)
    assert rows["passive: certain after, median"].startswith("3.00 [2.00, 4.00]")
    assert "active: entropy after 0.4, 1, 2, 4 s" in rows


def test_the_medians_interval_covers_as_often_as_it_says(rng) -> None:
    truth, hits = np.log(2.0), 0
    for _ in range(200):
        middle, low, high = median_interval(rng.exponential(size=60))
        hits += low <= truth <= high
        assert low <= middle <= high
    assert hits > 0.88 * 200  # of 95%


def test_a_ratio_of_pairs_is_surer_than_its_parts(rng) -> None:
    difficulty = rng.exponential(size=50) + 0.1
    ratio, low, high = ratio_interval(0.5 * difficulty, difficulty, np.mean)
    assert (ratio, low, high) == pytest.approx((0.5, 0.5, 0.5))


@pytest.mark.slow
def test_the_benchmark_runs_all_robots_on_the_same_people() -> None:
    measured = bench_interaction(scenes=("merge",), episodes=1, seed=1000, compared_steps=1)
    robots = measured.scenes["merge"]
    assert set(robots) == {"obstacle", "known-aggressive", "passive", "active"}
    assert len({of[0].offsets[0] for of in robots.values()}) == 1
    planning = measured.planning["merge"]
    assert planning["differences"]["solves"] > 5 * planning["implicit"]["solves"]
    assert planning["differences"]["per_gradient"] == 21.0  # one for each end of 10 controls, and one for J
    assert planning["implicit"]["per_gradient"] == 1.0
    assert all(np.isfinite(of[0].seconds) for of in robots.values())
