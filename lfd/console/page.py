"""The page: its scene, who drives, what goes on, and the tabs of its modes."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
import viser

from lfd.console.browser_device import BrowserDevice
from lfd.console.folder import Folder
from lfd.console.html import block, text
from lfd.console.stage import Stage
from lfd.console.view import Clients, Gizmo, PageView
from lfd.console.viser_scene import EYE, LOOK_AT, ViserScene
from lfd.core.errors import LfdError
from lfd.experts.keys import Word

TELL_S = 0.15
"""Time between updates of what goes on, unless it becomes something else [s]."""
ON_TIME_MS = 60.0
"""The median latency that the console is to keep [ms]."""
TOP, BAR, TABS = 0.0, 1.0, 2.0


class Page:
    """What the modes stand on."""

    def __init__(
        self, server: viser.ViserServer, clients: Clients, device: BrowserDevice, folder: Folder, recipes: Path
    ):
        """`recipes` is where `datasets/` and `policies/` are."""
        self.server, self.gui, self.clients, self.device, self.folder = server, server.gui, clients, device, folder
        self.recipes = recipes
        self.scene = ViserScene(server)
        self.stage = Stage(device, self.tell)
        self._gizmo = Gizmo(server, device, clients)
        self._told = ("", 0.0)
        self._lines: dict[int, Callable[[], None]] = {}
        self._look()
        self._at_the_top()
        clients.on_change(self._show_drivers)
        server.on_client_connect(self._greet)
        server.on_client_disconnect(self._forget)

    def view(self, *, gizmo: bool) -> PageView:
        """What shows the arm, with something to drag if wanted."""
        return PageView(self.scene, self.device, self._gizmo if gizmo else None)

    def tell(self, state: str, detail: str) -> None:
        """Show what goes on; `lfd.record.session.Status`."""
        now, (before, at) = time.monotonic(), self._told
        if state == before and now - at < TELL_S:
            return
        self._told = (state, now)
        tone = "color:#b91c1c" if state.endswith(("error", "broken")) else ""
        self._status.content = block("status", f"<b>{text(state)}</b><br>{text(detail)}", tone)

    @contextmanager
    def progress(self, label: str, total: int) -> Iterator["_Bar"]:
        """A bar of the page; `lfd.core.protocols.Progress`. Its work can be stopped."""
        self.tell(self.stage.doing, label)
        bar = _Bar(self, label, total)
        self._bar.visible = True
        try:
            yield bar
        finally:
            self._bar.visible = False
            self._bar_label.content = ""

    def show_latency(self) -> None:
        """Show how late control steps take in what the driver does."""
        late = np.array(list(self.clients.seats.latencies_ms))
        if len(late):
            median, worst = np.median(late), np.percentile(late, 95)
            told = f"input to control step: median {median:.0f} ms, 95% within {worst:.0f} ms ({len(late)} events)"
        else:
            told = "input to control step: nothing measured yet"
        self._latency.content = block("latency", told, "opacity:0.7")

    def button(self, label: str, act: Callable[[], None], **options: Any) -> viser.GuiButtonHandle:
        """A button that only the driver's press has an effect of."""
        button = self.gui.add_button(label, **options)
        button.on_click(lambda event: self._pressed(event.client_id, act))
        return button

    def words(self, *words: Word) -> None:
        """Buttons that say words, for those without a keyboard."""
        self.choices("say", {str(word): word for word in words}, self.device.say)

    def choices[Choice](self, label: str, options: Mapping[str, Choice], act: Callable[[Choice], None]) -> None:
        """Buttons side by side, of which each does the same with something else."""
        group = self.gui.add_button_group(label, list(options))
        group.on_click(lambda event: self._pressed(event.client_id, lambda: act(options[event.target.value])))

    def start(self, doing: str, job: Callable[[], str]) -> None:
        """Have something go on. Raises `InputError` while something else does."""
        self.stage.start(doing, job)

    def _pressed(self, client: int | None, act: Callable[[], None]) -> None:
        if client is None or not self.clients.drives(client):
            self._warn(client, "You watch. Press Take the arm first, when nobody drives.")
            return
        try:
            act()
        except LfdError as error:
            self._warn(client, str(error))

    def _warn(self, client: int | None, text: str) -> None:
        handle = self.server.get_clients().get(-1 if client is None else client)
        if handle is not None:
            handle.add_notification("Not done", text, color="orange", auto_close_seconds=8.0)

    def look(self, eye: tuple[float, float, float], look_at: tuple[float, float, float]) -> None:
        """Have everybody look from one point at another [m]."""
        first = self.server.initial_camera
        first.position, first.look_at = eye, look_at
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = eye, look_at

    def _look(self) -> None:
        self.server.scene.set_up_direction("+z")
        self.server.initial_camera.fov = 0.75
        self.look(EYE, LOOK_AT)
        self.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self.gui.main_panel.dock_right()

    def _at_the_top(self) -> None:
        self._status = self.gui.add_html("", order=BAR)
        self._bar_label = self.gui.add_html("", order=BAR + 0.1)
        self._bar = self.gui.add_progress_bar(0.0, order=BAR + 0.2, visible=False)
        self._latency = self.gui.add_html("", order=BAR + 0.3)
        self.button(
            "Stop", self.stage.stop, color="red", order=BAR + 0.4, hint="ends what goes on; what is whole stays"
        )
        self.tell("ready", "choose what to do below")
        self.show_latency()

    def _greet(self, client: viser.ClientHandle) -> None:
        """Give a page its name, and its own line about who drives."""
        seat = token_hex(8)
        self.clients.came(client.client_id, seat)
        line = client.gui.add_html("", order=TOP)
        take = client.gui.add_button("Take the arm", order=TOP + 0.1, visible=False)
        give = client.gui.add_button("Pass the arm on", order=TOP + 0.2, visible=False)
        seats = self.clients.seats

        @take.on_click
        def _(_event: object) -> None:
            seats.take(self.clients.tab(client.client_id))

        @give.on_click
        def _(_event: object) -> None:
            seats.pass_on(self.clients.tab(client.client_id))

        def show() -> None:
            drives, free = self.clients.drives(client.client_id), not seats.driver
            told = "You drive" if drives else "Nobody drives" if free else "Somebody else drives, you watch"
            line.content = block(f'seat="{seat}"', f"<b>{told}</b> &middot; {seats.count} here")
            take.visible, give.visible = not drives, drives

        self._lines[client.client_id] = show
        show()

    def _forget(self, client: viser.ClientHandle) -> None:
        self._lines.pop(client.client_id, None)
        self.clients.left(client.client_id)

    def _show_drivers(self) -> None:
        there = self.server.get_clients()
        for client, show in list(self._lines.items()):
            if client in there:  # its own farewell may come later
                show()


class _Bar:
    """A running bar: how far, how fast, how long still."""

    def __init__(self, page: Page, label: str, total: int):
        self._page, self._label, self._total = page, label, max(total, 1)
        self._done, self._began, self._shown = 0, time.monotonic(), 0.0
        self._show("")

    def advance(self, amount: int = 1, note: str = "") -> None:
        self._page.device.check()
        self._done += amount
        if time.monotonic() - self._shown > TELL_S or self._done >= self._total:
            self._show(note)

    def _show(self, note: str) -> None:
        self._shown = now = time.monotonic()
        rate = self._done / max(now - self._began, 1e-3)
        left = f", {(self._total - self._done) / rate:.0f} s left" if self._done else ""
        page = self._page
        page._bar.value = min(100.0, 100.0 * self._done / self._total)
        told = f"{self._label}: {self._done} of {self._total}{left} {note}"
        page._bar_label.content = block("progress", text(told))
