"""What the driver sees and drags while an arm moves: the live scene, where the gripper is, a gizmo at it."""

import time
from collections.abc import Callable

import numpy as np
import viser

from lfd.console.browser_device import BrowserDevice
from lfd.console.seats import Seats
from lfd.console.viser_scene import ViserScene
from lfd.core.protocols import Observation, Transition, World
from lfd.replay.live_view import LiveView

GIZMO_S = 0.1
"""Time between the gizmo's moves to the gripper [s]."""


class PageView:
    """A `lfd.record.session.View` in the page; while an episode lasts, dragging the gizmo moves the gripper."""

    def __init__(self, scene: ViserScene, device: BrowserDevice, gizmo: "Gizmo | None"):
        self._live, self._device, self._gizmo = LiveView(scene, ""), device, gizmo

    def show(self, world: World) -> None:
        self._live.show(world)

    def begin(self, world: World, observation: Observation) -> None:
        self._device.hand.see(observation)
        self._live.begin(world, observation)
        if self._gizmo is not None:
            self._gizmo.show()

    def step(self, world: World, transition: Transition) -> None:
        self._device.hand.see(transition.result.observation)
        self._live.step(world, transition)
        if self._gizmo is not None:
            self._gizmo.follow()

    def end(self, success: bool) -> None:
        self._live.end(success)
        self.abort()

    def abort(self) -> None:
        if self._gizmo is not None:
            self._gizmo.hide()


class Gizmo:
    """Handles at the gripper: the hand goes where they are dragged, as fast as it may."""

    def __init__(self, server: viser.ViserServer, device: BrowserDevice, seats: "Clients"):
        self._device, self._seats = device, seats
        self._is_dragged, self._moved = False, 0.0
        self._handles = server.scene.add_transform_controls("/gizmo", scale=0.22, depth_test=False, visible=False)
        self._handles.on_update(self._dragged)

    def show(self) -> None:
        self._is_dragged, self._moved = False, 0.0
        self._handles.visible = True
        self.follow()

    def hide(self) -> None:
        self._handles.visible = False
        self._device.aim(None)

    def follow(self) -> None:
        """Stay at the gripper, unless dragged."""
        now = time.monotonic()
        if not self._is_dragged and now - self._moved > GIZMO_S:
            self._moved = now
            self._handles.position, self._handles.wxyz = self._device.hand.position, self._device.hand.wxyz

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        if event.client_id is None or not self._seats.drives(event.client_id):
            return
        self._is_dragged = event.phase != "end"
        if self._is_dragged:
            self._device.aim(np.array(self._handles.position), np.array(self._handles.wxyz))
        else:
            self._device.aim(None)


class Clients:
    """Which of viser's clients is which tab."""

    def __init__(self, seats: Seats):
        self.seats = seats
        self._seat_of: dict[int, str] = {}
        self._tab_of: dict[str, str] = {}
        self._changed: list[Callable[[], None]] = []
        seats.on_change(self._tell)

    def on_change(self, call: Callable[[], None]) -> None:
        """Have a function called whenever somebody comes, goes, or another one drives."""
        self._changed.append(call)

    def came(self, client: int, seat: str) -> None:
        """A connection of the scene was given the name `seat`."""
        self._seat_of[client] = seat

    def left(self, client: int) -> None:
        """It has ended."""
        self._tab_of.pop(self._seat_of.pop(client, ""), None)

    def seated(self, seat: str, tab: str) -> None:
        """The page of that connection is the tab `tab`."""
        if seat in self._seat_of.values():
            self._tab_of[seat] = tab
        self._tell()

    def tab(self, client: int) -> str:
        """The tab of a client; empty as long as it is not known."""
        return self._tab_of.get(self._seat_of.get(client, ""), "")

    def drives(self, client: int) -> bool:
        """Whether a client's tab drives."""
        return bool(tab := self.tab(client)) and tab == self.seats.driver

    def _tell(self) -> None:
        for call in self._changed:
            call()
