"""A policy that moves a hand along an arm's plan through OSC_POSE: demonstrations of plans as policies are trained on.

The controller's goal is where the hand should be a little later, as far ahead as the hand is behind its goal; where the
elbow goes is left to the controller.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Decision, Observation, Verdict, WorldSpec
from lfd.experts.reaching import CLOSE, Hand, check_controller, towards

AHEAD_S = 0.15
"""By how much the hand is behind a goal that moves."""
GRIP_SITE = "gripper0_right_grip_site"
"""robosuite's name of the place between the fingers."""
ARRIVED_M = 0.03
"""Distance to the plan's end up to which it was followed."""


class PoseFollower:
    """Follows a hand's poses, one for each control step, with the gripper closed; ends half a second after the last."""

    name = "pose_follower"

    def __init__(self, spec: WorldSpec, poses: Sequence[Hand]):
        """Raises `InputError` for a world whose arm does not take changes of the hand's pose."""
        check_controller(spec, self.name)
        self._poses, self._ahead = poses, round(AHEAD_S * spec.control_hz)
        self.steps = len(poses) + round(0.5 * spec.control_hz)
        """Control steps that it takes."""

    def reset(self, rng: np.random.Generator) -> None:
        self._step = 0

    def act(self, observation: Observation) -> Decision:
        hand, last = Hand.of(observation), len(self._poses) - 1
        wanted = self._poses[min(self._step + self._ahead, last)]
        self._step += 1
        verdict = None
        if self._step >= self.steps:
            arrived = np.linalg.norm(hand.position - self._poses[last].position) <= ARRIVED_M
            verdict = Verdict.SUCCESS if arrived else Verdict.FAILURE
        return Decision(towards(hand, wanted.position, wanted.rotation, CLOSE), verdict=verdict)


def hand_poses(model: mujoco.MjModel, joints: Sequence[str], positions: Float[np.ndarray, "N D"]) -> list[Hand]:
    """Poses of the grip site for positions of some joints [rad], all others as in the model."""
    data, site = mujoco.MjData(model), model.site(GRIP_SITE).id
    addresses = [model.joint(name).qposadr[0] for name in joints]
    found = []
    for row in positions:
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        found.append(Hand(data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()))
    return found
