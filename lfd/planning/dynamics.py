"""The transitions of a finite MDP as two matrices, one for values backward in time and one for states forward.

Rows go through the actions first: row a S + s is p(. | s, a). Tables of shape (A, S) are then contiguous along the
states, which makes maxima and sums over the few actions several times faster than tables of shape (S, A).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from lfd.core.errors import InputError

DENSE_ENTRIES = 20_000
"""Up to this many entries a dense product is faster than a sparse one, whose call alone takes some 10 us."""
DENSE_SHARE = 0.25
"""Above this share of non-zero entries, too."""
SUM_TOLERANCE = 1e-8
"""How far probabilities may sum from 1; they are used as they are."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """p(s' | s, a) of S states and A actions; `make_dynamics` checks them."""

    states: int
    """S."""
    actions: int
    """A."""
    rows: sp.csr_array
    """Shape (A S, S), without zeros."""

    @cached_property
    def _backward(self) -> Any:
        size = self.actions * self.states**2
        return self.rows.toarray() if size <= DENSE_ENTRIES or self.rows.nnz > DENSE_SHARE * size else self.rows

    @cached_property
    def _forward(self) -> Any:
        return self._backward.T if isinstance(self._backward, np.ndarray) else self.rows.T.tocsr()

    @cached_property
    def _cumulated(self) -> Float[np.ndarray, "Z1"]:
        return np.concatenate([[0.0], np.cumsum(self.rows.data)])

    @cached_property
    def _possible(self) -> Int[np.ndarray, "Z"]:
        """The number of each entry of `rows` that is not zero, in a dense table of its shape; ascending."""
        rows = np.repeat(np.arange(self.actions * self.states), np.diff(self.rows.indptr))
        return np.sort(rows * self.states + self.rows.indices)

    def expected(self, values: Float[np.ndarray, "S *rest"]) -> Float[np.ndarray, "A S *rest"]:
        """E[V(s') | s, a] = sum_s' p(s' | s, a) V(s')."""
        return (self._backward @ values).reshape(self.actions, self.states, *values.shape[1:])

    def moved(self, visits: Float[np.ndarray, "A S"]) -> Float[np.ndarray, "S"]:
        """sum_{s,a} p(s' | s, a) x(s, a): where states and actions of probability x lead."""
        return self._forward @ visits.reshape(-1)

    def possible(
        self, states: Int[np.ndarray, "N"], actions: Int[np.ndarray, "N"], following: Int[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N"]:
        """Whether p(s' | s, a) > 0, for N transitions."""
        entry = (actions * self.states + states) * self.states + following
        known = self._possible
        return known[np.minimum(np.searchsorted(known, entry), len(known) - 1)] == entry

    def drawn(
        self, states: Int[np.ndarray, "N"], actions: Int[np.ndarray, "N"], rng: np.random.Generator
    ) -> Int[np.ndarray, "N"]:
        """A next state for each of N states and actions, by inversion of the cumulated probabilities of its row."""
        row = actions * self.states + states
        first, last = self.rows.indptr[row], self.rows.indptr[row + 1]
        cumulated = self._cumulated
        target = cumulated[first] + rng.random(len(row)) * (cumulated[last] - cumulated[first])
        # One search in all rows at once: rounding may lead to a neighbouring row, hence the clip.
        place = np.searchsorted(cumulated, target, side="right") - 1
        return self.rows.indices[np.clip(place, first, last - 1)].astype(np.intp)


def make_dynamics(transitions: Any, actions: int) -> Dynamics:
    """From a dense table (S, A, S) or a sparse matrix (S A, S) whose row s A + a is p(. | s, a).

    Raises `InputError` for other shapes and, naming state and action, for probabilities that are negative, not finite
    or do not sum to 1.
    """
    states = transitions.shape[-1] if transitions.ndim else 0
    sparse = sp.issparse(transitions)
    if states == 0 or transitions.shape != ((states * actions, states) if sparse else (states, actions, states)):
        raise InputError(
            f"transitions have shape {transitions.shape}; with {actions} actions in the features they must be a dense "
            "(S, A, S) table or a scipy.sparse matrix of shape (S A, S) with row s A + a"
        )
    rows = transitions if sparse else transitions.reshape(states * actions, states)
    state_major = sp.csr_array(rows, dtype=np.float64, copy=True)
    state_major.sum_duplicates()
    state_major.eliminate_zeros()
    _check_probabilities(state_major, actions)
    order = np.arange(states * actions).reshape(states, actions).T.reshape(-1)
    return Dynamics(states, actions, state_major[order])


def _check_probabilities(rows: sp.csr_array, actions: int) -> None:
    """Rows in the order s A + a."""
    bad = ~(np.isfinite(rows.data) & (rows.data >= 0))
    if bad.any():
        entry = int(np.argmax(bad))
        state, action = divmod(int(np.searchsorted(rows.indptr, entry, side="right")) - 1, actions)
        raise InputError(
            f"transitions of state {state}, action {action}: the probability of state {rows.indices[entry]} is "
            f"{rows.data[entry]}; probabilities are finite and not negative"
        )
    sums: Float[np.ndarray, "SA"] = np.asarray(rows.sum(axis=1), dtype=np.float64).reshape(-1)
    off = np.abs(sums - 1.0) > SUM_TOLERANCE
    if off.any():
        state, action = divmod(int(np.argmax(off)), actions)
        more = f", and those of {int(off.sum()) - 1} other rows do not either" if off.sum() > 1 else ""
        raise InputError(
            f"transitions of state {state}, action {action} sum to {sums[np.argmax(off)]:.9g}, not to 1{more}; "
            "a state without a way out leads to itself"
        )
