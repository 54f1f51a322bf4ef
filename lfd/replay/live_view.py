"""What a person sees of a world while it moves: MuJoCo's window where there is a screen, else Rerun in a browser.

The view has a model of its own and is given the world's state, so that looking cannot change what is looked at.
"""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np

from lfd.core.protocols import Observation, Transition, World
from lfd.worlds.cameras import FOLLOWED, load_model

VIEW_HZ = 25.0
"""Pictures a second at the most [Hz]."""
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
EYE = {"azimuth": 165.0, "elevation": -19.0, "distance": 1.65}
"""Where MuJoCo's window looks from [degrees, m]: as in Rerun, nearly opposite to the robot."""
LOOK_AT = (-0.15, 0.05, 0.9)


@runtime_checkable
class Scene(Protocol):
    """Draws a model somewhere."""

    def load(self, model: mujoco.MjModel) -> None:
        """Show another model."""
        ...

    def move(self, data: mujoco.MjData) -> None:
        """Show the bodies where they are in `data`."""
        ...

    def close(self) -> None: ...


class LiveView:
    """An observer that shows the world in a scene, at most `VIEW_HZ` times a second."""

    def __init__(self, scene: Scene, address: str):
        self.address = address
        self._scene, self._model_xml, self._drawn = scene, "", -np.inf

    address: str
    """What to open in order to see it; empty where a window opens by itself."""

    def show(self, world: World) -> None:
        """Show a world as it stands; a new model is loaded, which takes a moment."""
        model_xml = world.get_state().model_xml
        if model_xml != self._model_xml:
            self._model_xml, self._model = model_xml, load_model(model_xml)
            self._data = mujoco.MjData(self._model)
            self._scene.load(self._model)
        self._draw(world)

    def begin(self, world: World, observation: Observation) -> None:
        self.show(world)

    def step(self, world: World, transition: Transition) -> None:
        if time.monotonic() - self._drawn >= 1.0 / VIEW_HZ:
            self._draw(world)

    def end(self, success: bool) -> None:
        """The last picture stays."""

    def abort(self) -> None:
        """The last picture stays."""

    def _draw(self, world: World) -> None:
        self._drawn = time.monotonic()
        mujoco.mj_setState(self._model, self._data, world.sim_state(), INTEGRATION)
        mujoco.mj_kinematics(self._model, self._data)
        self._scene.move(self._data)


class WindowScene:
    """MuJoCo's own window. When the person closes it, nothing is drawn any more."""

    def __init__(self) -> None:
        self._window = None

    def load(self, model: mujoco.MjModel) -> None:
        """Open the window, or give its model the sizes and places of another one with the same parts."""
        if self._window is None:
            import mujoco.viewer

            self._model, self._data = model, mujoco.MjData(model)
            others = set(threading.enumerate())
            self._window = mujoco.viewer.launch_passive(model, self._data, show_left_ui=False, show_right_ui=False)
            self._drawing = set(threading.enumerate()) - others
            self._window.cam.lookat[:] = LOOK_AT
            for name, value in EYE.items():
                setattr(self._window.cam, name, value)
            self._window.opt.geomgroup[0] = 0  # robosuite's collision geoms
            self._window.opt.sitegroup[:] = 0
            return
        with self._window.lock():
            for name in FOLLOWED:
                getattr(self._model, name)[:] = getattr(model, name)

    def move(self, data: mujoco.MjData) -> None:
        assert self._window is not None
        if self._window.is_running():
            with self._window.lock():
                self._data.qpos[:] = data.qpos
                mujoco.mj_forward(self._model, self._data)
            self._window.sync()

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            for thread in self._drawing:  # ending before the window is gone would end in a crash
                thread.join()


def has_screen() -> bool:
    """Whether MuJoCo's window can open; on macOS it would need another Python."""
    if sys.platform == "linux":
        return bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
    return sys.platform == "win32"


@contextmanager
def live_view() -> Iterator[LiveView]:
    """A view of whatever world it is shown, until the block ends.

    Raises `LfdError` when there is no screen and Rerun's viewer does not start.
    """
    if has_screen():
        window = WindowScene()
        try:
            yield LiveView(window, "")
        finally:
            window.close()
        return
    from lfd.replay.rerun_live import RerunScene, serving

    with serving() as (address, source):
        scene = RerunScene(source)
        try:
            yield LiveView(scene, address)
        finally:
            scene.close()
