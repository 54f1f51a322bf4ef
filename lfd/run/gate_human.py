"""The human gate: a person takes over and hands back as they see fit (HG-DAgger).

Kelly et al. 2019, "HG-DAgger: Interactive Imitation Learning with Human Experts": only steps in which the person acts
are labelled. The person's hand is `lfd.experts.teleoperation.TeleopPolicy`, with this gate as its device:

    gate = HumanGate(device, dead_band=config.dead_band, quiet_steps=20)
    policy = GatedPolicy(OneEach([TeleopPolicy(gate, spec, config)]), Ensemble([learner]), gate)
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lfd.core.errors import InputError
from lfd.core.protocols import Verdict
from lfd.experts.device import Device, DeviceState
from lfd.experts.keys import Word
from lfd.experts.teleoperation import OPEN, VERDICTS
from lfd.run.gates import Moment, Ruling

ACTS = (Word.TAKE_OVER, Word.GRIPPER)
"""Words that take over."""


class HumanGate:
    """Reads a device once a step: it tells who acts, and hands the reading on to the person's policy.

    The person takes over by moving the device beyond its dead band, by `Word.TAKE_OVER` or by the gripper's word. They
    hand back by `Word.HAND_BACK`, or by `quiet_steps` steps without motion or a word (0: by the word alone). After the
    word the device must come to rest before motion takes over again: a hand is seldom off a stick when a key is
    pressed. A person looks after one world.

    When a person takes over, the gripper stays as the learner has it. Words that end the episode work all the time.
    """

    def __init__(self, device: Device, *, dead_band: float, quiet_steps: int):
        self.name = device.name
        self._device, self._dead_band, self._quiet_steps = device, dead_band, quiet_steps
        self.word: Word | None = None

    word: Word | None
    """What the person said to end the episode; none when it ended by itself."""

    def reset(self, place: int) -> None:
        if place != 0:
            raise InputError("a person looks after one world at a time; run a human gate with most_worlds=1")
        self._controls, self._released, self._quiet = False, True, 0
        self._gripper = OPEN
        self.word = None

    def rule(self, place: int, moment: Moment) -> Ruling:
        state = self._device.read()
        before, self._controls = self._controls, self._person_acts(state)
        if self._controls and not before:
            state = replace(state, words=(*self._adopt(moment), *state.words))
        if self._controls and state.words.count(Word.GRIPPER) % 2:
            self._gripper = -self._gripper
        self._reading = state
        return Ruling(self._controls, self._verdict(state.words))

    def read(self) -> DeviceState:
        """The reading of this step, for the person's policy, which is asked only while the person acts."""
        return self._reading

    def _person_acts(self, state: DeviceState) -> bool:
        moves = max(np.abs(state.translation).max(), np.abs(state.rotation).max()) > self._dead_band
        self._released = self._released or not moves
        for word in state.words[::-1]:  # the last word counts
            if word is Word.HAND_BACK:
                self._released, self._quiet = not moves, 0
                return False
            if word in ACTS:
                self._quiet = 0
                return True
        self._quiet = 0 if moves or state.words else self._quiet + 1
        if self._controls:
            return not 0 < self._quiet_steps <= self._quiet
        return bool(moves and self._released)

    def _adopt(self, moment: Moment) -> Sequence[Word]:
        """The word that brings the person's gripper to where the learner has its own."""
        return (Word.GRIPPER,) if moment.action[-1] * self._gripper < 0 else ()

    def _verdict(self, words: Sequence[Word]) -> Verdict | None:
        ends = [word for word in words if word in VERDICTS]
        if ends and self.word is None:
            self.word = ends[0]
        return None if self.word is None else VERDICTS[self.word]
