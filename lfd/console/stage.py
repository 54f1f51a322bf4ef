"""What goes on behind the page: one thing at a time, in a thread of its own."""

import sys
import threading
import traceback
from collections.abc import Callable

from lfd.console.browser_device import BrowserDevice, Stopped
from lfd.core.errors import InputError, LfdError

WAIT_S = 10.0
"""How long an ending waits for what goes on."""


class Stage:
    """The arm, and what it is used for."""

    def __init__(self, device: BrowserDevice, tell: Callable[[str, str], None]):
        """`tell` shows a state and what goes with it, as `lfd.record.session.Status` does."""
        self._device, self._tell, self._lock = device, tell, threading.Lock()
        self._thread: threading.Thread | None = None
        self.doing = ""

    doing: str
    """What goes on; empty for nothing."""

    def start(self, doing: str, job: Callable[[], str]) -> None:
        """Do something that ends with a sentence. Raises `InputError` while something else goes on."""
        with self._lock:
            if self.doing:
                raise InputError(f"{self.doing} goes on: press Stop first")
            self.doing = doing
        self._device.begin()
        self._tell(doing, "getting ready")
        self._thread = threading.Thread(target=self._run, args=(doing, job), name=doing, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End what goes on at its next control step."""
        self._device.stop()

    def close(self) -> None:
        """Stop, and wait for the end."""
        self.stop()
        if self._thread is not None:
            self._thread.join(WAIT_S)

    def _run(self, doing: str, job: Callable[[], str]) -> None:
        try:
            ended = job()
            self.doing = ""
            self._tell(f"{doing}: done", ended)
        except Stopped as stopped:
            self.doing = ""
            self._tell(f"{doing}: stopped", str(stopped))
        except LfdError as error:
            self.doing = ""
            self._tell(f"{doing}: error", str(error))
        except BaseException as error:  # it would be lost with the thread
            self.doing = ""
            self._tell(f"{doing}: broken", f"{type(error).__name__}: {error}; the console's terminal shows where")
            traceback.print_exception(error, file=sys.stderr)
