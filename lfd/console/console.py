"""The console: the page of `lfd console`, from its server to its modes."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from secrets import token_urlsafe

import viser._messages
from websockets.asyncio.server import ServerConnection

from lfd.console.browse import add_browse
from lfd.console.browser_device import BrowserDevice
from lfd.console.channel import InputChannel
from lfd.console.compare import add_compare
from lfd.console.correct import add_correct
from lfd.console.demonstrate import add_demonstrate
from lfd.console.folder import Folder
from lfd.console.gate import Gate
from lfd.console.page import TABS, Page
from lfd.console.seats import Seats
from lfd.console.serving import LOOPBACK, page_server
from lfd.console.supervise import add_supervise
from lfd.console.view import Clients
from lfd.core.errors import InputError
from lfd.worlds.robosuite_world import make_worlds

PORT = 8080
MODES: dict[str, Callable[[Page], None]] = {
    "Demonstrate": add_demonstrate,
    "Supervise": add_supervise,
    "Correct": add_correct,
    "Compare": add_compare,
    "Browse": add_browse,
}
FIRST = ("Lift", "panda", 20)
"""What is seen before anything is begun: task, robot, control steps a second."""


@dataclass(frozen=True)
class Console:
    """A console that runs."""

    url: str
    """What to open; it ends in the token."""
    page: Page


@contextmanager
def console(
    folder: Path,
    *,
    recipes: Path = Path(),
    address: str = LOOPBACK,
    port: int = PORT,
    modes: Mapping[str, Callable[[Page], None]] = MODES,
) -> Iterator[Console]:
    """A page that works in `folder`, with the recipes below `recipes`, until the block ends.

    Without `modes` it is for whoever calls, and shows nothing by itself. Raises `InputError` when there are no recipes
    for the modes, or the port cannot be had.
    """
    for name in ("datasets", "policies") if modes else ():
        if not (recipes / name).is_dir():
            raise InputError(f"no folder {recipes / name}: the console offers its recipes; start it where they are")
    folder.mkdir(parents=True, exist_ok=True)
    token = token_urlsafe(24)
    seats = Seats()
    clients = Clients(seats)
    channel = InputChannel(seats, clients.seated)
    device = BrowserDevice(seats, channel.taken)

    async def serve(connection: ServerConnection) -> None:
        await channel.serve(connection)

    with page_server(address, port, Gate(token, port), serve) as server:
        # viser lets any page ask for an address on a server of the internet
        server._websock_server._incoming_handlers.pop(viser._messages.ShareUrlRequest, None)
        page = Page(server, clients, device, Folder(folder), recipes)
        if modes:
            tabs = page.gui.add_tab_group(order=TABS)
            for name, add in modes.items():
                with tabs.add_tab(name):
                    add(page)
            page.start("welcome", lambda: _show_arm(page))
        host = f"[{address}]" if ":" in address else address
        try:
            yield Console(f"http://{host}:{port}/?token={token}", page)
        finally:
            page.stage.close()


def _show_arm(page: Page) -> str:
    """Something to look at."""
    task, robot, control_hz = FIRST
    (world,) = make_worlds(task, robot, control_hz, most=1, progress=page.progress)
    page.view(gizmo=False).show(world)
    return "choose what to do below"
