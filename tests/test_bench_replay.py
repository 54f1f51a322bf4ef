import pytest

from lfd.bench.replay import bench_replay


@pytest.mark.slow
def test_episodes_become_files_faster_than_real_time_and_being_watched_is_measured() -> None:
    found = bench_replay(
        task="Lift", robot="panda", repeats=2, pairs=1, episodes=1, gradient_steps=20, every_kind=False, seed=0
    )
    lift = "Lift, 10 s at 20 Hz"
    assert set(found.real_time) == {lift, "an interaction, merge at 5 Hz"}
    assert found.real_time[lift] > 10  # on a busy machine; docs/results.md has what an idle one does
    assert 0 < found.megabytes["of these, meshes and layout"] < found.megabytes[lift] < 4
    assert found.live["share of a core for a world that is watched"][0] < 0.25
    for what in ("recording at full speed", "evaluation at full speed", "training"):
        assert 0.5 < found.live[f"processor time of {what}, watched to not"][0] < 10
