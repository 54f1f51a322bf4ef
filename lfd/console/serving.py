"""The page's server: viser's, behind the gate, with a connection of ours beside its own.

viser has no place for a token, another connection or a script. All four pass through `websockets.asyncio.server.serve`,
which is called once while its server starts; that call is what is changed here.
"""

import gzip
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import cache
from importlib.resources import files
from io import StringIO
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from lfd.console.gate import HEADERS, Answer, Gate
from lfd.core.errors import InputError

INPUT = "/input"
"""Path of our own connection."""
LOOPBACK = "127.0.0.1"
STYLE = "[role=tab]{padding-inline:0.45em!important}"
"""So that all modes stand in one line."""

Admit = Callable[[ServerConnection, Request], Response | None]
Serve = Callable[[ServerConnection], Awaitable[None]]


@contextmanager
def page_server(address: str, port: int, gate: Gate, channel: Serve) -> Iterator[viser.ViserServer]:
    """viser's server at an address and a port, until the block ends.

    Raises `InputError` when the address is not this machine's, or the port is in use.
    """
    check_port(address, port)
    quiet = redirect_stdout(StringIO())  # of viser's own word on its address, which lacks the token
    with quiet, patch.object(websockets.asyncio.server, "serve", _guarded(gate, channel)):
        server = viser.ViserServer(host=address, port=port, label="lfd", verbose=False)
    try:
        if server.get_port() != port:  # somebody was faster, and viser took the next one
            raise InputError(_in_use(port))
        yield server
    finally:
        server.stop()


def free_port() -> int:
    """A port of the loopback that nobody has at the moment."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def check_port(address: str, port: int) -> None:
    """Raise `InputError` for a port that is in use, or an address that is not this machine's."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except socket.gaierror as error:
            raise InputError(f"{address} is no address of this machine; leave --address out for {LOOPBACK}") from error
        except OSError as error:
            raise InputError(f"{_in_use(port)} ({error.strerror})") from error


def _in_use(port: int) -> str:
    return f"port {port} cannot be had; choose another one with --port"


def _guarded(gate: Gate, channel: Serve) -> Callable[..., Any]:
    """`serve` for viser's server: what is asked for passes the gate; our connection is ours."""
    real = websockets.asyncio.server.serve

    def serve(handler: Serve, host: str, port: int, *, process_request: Admit, **options: Any) -> Any:
        async def route(connection: ServerConnection) -> None:
            asked = connection.request
            await (channel if asked is not None and _path(asked) == INPUT else handler)(connection)

        def admit(connection: ServerConnection, request: Request) -> Response | None:
            refused = gate.answer(request.path, _Plain(request.headers))
            if refused is not None:
                return _response(refused)
            if request.headers.get("Upgrade", "").lower() == "websocket":
                return None
            page = process_request(connection, request)
            if page is not None and _path(request) in ("/", "/index.html"):
                page = _with_script(page)
            if page is not None:
                for name, value in HEADERS.items():
                    page.headers[name] = value
            return page

        return real(route, host, port, process_request=admit, **options)

    return serve


class _Plain(Mapping[str, str]):
    """Headers, of which one that came twice counts as none."""

    def __init__(self, headers: Headers):
        self._headers = headers

    def __getitem__(self, name: str) -> str:
        (value,) = self._headers.get_all(name) or ("",)
        return value

    def get(self, name: str, default: Any = None) -> Any:
        values = self._headers.get_all(name)
        return values[0] if len(values) == 1 else default

    def __iter__(self) -> Iterator[str]:
        return iter(self._headers)

    def __len__(self) -> int:
        return len(self._headers)


def _path(request: Request) -> str:
    return urlsplit(request.path).path


def _response(answer: Answer) -> Response:
    body = answer.text.encode()
    headers = Headers({**HEADERS, **answer.headers, "Content-Type": "text/plain; charset=utf-8"})
    headers["Content-Length"] = str(len(body))
    return Response(answer.status, answer.status.phrase, headers, body)


def _with_script(page: Response) -> Response:
    """viser's page with our script, before its own."""
    packed = page.headers.get("Content-Encoding") == "gzip"
    body = _scripted(bytes(page.body), packed)
    headers = Headers(page.headers)
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return Response(page.status_code, page.reason_phrase, headers, body)


@cache
def _scripted(body: bytes, packed: bool) -> bytes:
    html = (gzip.decompress(body) if packed else body).decode()
    script = files("lfd.console").joinpath("input.js").read_text(encoding="utf-8")
    html = html.replace("<head>", f"<head><style>{STYLE}</style><script>{script}</script>", 1)
    html = html.replace("<title>Viser<", "<title>lfd<", 1)
    return gzip.compress(html.encode()) if packed else html.encode()
