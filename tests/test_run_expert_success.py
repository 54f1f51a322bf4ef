from tests.conftest import call_json


def test_a_small_table_of_experts() -> None:
    found = call_json(["experts", "--task", "Lift", "--robot", "panda", "--episodes", "3", "--worlds", "1"])
    assert found["Lift"]["panda"]["successes"] == 3
    assert found["Lift"]["panda"]["episodes"] == 3
    assert 1.0 < found["Lift"]["panda"]["mean_seconds"] < 10.0


def test_a_task_without_expert_and_a_robot_without_config(lfd_fails) -> None:
    assert "unknown task of a scripted expert 'Juggle'; known:" in lfd_fails("experts", "--task", "Juggle")
    assert "unknown robot 'hal'; known: baxter" in lfd_fails("experts", "--task", "Lift", "--robot", "hal")
