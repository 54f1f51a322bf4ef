"""How likely an answer to "A or B?" is, given weights w: the choice models that comparisons are learned with.

    x = rationality w.(f_A - f_B)
    bradley_terry    p(a) = 1 / (1 + exp(-x))         Bradley and Terry 1952; p proportional to exp(rationality w.f)
    sadigh2017       p(a) = min(1, exp(x))            Sadigh et al. 2017, "Active Preference-Based Learning"
    hard             p(a) = 1 if x >= 0 else 0        the half-space of the chapter, 10.5.1

"About equal" counts as half an answer each way, log p(equal) = (log p(a) + log p(b)) / 2: it pulls w towards the plane
w.(f_A - f_B) = 0 and takes no side. For hard answers it says nothing. Up to its normaliser this is Davidson's tie
(1970). sadigh2017 is a likelihood of one answer, not a distribution over both: p(a) + p(b) > 1 where x is not 0.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from lfd.rewards.factors import Choice

Likelihood = Literal["bradley_terry", "sadigh2017", "hard"]
LIKELIHOODS: tuple[Likelihood, ...] = ("bradley_terry", "sadigh2017", "hard")


def log_likelihood(kind: Likelihood, x: Float[np.ndarray, "..."], choice: Choice) -> Float[np.ndarray, "..."]:
    """log p(choice) for x = rationality w.(f_A - f_B)."""
    if choice == "equal":
        both = log_likelihood(kind, x, "a"), log_likelihood(kind, x, "b")
        return np.zeros_like(x) if kind == "hard" else 0.5 * (both[0] + both[1])
    towards = x if choice == "a" else -x
    if kind == "bradley_terry":
        return np.minimum(towards, 0.0) - np.log1p(np.exp(-np.abs(towards)))  # logaddexp takes 2.5 times as long
    if kind == "sadigh2017":
        return np.minimum(0.0, towards)
    return np.where(towards >= 0.0, 0.0, -np.inf)
