"""The command that serves the console.

It imports its stage when it runs, so that `lfd --help` answers at once.
"""

import sys
import time
from argparse import Namespace
from pathlib import Path

from lfd.commands.options import Commands, Result

LOOPBACK, PORT = "127.0.0.1", 8080
SHOWN_S = 1.0
"""Time between updates of the latency that the page shows [s]."""


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "console",
        run_console,
        "serve a page in the browser to demonstrate, supervise, correct, compare and browse",
        "lfd console --folder outputs",
    )
    made.epilog += (
        "\n\nThe page is on this machine's loopback: over SSH, open it through `ssh -L 8080:127.0.0.1:8080 HOST`.\n"
        "Whoever has its whole address, which ends in a token, can use it. Ctrl-C ends it."
    )
    made.add_argument(
        "--folder", type=Path, default=Path("outputs"), metavar="DIR",
        help="where recordings, policies and rewards go, and all that the page can see (default: outputs)",
    )  # fmt: skip
    made.add_argument("--port", type=int, default=PORT, metavar="P", help=f"port to serve at (default: {PORT})")
    made.add_argument(
        "--address", default=LOOPBACK, metavar="A",
        help=f"address of this machine to serve at; with another one than {LOOPBACK} others can reach the page, who "
        "then need the token too; what is sent is not encrypted",
    )  # fmt: skip


def run_console(given: Namespace) -> Result:
    """The page, until Ctrl-C."""
    from lfd.console.console import console

    with console(given.folder, address=given.address, port=given.port) as running:
        print(f"console: {running.url}\n(Ctrl-C ends it)", file=sys.stderr, flush=True)
        try:
            while True:
                time.sleep(SHOWN_S)
                running.page.show_latency()
        except KeyboardInterrupt:
            return {"console": "ended", "folder": str(given.folder)}
