"""mu(pi) of a policy by Monte Carlo, in parallel, where no recursion gives it: in any process that can be sampled.

    mu(pi) = E_pi[f(tau)] ~ 1/n sum_i f(tau_i),    tau_i drawn with a generator of its own, from seed and i

so that an estimate is the same bit for bit however many rollouts run at a time, and where. Two ways to run them:

- `sampled_expectations`: a function makes the rollouts, in processes of this machine (`ProcessMap`) or on a cluster
  (`lfd.cluster`). Threads would not help it: what is written in Python holds Python's lock.
- `expectations_in_worlds`: a policy acts in `World`s, each in a thread of its own while its physics runs
  (`lfd.worlds.rollout`).
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError, SimulationError
from lfd.core.processes import ProcessMap
from lfd.core.protocols import BatchPolicy, Observation, Transition, UnitMap, World, batches
from lfd.rewards.checked_arrays import checked_discount
from lfd.rewards.feature_counts import FeatureExpectations, expectations_of_counts, feature_counts
from lfd.worlds.rollout import Start, rollouts

Roll = Callable[[np.random.Generator], Shaped[np.ndarray, "..."]]
"""One rollout: from the source of its randomness to its features, (T, K); lengths may differ."""
StepFeatures = Callable[[Observation, Float[np.ndarray, "Da"]], Float[np.ndarray, "K"]]
"""phi(x, u) of an observation and the action that was taken."""
STREAM = 4
"""Part of the seed of rollouts: they are not those that were recorded or evaluated."""


def sampled_expectations(
    roll: Roll, count: int, *, discount: float | int, seed: int, units: UnitMap | ProcessMap
) -> FeatureExpectations:
    """mu and its standard error from `count` rollouts, spread over the processes or machines of `units`.

    `roll` goes to other processes: a function at the top of a module, or a `functools.partial` of one. What is slow to
    build there, such as a world, belongs in a `functools.cache`. Raises `InputError` as `feature_counts` does, naming
    the rollout, and for a count below 1.
    """
    _check(count, discount)
    counts = dict(units(_counts_of, (roll, discount, seed), batches(count, units.cpus)))
    return expectations_of_counts([row for unit in sorted(counts) for row in counts[unit]])


def expectations_in_worlds(
    worlds: Sequence[World],
    policy: BatchPolicy,
    phi: StepFeatures,
    count: int,
    *,
    discount: float | int,
    seed: int,
    horizon: int,
    hold_steps: int,
) -> FeatureExpectations:
    """mu and its standard error from `count` episodes, as many at a time as there are worlds.

    Episodes end as those of `rollouts` do. Raises `InputError` as `sampled_expectations` does, `SimulationError` when
    an episode breaks off: leaving it out would be another mean.
    """
    _check(count, discount)
    starts = _starts(phi, count, seed)
    counts: dict[int, Float[np.ndarray, "K"]] = {}
    ended = rollouts(worlds, policy, lambda: next(starts, None), horizon=horizon, hold_steps=hold_steps)
    for start, outcome in ended:
        if outcome.failure:
            where = f"rollout {start.index} broke off at step {outcome.steps}"
            raise SimulationError(f"{where}: {outcome.failure}; try another seed or policy")
        (seen,) = start.observers
        assert isinstance(seen, _Features)
        counts[start.index] = _checked_counts(np.array(seen.rows), start.index, discount)
    return expectations_of_counts([counts[index] for index in range(count)])


class _Features:
    """An observer that keeps the features of each step."""

    def __init__(self, phi: StepFeatures):
        self._phi = phi
        self.rows: list[Float[np.ndarray, "K"]] = []

    def begin(self, world: World, observation: Observation) -> None:
        """Nothing to open."""

    def step(self, world: World, transition: Transition) -> None:
        self.rows.append(np.asarray(self._phi(transition.observation, transition.decision.action)))

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""


def _starts(phi: StepFeatures, count: int, seed: int) -> Iterator[Start]:
    return (Start(index=i, rng=_rng(seed, i), observers=[_Features(phi)]) for i in range(count))


def _counts_of(shared: tuple[Roll, float | int, int], numbers: range) -> list[Float[np.ndarray, "K"]]:
    """f of the rollouts with some numbers: a unit of work."""
    roll, discount, seed = shared
    return [_checked_counts(roll(_rng(seed, i)), i, discount) for i in numbers]


def _rng(seed: int, index: int) -> np.random.Generator:
    return np.random.default_rng([STREAM, seed, index])


def _checked_counts(phi: Shaped[np.ndarray, "..."], index: int, discount: float | int) -> Float[np.ndarray, "K"]:
    try:
        return feature_counts(phi, discount=discount)
    except InputError as error:
        raise InputError(f"rollout {index}: {error}") from error


def _check(count: int, discount: float | int) -> None:
    checked_discount(discount)
    if count < 1:
        raise InputError(f"count = {count}: give at least one rollout, and two for a standard error")
