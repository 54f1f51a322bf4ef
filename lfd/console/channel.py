"""The connection over which a page says what its person does, beside viser's own for the scene.

A page that says what is no message, or too much, is cut off; the loop that moves the arm never waits for it.
"""

import asyncio
import json
import time
from collections import deque
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from lfd.console.messages import LONGEST, Hello, parse
from lfd.console.seats import Seats
from lfd.core.errors import InputError
from lfd.experts.keys import MOVES, WORDS

MOST_PER_S = 250
"""Messages of a page in a second; it sends about fifty, and one more for each event."""
PAUSE_S = 1.0
"""Time without a control step after which an event was not meant for a moving arm, and says nothing of latency [s]."""
REFUSED = 1008
"""WebSocket's code for a message that breaks the rules."""
KNOWN = sorted({key for key in (*MOVES, *WORDS) if key.isprintable()} | {"Enter", "ArrowUp", "ArrowDown"})
"""Keys that the page keeps for the arm while it drives, and from the scene's camera."""


class InputChannel:
    """The connections of all pages."""

    def __init__(self, seats: Seats, seated: Callable[[str, str], None]):
        """`seated` is told the name of the scene's connection and the tab of the same page."""
        self._seats, self._seated = seats, seated
        self._links: dict[str, _Link] = {}
        self._read = 0.0
        seats.on_change(self._tell_all)

    def taken(self, number: int) -> None:
        """Tell the driver that a control step has taken in their message; from any thread."""
        link, now = self._links.get(self._seats.driver), time.monotonic()
        paused, self._read = now - self._read > PAUSE_S, now
        if link is not None:
            link.send({"n": number, "paused": True} if paused else {"n": number})

    async def serve(self, connection: ServerConnection) -> None:
        """One connection, until it ends."""
        connection.protocol.max_message_size = LONGEST
        link, tab, arrived = _Link(connection), "", deque[float](maxlen=MOST_PER_S)
        try:
            async for text in connection:
                now = time.monotonic()
                if len(arrived) == MOST_PER_S and now - arrived[0] < 1.0:
                    raise InputError(f"more than {MOST_PER_S} messages in a second")
                arrived.append(now)
                told = parse(text)
                if isinstance(told, Hello):
                    if not tab:
                        tab = self._seats.sit(told.tab)
                        self._links[tab] = link
                        link.send({"tab": tab, "known": KNOWN, "drives": tab == self._seats.driver})
                    self._seated(told.seat, tab)
                elif not tab:
                    raise InputError("a page says hello first")
                else:
                    self._seats.hear(tab, told)
        except InputError as error:
            await connection.close(REFUSED, str(error)[:100])
        except ConnectionClosed:
            pass  # how a page leaves, or is lost
        finally:
            if tab and self._links.get(tab) is link:
                del self._links[tab]
                self._seats.leave(tab)

    def _tell_all(self) -> None:
        for tab, link in list(self._links.items()):
            link.send({"drives": tab == self._seats.driver})


class _Link:
    """Sends to a page from any thread, and drops what a slow one would have to wait for."""

    def __init__(self, connection: ServerConnection):
        self._connection, self._loop = connection, asyncio.get_running_loop()
        self._waiting: dict[str, object] | None = None

    def send(self, told: dict[str, object]) -> None:
        self._loop.call_soon_threadsafe(self._queue, told)

    def _queue(self, told: dict[str, object]) -> None:
        if self._waiting is not None:
            self._waiting |= told  # the newer number, the newer driver
            return
        self._waiting = told
        self._task = self._loop.create_task(self._flush())

    async def _flush(self) -> None:
        while self._waiting:
            told, self._waiting = self._waiting, {}
            try:
                await self._connection.send(json.dumps(told))
            except ConnectionClosed:
                return
        self._waiting = None
