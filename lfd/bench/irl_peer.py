"""Maximum entropy IRL beside imitation's `MCEIRL`: on the same grids, in turn, each on one thread.

Both start from w = 0 in double precision, with gamma = 1 (imitation's gradient leaves the policy's discount out), and
stop by the length of their own gradient. imitation takes dense transitions only, ours are sparse. Two comparisons:

- **speed**: mu_E is exact and there is no regulariser. The solution is the demonstrator's weights on both sides, up to
  what is not identifiable: imitation also counts the state after the last action, in the expert as in its model;
- **likelihood**: mu_E comes from demonstrations, which both get, and p_0 from where they began. Ours has the prior of
  `lfd.bench.irl_methods`; imitation has no regulariser and stops after `MOST` steps. Held-out demonstrations then
  tell, by the mean of sum_t log pi_t(a_t | s_t) [nat].
"""

import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.bench.irl_methods import evidence_of, maxent, pairs
from lfd.bench.irl_problems import SOFT, Problem, macro_grid, problem_of
from lfd.bench.peers.process import PeerError
from lfd.core.processes import THREADS
from lfd.planning import StatesAndActions, TabularMDP, log_likelihood
from lfd.reward_learning import maxent_tabular

PROGRAM = Path(__file__).with_name("peers") / "imitation_mceirl.py"
TOLERANCE = 0.01
"""Length of the gradient at which both stop [feature counts]."""
RATE = 0.1
"""Adam's step size for imitation: ten times its default, with which it needs fewer steps here."""
MOST = 300
"""Steps that imitation may take."""


@dataclass(frozen=True, kw_only=True)
class Beside:
    """One grid."""

    iterations: tuple[int, int]
    """Steps to the tolerance, ours and imitation's."""
    seconds: tuple[float, float]
    """CPU time of them [s]."""
    gradients: tuple[float, float]
    """Where they ended."""
    held_out: tuple[float, float]
    """Mean log-likelihood of held-out demonstrations after learning from demonstrations [nat]."""
    held_out_truth: float
    """That of the demonstrator's own policy."""
    difference: tuple[float, float]
    """Ours less imitation's, and its standard error, paired by demonstration [nat]."""

    @property
    def faster(self) -> float:
        """imitation's time to the tolerance as a multiple of ours."""
        return self.seconds[1] / self.seconds[0]

    @property
    def faster_per_iteration(self) -> float:
        """imitation's time for a step as a multiple of ours."""
        return self.faster * self.iterations[0] / self.iterations[1]


@dataclass(frozen=True, eq=False)
class PeersAnswer:
    """What imitation made of a problem."""

    policy: Float[np.ndarray, "T S A"]
    seconds: float
    iterations: int
    gradient: float


def beside_imitation(
    python: Path, *, size: int, horizon: int, demonstrations: int, held_out: int, rng: np.random.Generator
) -> Beside:
    """Compare both on a grid-world of `size` x `size` cells, `size` a multiple of 5, in regions of 5 x 5.

    `python` has imitation. Raises `PeerError` when its program fails.
    """
    problem = problem_of(macro_grid(size=size, block=5, horizon=horizon, discount=1.0, rng=rng))
    mdp, expert = problem.mdp, problem.experts[SOFT]
    exact = mdp.feature_expectation(expert)
    began = time.process_time()
    ours = maxent_tabular(mdp, exact, tolerance=TOLERANCE)
    seconds = time.process_time() - began
    theirs = ask_imitation(python, mdp, visits=visited_states(problem))

    shown, kept = mdp.sample(expert, demonstrations, rng), mdp.sample(expert, held_out, rng)
    evidence = evidence_of(mdp, shown)
    policies = (
        maxent(evidence, tolerance=TOLERANCE).policy,
        ask_imitation(python, evidence.mdp, shown=shown).policy,
    )
    scores = [each_log_likelihood(mdp, policy, kept) for policy in (*policies, expert)]
    away = scores[0] - scores[1]
    return Beside(
        iterations=(ours.iterations, theirs.iterations),
        seconds=(seconds, theirs.seconds),
        gradients=(float(np.linalg.norm(ours.gradient)), theirs.gradient),
        held_out=(float(scores[0].mean()), float(scores[1].mean())),
        held_out_truth=float(scores[2].mean()),
        difference=(float(away.mean()), float(away.std(ddof=1) / np.sqrt(held_out))),
    )


def each_log_likelihood(
    mdp: TabularMDP, policy: Float[np.ndarray, "T S A"], shown: StatesAndActions
) -> Float[np.ndarray, "n"]:
    """sum_t log pi_t(a_t | s_t) of each demonstration."""
    return np.array([log_likelihood(mdp, policy, [each]) for each in pairs(shown)])


def visited_states(problem: Problem) -> Float[np.ndarray, "S"]:
    """How often the soft expert is in each state at t = 0 .. T, the state after the last action included."""
    mdp, policy = problem.mdp, problem.experts[SOFT]
    at = mdp.occupancy(policy)
    return at.sum(axis=0) + mdp.dynamics.moved((policy[-1] * at[-1][:, None]).T)


def ask_imitation(
    python: Path,
    mdp: TabularMDP,
    *,
    visits: Float[np.ndarray, "S"] | None = None,
    shown: StatesAndActions | None = None,
) -> PeersAnswer:
    """Let imitation learn from how often the expert is in each state, or from demonstrations."""
    evidence: dict[str, Any] = (
        {"visits": visits} if shown is None else {"states": shown.states, "actions": shown.actions}
    )
    states, actions, _ = mdp.features.shape
    with TemporaryDirectory() as folder:
        given, answer = Path(folder) / "problem.npz", Path(folder) / "answer.npz"
        np.savez(
            given,
            transitions=mdp.transitions.toarray().reshape(states, actions, states),
            features=mdp.features[:, 0],
            initial=mdp.initial,
            horizon=mdp.horizon,
            tolerance=TOLERANCE,
            rate=RATE,
            most=MOST,
            **evidence,
        )
        run_program(python, PROGRAM, given, answer)
        found = np.load(answer)
        return PeersAnswer(found["policy"], float(found["seconds"]), int(found["iterations"]), float(found["gradient"]))


def run_program(python: Path, program: Path, *arguments: Path) -> None:
    """Run a peer's program to its end on one thread. Raises `PeerError` with the last line that it wrote."""
    done = subprocess.run(
        [str(python), "-W", "ignore", str(program), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | dict.fromkeys(THREADS, "1") | {"CUDA_VISIBLE_DEVICES": ""},
    )
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise PeerError(f"{program.name} ended: {said[-1]}")


def rows_of(measured: Sequence[Beside]) -> dict[str, str]:
    """The lines of a results page."""
    count = len(measured)
    median = {
        name: float(np.median([getattr(each, name) for each in measured]))
        for name in ("faster", "faster_per_iteration", "held_out_truth")
    }
    least = min(each.faster for each in measured)
    rows = {
        "grids, each side in turn": f"{count}, exact mu of a soft expert, gamma = 1, gradient to {TOLERANCE:g}",
        "time to the tolerance": f"{median['faster']:.0f}x faster (at least {least:.0f}x)",
        "time of a step": f"{median['faster_per_iteration']:.0f}x faster",
    }
    for side, name in enumerate(("lfd", f"imitation, Adam at {RATE:g}")):
        steps, seconds, gradient = (
            [getattr(each, field)[side] for each in measured] for field in ("iterations", "seconds", "gradients")
        )
        rows[f"{name}: to the tolerance"] = (
            f"{np.median(steps):.0f} steps, {np.median(seconds):.3g} s, last gradients at most {max(gradient):.2g}"
        )
        likely = np.mean([each.held_out[side] for each in measured])
        rows[f"{name}: log-likelihood of a held-out demonstration [nat]"] = f"{likely:.2f}"
    rows["the demonstrator itself [nat]"] = f"{np.mean([each.held_out_truth for each in measured]):.2f}"
    rows["lfd less imitation, each grid [nat]"] = ", ".join(
        f"{mean:+.2f} +- {1.96 * error:.2f}" for mean, error in (each.difference for each in measured)
    )
    return rows
