"""What an expert has to know of a gripper: how far open it is, whether it presses, and how much room it takes.

Every gripper here opens along the x axis of the hand (`lfd.experts.reaching.Hand`). The opening is linear in the
positions of the finger joints, to within 3 mm also where an object bends the fingers of a linkage. The numbers were
fitted to robosuite's models; a test compares them with the pads there.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lfd.core.errors import UnknownName
from lfd.core.protocols import Observation, WorldSpec
from lfd.experts.reaching import CLOSE


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper as experts see it."""

    gains: tuple[float, ...]
    """Change of the opening with the position of each finger joint [m/m or m/rad]."""
    offset_m: float
    """Opening when all finger joints are at zero [m]."""
    reach_m: float
    """From the grip site to the outside of an open finger, along the hand's x axis [m]."""
    breadth_m: float
    """Half the breadth of a finger, along the hand's y axis [m]."""
    holds_edges: bool
    """Whether it is wide enough for a cube held by its edges, so that it need not turn to the cube's sides."""
    stopped_m_s: float = 0.02
    """Speed of each finger below which it has stopped [m/s]; about a cube's width apart free fingers are faster."""
    bent_rad: float | None = None
    """Angle between the joints of a finger from which it presses, where the speed does not tell [rad]."""
    bending: tuple[float, ...] = ()
    """Change of that angle with the position of each finger joint [1]."""
    hold: float = CLOSE
    """Gripper action while an object is held. Fingers as slow as Jaco's would have to open again by what they were told
    to close further; 0 has them stay."""

    def opening(self, observation: Observation) -> float:
        """Distance between the pads [m]."""
        return float(self.offset_m + np.dot(self.gains, observation["gripper_pos"]))

    def has_stopped(self, observation: Observation) -> bool:
        """Whether the fingers have come to rest on what is between them."""
        if self.bent_rad is not None:
            return float(np.dot(self.bending, observation["gripper_pos"])) > self.bent_rad
        return float(np.abs(self.gains * observation["gripper_vel"]).max()) < self.stopped_m_s


_ROBOTIQ_85 = Gripper(
    gains=(-0.0889, -0.0254, 0.0079, -0.0889, -0.0254, 0.0079),
    offset_m=0.0931,
    reach_m=0.076,
    breadth_m=0.014,
    holds_edges=True,
)
GRIPPERS: Mapping[str, Gripper] = {
    "panda": Gripper(gains=(1.0, -1.0), offset_m=0.0, reach_m=0.047, breadth_m=0.008, holds_edges=True),
    "sawyer": Gripper(gains=(1.0, -1.0), offset_m=0.037, reach_m=0.045, breadth_m=0.008, holds_edges=False),
    "ur5e": _ROBOTIQ_85,
    "kinova3": _ROBOTIQ_85,
    "iiwa": Gripper(
        gains=(-0.1431, 0.0379, -0.0173, 0.1431, 0.0379, -0.0173),
        offset_m=0.1300,
        reach_m=0.074,
        breadth_m=0.015,
        holds_edges=True,
    ),
    "jaco": Gripper(
        gains=(0.0630, -0.0221, 0.0307, -0.0095, 0.0307, -0.0095),
        offset_m=-0.0325,
        reach_m=0.070,
        breadth_m=0.040,
        holds_edges=False,
        bent_rad=0.70,
        bending=(1.0, -1.0, 0.0, 0.0, 0.0, 0.0),
        hold=0.0,
    ),
}
"""By the name of the robot config."""


def gripper_of(spec: WorldSpec) -> Gripper:
    """The gripper of a world's robot.

    Raises `UnknownName` for a robot whose gripper is not known here.
    """
    if spec.robot not in GRIPPERS:
        raise UnknownName("robot of an expert that grasps", spec.robot, GRIPPERS)
    return GRIPPERS[spec.robot]
