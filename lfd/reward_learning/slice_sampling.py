"""Elliptical slice sampling of many chains at once (Murray, Adams, MacKay 2010, Fig. 2).

For a target N(z; 0, I) L(z): from z, draw nu ~ N(0, I) and a height log y = log L(z) + log u, u ~ U(0, 1); the ellipse
z cos(theta) + nu sin(theta) is searched from a random angle in a bracket of 2 pi, which shrinks towards theta = 0, the
present state, until log L > log y. There is no step size and no rejection, and the target is left invariant.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float


def elliptical_steps(
    states: Float[np.ndarray, "C D"],
    heights: Float[np.ndarray, "C"],
    log_likelihood: Callable[[Float[np.ndarray, "N D"]], Float[np.ndarray, "N"]],
    steps: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "C D"]:
    """C chains after some steps; `heights` is log L of `states`, finite everywhere."""
    states, heights = states.copy(), heights.copy()
    for _ in range(steps):
        others = rng.standard_normal(states.shape)
        level = heights + np.log(rng.random(len(states)))
        angle = rng.uniform(0.0, 2.0 * np.pi, len(states))
        low, high = angle - 2.0 * np.pi, angle.copy()
        searching = np.arange(len(states))
        before = states.copy()
        while len(searching):
            theta = angle[searching]
            tried = before[searching] * np.cos(theta)[:, None] + others[searching] * np.sin(theta)[:, None]
            found = log_likelihood(tried)
            done = (found > level[searching]) | (high[searching] - low[searching] < 1e-12)  # u = 1 to rounding
            landed = searching[done]
            states[landed], heights[landed] = tried[done], found[done]
            searching, theta = searching[~done], theta[~done]
            low[searching] = np.where(theta < 0.0, theta, low[searching])
            high[searching] = np.where(theta < 0.0, high[searching], theta)
            angle[searching] = rng.uniform(low[searching], high[searching])
    return states
