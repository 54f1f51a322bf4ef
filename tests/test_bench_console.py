import pytest

from lfd.bench.console import bench_console
from tests.console_page import need_chromium


@pytest.mark.slow
def test_a_page_that_is_lost_stops_the_arm_and_goes_on_when_loaded_anew() -> None:
    need_chromium()
    found = bench_console(minutes=0.2, reload_every_s=0.0, seed=0)
    assert found.episodes == found.reloads >= 1
    assert found.stood_ms[1] < 1000  # on a busy machine; docs/results.md has what an idle one does
    assert found.memory_mb[-1] < found.memory_mb[0] + 200
