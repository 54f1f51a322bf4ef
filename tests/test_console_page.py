"""The console's five modes, driven in a real browser on the real robosuite; what counts is the files that result."""

import json
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lfd.bench.browser import launched
from lfd.core.artifact import read_manifest
from lfd.record.episode_file import read_episode
from lfd.rewards.reward_artifact import load_reward
from tests.console_page import Driver, browser_page, running_console

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def console(tmp_path_factory) -> Iterator:
    with running_console(tmp_path_factory.mktemp("console")) as running:
        yield running


@pytest.fixture(scope="module")
def page() -> Iterator:
    with browser_page() as opened:
        yield opened


@pytest.fixture(scope="module")
def driver(console, page) -> Driver:
    someone = Driver(page, console.url)
    someone.drives()
    someone.wait_for("choose what to do below")
    return someone


@pytest.fixture
def folder(console) -> Path:
    return console.page.folder.path


def test_without_the_token_there_is_no_scene(console, driver) -> None:
    stranger = driver.page.context.browser.new_context().new_page()
    for url in (console.url.partition("?")[0], console.url[:-3] + "xxx"):
        answer = stranger.goto(url)
        assert answer is not None
        assert answer.status == 401
        assert stranger.query_selector("canvas") is None
    stranger.context.close()


def test_demonstrate_by_keys_buttons_and_gizmo(console, driver, folder) -> None:
    driver.open_tab("Demonstrate")
    driver.fill(successes=2, save_as="shown", **{"longest [s]": 300})  # a browser without a GPU takes its time
    driver.press("Begin")
    driver.wait_for("episode 0: waiting")
    driver.page.keyboard.press("Enter")
    driver.wait_for("episode 0: moving")
    for _ in range(6):
        driver.hold("f", 0.25)
        driver.page.wait_for_timeout(100)
    driver.page.keyboard.press("y")
    driver.wait_for("episode 1: waiting")
    driver.press("start")
    driver.wait_for("episode 1: moving")
    driver.page.wait_for_timeout(500)
    driver.drag_gizmo(console.page, 0.12)
    driver.press("success")
    driver.wait_for("2 successes and 0 failures are in shown")

    down, aside = (read_episode(folder / "shown" / f"episode_00000{i}.mcap") for i in (0, 1))
    fell = down.observations["ee_pos"][0] - down.observations["ee_pos"][-1]
    assert fell[2] > 0.02
    assert abs(fell[:2]).max() < 0.02
    assert np.ptp(aside.observations["ee_pos"][:, 1]) > 0.03


def test_a_dropped_connection_stops_the_arm_and_a_reloaded_page_goes_on(console, driver, folder) -> None:
    driver.open_tab("Demonstrate")
    driver.fill(successes=1, save_as="dropped", **{"longest [s]": 300})
    driver.press("Begin")
    driver.wait_for("episode 0: waiting")
    driver.page.keyboard.press("Enter")
    driver.wait_for("episode 0: moving")
    driver.page.keyboard.down("r")
    driver.page.wait_for_timeout(500)
    hand = console.page.device.hand
    driver.page.goto("about:blank")  # the page is gone with its key down
    driver.page.keyboard.up("r")
    driver.page.wait_for_timeout(200)
    stood = hand.position.copy()
    driver.page.wait_for_timeout(1000)
    np.testing.assert_array_equal(hand.position, stood)
    driver.arrive(console.url)
    driver.drives()
    driver.wait_for("episode 0: moving")
    driver.page.wait_for_timeout(500)
    driver.page.keyboard.press("y")
    driver.wait_for("1 successes and 0 failures")
    episode = read_episode(folder / "dropped" / "episode_000000.mcap")
    assert episode.observations["ee_pos"][:, 2].max() > episode.observations["ee_pos"][0, 2] + 0.02


def test_two_watch_and_one_drives_until_the_arm_is_passed_on(console, driver) -> None:
    browser = launched(driver.page.context.browser.browser_type)
    second = Driver(browser.new_page(viewport={"width": 700, "height": 500}), console.url)
    second.page.wait_for_function("document.querySelector('[data-lfd-seat]').innerText.includes('2 here')")
    assert "Somebody else drives" in second.seat()
    second.open_tab("Demonstrate")
    second.press("Begin")
    second.page.get_by_text("You watch. Press Take the arm first").wait_for()
    second.press("Take the arm")
    assert "Somebody else drives" in second.seat()
    driver.press("Pass the arm on")
    second.page.wait_for_function("document.querySelector('[data-lfd-seat]').innerText.includes('Nobody drives')")
    second.press("Take the arm")
    second.drives()
    second.press("Pass the arm on")
    driver.page.wait_for_function("document.querySelector('[data-lfd-seat]').innerText.includes('Nobody drives')")
    driver.press("Take the arm")
    driver.drives()
    browser.close()


def test_bad_names_are_told_and_nothing_begins(driver, folder) -> None:
    driver.open_tab("Demonstrate")
    driver.fill(save_as="../outside")
    driver.press("Begin")
    driver.page.get_by_text("leads out of the console's folder").wait_for()
    assert not (folder.parent / "outside").exists()


def test_supervise_takes_over_hands_back_and_retrains(console, driver, folder) -> None:
    driver.open_tab("Supervise")
    driver.choose("learner", "dagger_lift")
    driver.fill(
        rounds=2,
        rollouts_a_round=1,
        demonstrations_at_first=1,
        trials_a_round=1,
        gradient_steps=30,
        save_as="watched",
        **{"longest [s]": 60},
    )
    driver.press("Begin")
    driver.wait_for("waiting")
    driver.page.keyboard.press("Enter")
    driver.wait_for("moving")
    driver.hold("r", 1.5)
    driver.page.keyboard.press("b")
    driver.page.wait_for_timeout(600)
    driver.page.keyboard.press("n")
    assert "the policy is watched/policy" in driver.wait_for("supervise: ")
    (recorded,) = (folder / "watched" / "round_001" / "recordings").glob("*.mcap")
    interventions = read_episode(recorded).interventions
    assert 1 <= interventions.sum() < len(interventions)
    report = json.loads((folder / "watched" / "report.json").read_text())
    assert [row["round"] for row in report["rounds"]] == [0, 1]
    assert report["takeovers"] >= 1


def test_a_policy_that_is_there_is_watched_and_one_that_does_not_fit_refused(driver, folder) -> None:
    driver.open_tab("Supervise")
    driver.page.get_by_text("Or a policy that is there").click()
    driver.press("Look for policies")
    driver.choose("policy", "watched/policy")
    driver.fill(on_robot="ur5e", rollouts=1, recordings="looked_after", **{"seconds of each": 60})
    driver.press("Watch")
    driver.page.get_by_text("was trained for robot panda, not ur5e").wait_for()
    driver.fill(on_robot="")
    driver.press("Watch")
    driver.wait_for("episode 0: waiting")
    driver.page.keyboard.press("Enter")
    driver.wait_for("episode 0: moving")
    driver.hold("r", 1.5)
    driver.page.keyboard.press("n")
    assert "0 successes, 1 failures are in looked_after" in driver.wait_for("watch: done")
    assert read_episode(folder / "looked_after" / "episode_000000.mcap").interventions.any()


def test_correct_by_dragging_the_arm_moves_the_weights(console, driver, folder) -> None:
    driver.open_tab("Correct")
    driver.choose("task", "table")
    driver.fill(ways=3, save_as="pushed")
    driver.press("Begin")
    driver.wait_for("waiting")
    while "correct: " not in driver.told():  # a page that draws slowly may come too late for some of the ways
        if "waiting" in driver.told():
            driver.page.keyboard.press("Enter")
        driver.drag_arm(console.page, (0.0, 0.0, -0.3))
    ended = driver.wait_for("correct: ")
    assert "pushes noticed" in ended
    reward = load_reward(folder / "pushed" / "reward")
    episodes = map(read_episode, (folder / "pushed" / "recordings").glob("*.mcap"))
    assert min(episode.signals["push"].values[:, 2].min() for episode in episodes) < -5.0
    assert reward.weights[list(reward.features).index("table_distance")] < -0.01


def test_compare_learns_from_left_and_right(console, driver, folder) -> None:
    driver.open_tab("Compare")
    driver.fill(motions_to_choose_from=4, questions=2, save_as="preferred")
    driver.press("Begin")
    driver.wait_for("question 1 of 2")
    driver.press("Left")
    driver.wait_for("question 2 of 2")
    driver.press("About equal")
    driver.wait_for("compare: done")
    reward = load_reward(folder / "preferred")
    assert len(reward.history) == 3
    manifest = read_manifest(folder / "preferred")
    assert manifest is not None
    assert manifest["kind"] == "reward"


def test_browse_shows_where_things_come_from_and_plays_them(console, driver, folder) -> None:
    driver.open_tab("Browse")
    driver.press("Look again")
    driver.choose("artifact", "shown (recordings)")
    driver.press("Show")
    card = driver.page.locator("[data-lfd-card]")
    card.wait_for()
    assert "shown: intact" in card.inner_text()
    driver.press("Play")
    driver.wait_for("play: done")


def test_the_latency_is_shown_on_the_page(console, driver) -> None:
    late = list(console.page.clients.seats.latencies_ms)
    console.page.show_latency()
    driver.page.wait_for_function("document.querySelector('[data-lfd-latency]').innerText.includes('median')")
    assert driver.latency_ms() == pytest.approx(statistics.median(late), abs=0.6)


PAD = """
window.pad = {axes: [0, 0, 0, 0], down: {}};
window.button = (_, i) => ({value: pad.down[i] || 0, pressed: i in pad.down});
navigator.getGamepads = () => [null, {axes: pad.axes, buttons: Array.from({length: 17}, button)}];
"""
"""A gamepad in the standard layout. Chromium offers tests no way to plug one in: its hardware is played here."""
UP_TRIGGER, START = 7, 9


def test_demonstrate_by_gamepad(console, driver, folder) -> None:
    driver.open_tab("Demonstrate")
    driver.fill(successes=1, save_as="padded", **{"longest [s]": 300})
    driver.press("Begin")
    driver.wait_for("episode 0: waiting")
    driver.page.evaluate(PAD)

    def press(button: int, seconds: float) -> None:
        driver.page.evaluate(f"pad.down = {{{button}: 1}}")
        driver.page.wait_for_timeout(1e3 * seconds)
        driver.page.evaluate("pad.down = {}")

    press(START, 0.3)
    driver.wait_for("episode 0: moving")
    press(UP_TRIGGER, 1.0)
    driver.page.wait_for_timeout(500)
    hand = console.page.device.hand
    driver.page.evaluate("pad.axes = [0, -1, 0, 0]")
    driver.page.wait_for_timeout(1000)
    driver.page.evaluate("navigator.getGamepads = () => [null]")  # unplugged with its stick pushed
    driver.page.wait_for_timeout(500)
    stood = hand.position.copy()
    driver.page.wait_for_timeout(500)
    np.testing.assert_allclose(hand.position, stood, atol=2e-3)
    driver.page.evaluate(PAD)
    driver.page.wait_for_timeout(200)
    press(START, 0.3)
    driver.wait_for("1 successes and 0 failures are in padded")
    driver.page.evaluate("navigator.getGamepads = () => []")
    went = np.ptp(read_episode(folder / "padded" / "episode_000000.mcap").observations["ee_pos"], axis=0)
    assert went[2] > 0.02
    assert max(went[:2]) > 0.02


def test_a_person_pushes_in_a_page_of_the_command_line(driver, tmp_path) -> None:
    command = [sys.executable, "-m", "lfd.cli", "correct", "table", "--person", "console", "--runs", "1"]
    with subprocess.Popen([*command, "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        told = next(line for line in process.stderr if "push the arm at" in line)
        Driver(driver.page, told.split()[-1]).drives()
        driver.wait_for("waiting")
        driver.page.keyboard.press("Enter")
        driver.hold("f", 1.2)
        process.stderr.read()
    assert process.returncode == 0
    episode = read_episode(tmp_path / "out" / "recordings" / "episode_000000.mcap")
    assert episode.signals["push"].values[:, 2].min() < -5.0
    assert len(load_reward(tmp_path / "out" / "reward").history) >= 1
