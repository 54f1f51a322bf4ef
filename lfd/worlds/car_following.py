"""A driver who follows the car ahead: Helly's linear law (1959).

    a = speed_gain (v_ahead - v) + gap_gain (gap - standstill - headway v)

within limits. At equal speeds it settles at gap = standstill + headway v. In a dense lane the headway is short: whoever
drops back has to let these cars pass, too.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class CarFollowing:
    """Constants of the law."""

    speed_gain: float = 0.8
    """[1/s]."""
    gap_gain: float = 0.25
    """[1/s^2]."""
    standstill: float = 2.0
    """Gap that is left when both stand still [m]."""
    headway: float = 0.4
    """Time that the gap grows by with the speed [s]."""
    limits: tuple[float, float] = (-6.0, 2.5)
    """Lowest and highest acceleration [m/s^2]."""

    def settled_gap[N: (float, np.ndarray)](self, speed: N) -> N:
        """Gap from bumper to bumper at a steady speed [m]."""
        return self.standstill + self.headway * speed

    def wish[N: (float, np.ndarray)](self, gap: N, speed: N, speed_ahead: N) -> N:
        """The acceleration that the law asks for, without limits [m/s^2]."""
        return self.speed_gain * (speed_ahead - speed) + self.gap_gain * (gap - self.settled_gap(speed))

    def acceleration(self, gap: float, speed: float, speed_ahead: float) -> float:
        """The acceleration [m/s^2]; `gap` is from bumper to bumper [m]."""
        return float(np.clip(self.wish(gap, speed, speed_ahead), *self.limits))
