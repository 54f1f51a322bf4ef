"""The scripted expert for Wipe.

It has no phases: the tool, level and pressed on the table, goes to the dirt that is nearest to it, until none is
left. What is under the tool is wiped on the way.
"""

import numpy as np

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.experts.reaching import Hand, above, check_controller, funnel, nearest_yaw, pointing_down, towards, yaw_of
from lfd.experts.style import PLAIN, ExpertStyle

PRESS_M = 0.008
"""How far below the table the tool is aimed, which is what presses it on [m]."""
LIFT_M = 0.10
"""Height at which a tool that is tilted is levelled again [m]."""
TILT = (0.10, 0.30)
"""Tilt below which the tool is pressed on, and above which it is lifted; the sine of the angle."""
YAWS = (np.pi / 2, 0.0)
"""Yaws of the tool, whose long side is its hand's x axis: across the table or along it [rad]."""


class WipeExpert:
    """Wipes the dirt off the table with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE.
    """

    name = "wipe_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "Wipe")
        self._style, self._speed, self._yaw = style, style.speed[1], YAWS[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode and how the tool is turned; beside them the expert has no memory."""
        self._speed = self._style.draw_speed(rng)
        self._yaw = YAWS[self._style.draw_grasp(rng, len(YAWS)) or 0]

    def act(self, observation: Observation) -> Decision:
        hand, dirt = Hand.of(observation), observation["nearest_dirt_point"]
        rotation = pointing_down(nearest_yaw(yaw_of(hand.rotation), self._yaw, np.pi))
        tilted = funnel(float(np.hypot(hand.rotation[0, 2], hand.rotation[1, 2])), *TILT)
        action = towards(hand, above(dirt, tilted * LIFT_M - PRESS_M), rotation, 0.0, speed=self._speed)[
            :6
        ]  # the tool is no gripper
        return Decision(action, expert_action=action)
