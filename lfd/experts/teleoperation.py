"""A person's hand as a policy: what a device says, in the robot's action space."""

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.core.protocols import Decision, Observation, Verdict, WorldSpec
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.device import Device, DeviceState
from lfd.experts.keys import AXES, Word
from lfd.worlds.robots import TeleopConfig

MOVED = {"OSC_POSE": 6, "OSC_POSITION": 3}
"""Controllers that move the hand, and how many of a device's six axes they take."""
VERDICTS = {
    Word.SUCCESS: Verdict.SUCCESS,
    Word.FAILURE: Verdict.FAILURE,
    Word.DISCARD: Verdict.DISCARD,
    Word.REDO: Verdict.DISCARD,
    Word.QUIT: Verdict.DISCARD,
}
"""What a word means for the episode in which it is said."""
OPEN, CLOSE = -1.0, 1.0
SPEEDS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Factors on the gains that a person goes through with slower and faster."""
FACING = np.diag([-1.0, -1.0, 1.0])
"""R_base_device of a person who faces the robot: away from them is towards it."""
DOWNWARDS = np.diag([1.0, -1.0, -1.0])
"""R_gripper_device: a gripper's z points where its fingers do, a device's z up."""


class TeleopPolicy:
    """Moves the hand of a single arm as a person says with `device`.

    The base of the arm is taken to stand along the world's axes, as robosuite's single arms on tables do. A person is
    the expert: their action is also the label. Raises `InputError` for a world whose action no device fits.
    """

    def __init__(self, device: Device, spec: WorldSpec, config: TeleopConfig):
        if spec.controller not in MOVED:
            raise InputError(
                f"a device moves the hand: it drives {' or '.join(MOVED)}, robot {spec.robot!r} has {spec.controller}; "
                f'write controller = "OSC_POSE" in its robot config'
            )
        names = spec.labels["action"]
        self._moved = MOVED[spec.controller]
        if names not in (AXES[: self._moved], (*AXES[: self._moved], "gripper")):
            raise InputError(f"a device moves one arm; the action of robot {spec.robot!r} is {', '.join(names)}")
        self.name, self._device, self._config = device.name, device, config
        self._has_gripper, self._speed = names[-1] == "gripper", SPEEDS.index(1.0)
        self.word: Word | None = None

    word: Word | None
    """What the person said to end the episode; none when it ended by itself."""

    def reset(self, rng: np.random.Generator) -> None:
        """Open the gripper. There is no randomness, and a chosen speed stays."""
        self._gripper, self.word = OPEN, None

    def act(self, observation: Observation) -> Decision:
        state = self._device.read()
        for word in state.words:
            self._hear(word)
        action = self._action(state, observation["ee_quat"])
        said = np.concatenate([state.translation, state.rotation, [self._gripper]])
        return Decision(
            action,
            expert_action=action,
            verdict=None if self.word is None else VERDICTS[self.word],
            signals={"teleop_axes": dict(zip((*AXES, "gripper"), said.tolist(), strict=True))},
        )

    def _hear(self, word: Word) -> None:
        if word is Word.GRIPPER:
            self._gripper = -self._gripper
        elif word in (Word.SLOWER, Word.FASTER):
            at = self._speed + (1 if word is Word.FASTER else -1)
            self._speed = min(max(at, 0), len(SPEEDS) - 1)
        elif word in VERDICTS and self.word is None:
            self.word = word

    def _action(self, state: DeviceState, ee_quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "Da"]:
        config, turn = self._config, base_from_device(self._config.frame, ee_quat)
        move = config.position_gain * (turn @ beyond(state.translation, config.dead_band))
        rotate = config.rotation_gain * (turn @ beyond(state.rotation, config.dead_band))
        hand = SPEEDS[self._speed] * np.concatenate([move, rotate])[: self._moved]
        return np.clip(np.append(hand, [self._gripper] if self._has_gripper else []), -1.0, 1.0)


def beyond(deflection: Float[np.ndarray, "3"], dead_band: float) -> Float[np.ndarray, "3"]:
    """Each deflection d without the dead band b, so that motion begins at 0: sign(d) max(|d| - b, 0) / (1 - b)."""
    return np.sign(deflection) * np.maximum(np.abs(deflection) - dead_band, 0.0) / (1.0 - dead_band)


def base_from_device(frame: str, ee_quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """R_base_device: it maps a device's directions to those of the robot's base."""
    if frame == "gripper":
        return matrix_from_wxyz(ee_quat) @ DOWNWARDS
    return FACING if frame == "view" else np.eye(3)
