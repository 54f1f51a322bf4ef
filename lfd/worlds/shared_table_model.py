"""The model of the shared table: robosuite's Lift, with three cubes in the place of one, and a person's hand.

Hand and cubes are moved, not simulated: gravity does not act on them, and only the cubes touch anything. They have
joints, so that a recording's states show where they are. Lift's own cube is one of the three: its names stay.
"""

import xml.etree.ElementTree as ET

from lfd.worlds.model_text import xml_text
from lfd.worlds.shared_table_guard import HAND_HEIGHT, HAND_RADIUS

OBJECTS = ("left", "middle", "right")
"""As the robot sees them."""
HALF_M = 0.025
"""Half of a cube's edge [m]."""
BODIES = {"left": "left_main", "middle": "cube_main", "right": "right_main"}
COLOURS = {"left": "0.13 0.55 0.24 1", "middle": "0.75 0.15 0.12 1", "right": "0.15 0.32 0.75 1"}
HAND = "person_hand"
HAND_JOINTS = tuple(f"{HAND}_{axis}" for axis in "xyz")


def shared_table_xml(lift_xml: str) -> str:
    """The model from that of Lift, both as a world's state has them."""
    root = ET.fromstring(lift_xml)
    world = root.find("worldbody")
    assert world is not None
    own = next(body for body in world.findall("body") if body.get("name") == BODIES["middle"])
    world.remove(own)
    for name in OBJECTS:
        world.append(ET.fromstring(_cube_xml(name)))
    world.append(ET.fromstring(_hand_xml()))
    return xml_text(root)


def cube_joint(name: str) -> str:
    """The free joint of an object."""
    return f"{'cube' if name == 'middle' else name}_joint0"


def _cube_xml(name: str) -> str:
    """A cube; the middle one's parts have the names that robosuite looks for."""
    own = "cube" if name == "middle" else name
    size = f'type="box" size="{HALF_M} {HALF_M} {HALF_M}" rgba="{COLOURS[name]}"'
    return (
        f'<body name="{BODIES[name]}" gravcomp="1"><joint type="free" name="{cube_joint(name)}"/>'
        f'<geom name="{own}_g0" group="0" density="1000" {size}/>'
        f'<geom name="{own}_g0_vis" group="1" contype="0" conaffinity="0" mass="1e-8" {size}/>'
        f'<site name="{own}_default_site" group="0" type="sphere" size="0.002" rgba="1 0 0 1"/></body>'
    )


def _hand_xml() -> str:
    """A palm, four fingers and a thumb within the ball that counts, which viewers leave out (group 3)."""
    skin = 'rgba="0.87 0.66 0.52 1" contype="0" conaffinity="0" group="1"'
    slides = "".join(
        f'<joint name="{joint}" type="slide" axis="{axis}"/>'
        for joint, axis in zip(HAND_JOINTS, ("1 0 0", "0 1 0", "0 0 1"), strict=True)
    )
    fingers = "".join(
        f'<geom type="capsule" fromto="-0.012 {y} 0.004 -0.035 {0.9 * y} -0.012" size="0.0065" {skin}/>'
        for y in (-0.024, -0.008, 0.008, 0.024)
    )
    return (
        f'<body name="{HAND}" pos="0 0 {HAND_HEIGHT}" gravcomp="1">{slides}'
        '<inertial pos="0 0 0" mass="0.5" diaginertia="0.001 0.001 0.001"/>'
        f'<geom type="ellipsoid" size="0.027 0.032 0.012" pos="0.012 0 0.006" {skin}/>{fingers}'
        f'<geom type="capsule" fromto="0.01 0.03 0.002 -0.014 0.038 -0.012" size="0.0065" {skin}/>'
        f'<geom name="{HAND}_ball" type="sphere" size="{HAND_RADIUS}" rgba="0.87 0.66 0.52 0.25" contype="0" '
        f'conaffinity="0" group="3"/></body>'
    )
