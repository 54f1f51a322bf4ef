"""`lfd bench corrections`: what pushing an arm teaches it, and how soon it notices.

Scripted people carry out the tasks of `lfd.loops.correction_tasks` with three arms, each person three times: with an
arm that learns from pushes, one that only deforms its plan, and one that only yields like a spring. What is compared
is the person's effort, the regret of the plan that the arm would make next (in units of the person's own reward), and
the cosine between its weights and theirs. Seeds of people are 0, 1, ...; nothing was tuned on them.

Noticing: undisturbed runs (is a push ever noticed?), and runs in which 10 N push the gripper in a random direction
from a random time on (how long until it is noticed?).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.processes import ProcessMap, cores, in_order
from lfd.core.protocols import Observation, Progress, Verdict, silent
from lfd.loops.correcting import (
    CorrectionRecipe,
    correct,
    learner_of,
    make_correction_world,
    report_of,
    scripted,
    set_up,
    start_reward,
    weights_by_push,
)
from lfd.loops.correction_results import Nobody
from lfd.loops.correction_tasks import TASKS
from lfd.run.correctable_arm import RESPONSES
from lfd.worlds.robosuite_world import RobosuiteWorld

ROBOTS = ("panda", "jaco", "iiwa")
PUSHES = 3
"""After so many the regret is read."""
PUSH_N = 10.0
"""Of the push whose delay is measured."""
BEFORE_S, AFTER_S = 1.0, 8.0
"""Between these times such a push begins."""
LASTS_S = 0.5


@dataclass(frozen=True, kw_only=True)
class CorrectionsBench:
    """What one run measured. Rows of people: `report_of`, with robot, task, seed and response."""

    people: int
    sessions: list[dict[str, Any]]
    undisturbed_runs: int
    false_alarms: int
    delays_s: list[float]
    """Of the pushes that were noticed."""
    unnoticed: int


class Poke:
    """A person who pushes once, with a constant force."""

    name = "poke"

    def __init__(self, begins_s: float, force: Float[np.ndarray, "3"], lasts_s: float = LASTS_S):
        self.begins_s, self._ends_s = begins_s, begins_s + lasts_s
        self._wrench = np.concatenate([force, np.zeros(3)])

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        return self._wrench if self.begins_s <= time_s < self._ends_s else np.zeros(6)

    def verdict(self) -> Verdict | None:
        return None


def bench_corrections(
    *, robots: Sequence[str], people: int, quiet_runs: int, seed: int, progress: Progress = silent
) -> CorrectionsBench:
    """Measure sessions of all tasks, and `quiet_runs` undisturbed and poked runs of each robot."""
    sessions = [
        (robot, task, seed + person, response)
        for robot in robots
        for task in TASKS
        for person in range(people)
        for response in RESPONSES
    ]
    noticing = [(robot, seed + number) for robot in robots for number in range(quiet_runs)]
    run = ProcessMap(cores())
    with progress("bench corrections", len(sessions) + len(noticing)) as bar:
        rows = []
        for row in in_order(run(_session, None, sessions)):
            rows.append(row)
            bar.advance(note=f"{row['robot']}, {row['task']}, {row['response']}: {row['effort_n_s']:.0f} N s")
        noticed = []
        for found in in_order(run(_noticing, None, noticing)):
            noticed.append(found)
            bar.advance()
    delays = [delay for _, delay in noticed if delay is not None]
    return CorrectionsBench(
        people=people,
        sessions=rows,
        undisturbed_runs=len(noticed),
        false_alarms=sum(alarms for alarms, _ in noticed),
        delays_s=delays,
        unnoticed=len(noticed) - len(delays),
    )


@lru_cache(maxsize=1)
def _world(robot: str) -> RobosuiteWorld:
    """The world of a worker, built once for all sessions of a robot."""
    return make_correction_world(CorrectionRecipe(task="cup", robot=robot))


def _session(_: None, unit: tuple[str, str, int, str]) -> dict[str, Any]:
    robot, task, seed, response = unit
    recipe = CorrectionRecipe(task=task, robot=robot, seed=seed, response=response)
    setup, reward = set_up(recipe), start_reward(recipe)
    learner = learner_of(reward, recipe)
    runs = correct(recipe, setup, learner, scripted(recipe, setup), _world(robot))
    report = report_of(recipe, setup, runs, weights_by_push(runs, reward.weights), judged=response == "learn")
    return {"robot": robot, "task": task, "seed": seed, "response": response, **report}


def _noticing(_: None, unit: tuple[str, int]) -> tuple[int, float | None]:
    """Pushes noticed when nobody pushed; delay until a push of 10 N was noticed, None where it was not."""
    robot, seed = unit
    recipe = CorrectionRecipe(task="laptop", robot=robot, seed=seed, runs=1, response="impedance")
    setup, reward = set_up(recipe), start_reward(recipe)
    quiet = correct(recipe, setup, learner_of(reward, recipe), Nobody(), _world(robot))[0]
    rng = np.random.default_rng([9, seed])
    direction = rng.standard_normal(3)
    poke = Poke(rng.uniform(BEFORE_S, AFTER_S), PUSH_N * direction / np.linalg.norm(direction))
    poked = correct(recipe, setup, learner_of(reward, recipe), poke, _world(robot))[0]
    since = [time_s - poke.begins_s for time_s in poked.noticed_s if time_s >= poke.begins_s]
    delay = since[0] if since and since[0] <= LASTS_S else None
    return len(quiet.noticed_s), delay


def sections_of(measured: CorrectionsBench) -> dict[str, dict[str, str]]:
    """The sections of a results page: one for each robot, and one for noticing."""
    robots = list(dict.fromkeys(row["robot"] for row in measured.sessions))
    sections = {f"Corrections: {robot}": _rows(measured, robot) for robot in robots}
    delays = 1e3 * np.array(measured.delays_s)
    sections["Corrections: noticing a push"] = {
        "undisturbed runs of 10 s": f"{measured.undisturbed_runs}, {measured.false_alarms} false alarms",
        f"delay of a push of {PUSH_N:g} N": (
            f"median {np.median(delays):.0f} ms, 95% within {np.quantile(delays, 0.95):.0f} ms, "
            f"longest {delays.max():.0f} ms; {measured.unnoticed} of {measured.undisturbed_runs} not noticed"
            if len(delays)
            else "none was noticed"
        ),
    }
    return sections


def _rows(measured: CorrectionsBench, robot: str) -> dict[str, str]:
    rows = {"people": f"{measured.people} for each task, each twice from start to goal"}
    for task in TASKS:
        by = {
            response: [
                r for r in measured.sessions if (r["robot"], r["task"], r["response"]) == (robot, task, response)
            ]
            for response in RESPONSES
        }
        learned = by["learn"]
        pushed = [row for row in learned if len(row["regret"]) > 1]
        before = np.array([row["regret"][0] for row in learned])
        after = np.array([row["regret"][min(PUSHES, len(row["regret"]) - 1)] for row in learned])
        rows[f"{task}: regret"] = f"{_mean(before)} before, {_mean(after)} after {PUSHES} pushes: " + (
            f"{after.sum() / before.sum():.1%} of it"
        )
        cosines = [row["cosine"][min(PUSHES, len(row["cosine"]) - 1)] for row in pushed]
        rows[f"{task}: cosine after {PUSHES} pushes"] = (
            f"{_mean(cosines)}; {len(learned) - len(pushed)} of {len(learned)} people never pushed"
        )
        efforts = {name: np.array([row["effort_n_s"] for row in each]) for name, each in by.items()}
        spring = efforts["impedance"].sum()
        rows[f"{task}: effort [N s]"] = "; ".join(
            f"{name} {_mean(effort)} ({effort.sum() / spring:.2f}x)" for name, effort in efforts.items()
        )
        rows[f"{task}: time of pushing [s]"] = "; ".join(
            f"{name} {_mean([row['pushed_s'] for row in each])}" for name, each in by.items()
        )
        rows[f"{task}: runs that reach the goal"] = "; ".join(
            f"{name} {sum(row['reached_goal'] for row in each)} of {sum(row['runs'] for row in each)}"
            for name, each in by.items()
        )
    slow = max(row["planning_ms"] for row in measured.sessions if row["robot"] == robot)
    rows["replanning, slowest"] = f"{slow:.0f} ms"
    return rows


def _mean(values: Sequence[float] | Float[np.ndarray, "N"]) -> str:
    """Mean with a normal 95% interval."""
    array = np.asarray(values, dtype=float)
    if len(array) == 0:
        return "none"
    half = 1.96 * float(array.std(ddof=1)) / np.sqrt(len(array)) if len(array) > 1 else float("nan")
    return f"{array.mean():.3g} +- {half:.2g}"


def plot(measured: CorrectionsBench, path: Path) -> None:
    """Regret by pushes, and effort by response, for each task; robots together."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    axes = figure.subplots(2, len(TASKS))
    for column, task in enumerate(TASKS):
        rows = [row for row in measured.sessions if row["task"] == task]
        learned = [row["regret"] for row in rows if row["response"] == "learn"]
        for regrets in learned:
            axes[0, column].plot(range(min(len(regrets), 5)), regrets[:5], color="C0", alpha=0.15, linewidth=0.8)
        held = np.array([[row[min(n, len(row) - 1)] for n in range(5)] for row in learned])
        axes[0, column].plot(range(5), held.mean(axis=0), "o-", color="C0", markersize=4)
        axes[0, column].set(title=task, xlabel="pushes", ylim=(0, None))
        efforts = [[row["effort_n_s"] for row in rows if row["response"] == name] for name in RESPONSES]
        axes[1, column].boxplot(efforts, tick_labels=list(RESPONSES))
        axes[1, column].tick_params(axis="x", rotation=20)
    axes[0, 0].set_ylabel("regret")
    axes[1, 0].set_ylabel("effort [N s]")
    figure.savefig(path, dpi=150)
