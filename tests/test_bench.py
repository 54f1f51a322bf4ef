"""That the benches measure what they say; how fast anything is belongs in docs/results.md."""

import pytest

from lfd.bench.matrix import bench_matrix
from lfd.bench.sim import bench_everywhere, bench_sim
from lfd.worlds.same_numbers import Comparison
from tests.conftest import call_json


@pytest.mark.slow
def test_the_sim_bench_answers_with_its_ratios() -> None:
    found = call_json(["bench", "sim", "--quick"])
    rates, resets, ratios = found["steps_per_second"], found["reset_seconds"], found["ratios"]
    assert found["stepper"] == "compiled"
    assert found["control_steps"] == 80
    assert {"one_core_vs_robosuite", "one_core_vs_physics_limit", "two_threads_vs_one", "reset_vs_robosuite"} <= set(
        ratios
    )
    ours = rates["ours, one core"]
    assert ratios["one_core_vs_robosuite"] == pytest.approx(ours / rates["robosuite"], rel=0.01)
    assert ratios["one_core_vs_physics_limit"] == pytest.approx(ours / rates["physics alone"], rel=0.01)
    assert ratios["two_threads_vs_one"] == pytest.approx(rates["ours, two threads"] / ours, rel=0.01)
    assert ratios["reset_vs_robosuite"] == pytest.approx(resets["robosuite"] / resets["ours"], rel=0.02)
    assert rates["robosuite"] < ours  # the order of the sides, not by how much
    assert rates["robosuite, lite_physics off"] < rates["robosuite"]


def test_every_task_and_robot_can_be_measured(monkeypatch) -> None:
    import lfd.bench.sim as sim

    monkeypatch.setattr(sim, "TASKS", {"Stack": sim.TASKS["Stack"]})
    monkeypatch.setattr(sim, "robot_names", lambda: ["ur5e"])
    found = bench_everywhere(control_hz=20, seed=0)
    assert list(found) == ["Stack panda", "Lift ur5e"]
    for ratios in found.values():
        product = ratios["one_core_vs_physics_limit"] * ratios["physics_limit_vs_robosuite"]
        assert ratios["one_core_vs_robosuite"] == pytest.approx(product, rel=0.02)


def test_the_matrix_names_the_cases_that_differ(monkeypatch) -> None:
    import lfd.bench.matrix as matrix

    cases = [("Lift", "panda", "OSC_POSE"), ("Lift", "panda", "JOINT_TORQUE")]
    measured = bench_matrix(cases, control_hz=20, steps=1, seed=0)
    assert (measured.cases, measured.within_tolerance, measured.beyond) == (2, 2, [])
    monkeypatch.setattr(matrix, "compare", lambda world, actions: Comparison(0, 1e-3, 1e-6))
    measured = bench_matrix(cases, control_hz=20, steps=1, seed=0)
    assert measured.within_tolerance == 0
    assert measured.beyond[0] == "Lift panda OSC_POSE: 1.0e-03, robosuite itself 1.0e-06"


@pytest.mark.slow
def test_the_record_bench_answers_with_its_ratios() -> None:
    found = call_json(["bench", "record", "--quick"])
    ours = found["writers"]["ours"]["messages_per_second"]
    for name in ("mcap", "foxglove-sdk"):
        ratio = ours / found["writers"][name]["messages_per_second"]
        assert found["ratios"][f"ours_vs_{name}"] == pytest.approx(ratio, rel=0.01)
        assert ratio > 1  # the order of the sides, not by how much
    assert set(found["cost"]) == {"2.5 s", "10 s"}
    assert min(found["cost"]["2.5 s"], found["cost"]["10 s"]) > 1
    assert found["real_time"]["joint states"] == 2000
    assert found["real_time"]["pictures"] == 120


@pytest.mark.slow
def test_the_convert_bench_answers_with_its_ratios() -> None:
    found = call_json(["bench", "convert", "--quick"])
    rates, ratios = found["frames_per_second"], found["ratios"]
    lerobot = rates.pop("LeRobot's add_frame, save_episode")
    assert found["frames"] == 1000
    for name, rate in rates.items():
        assert ratios[f"{name} vs LeRobot"] == pytest.approx(rate / lerobot, rel=0.02)
        assert rate > lerobot
    assert rates["limit: arrays to dataset"] > rates["lfd convert, one process"]
    assert set(found["memory_mb"]) == {"5", "10"}


def test_an_unknown_task_is_an_error() -> None:
    from lfd.core.errors import UnknownName

    with pytest.raises(UnknownName, match="unknown task 'Lif'"):
        bench_sim(task="Lif", robot="panda", control_hz=20, episodes=1, seed=0)
