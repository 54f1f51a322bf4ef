"""Who may see the page."""

import gzip
import http.client
import json
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from lfd.console.channel import MOST_PER_S, REFUSED, InputChannel
from lfd.console.gate import Gate
from lfd.console.seats import Seats
from lfd.console.serving import INPUT, free_port, page_server
from lfd.core.errors import InputError

TOKEN = "a-token-of-this-test"


def test_the_token_is_traded_for_a_cookie_and_nothing_is_seen_without() -> None:
    gate = Gate(TOKEN, 8080)
    first = gate.answer(f"/?token={TOKEN}", {"Host": "h"})
    assert first is not None
    assert (first.status, first.headers["Location"]) == (303, "/")
    cookie = first.headers["Set-Cookie"]
    assert cookie.startswith(f"lfd_console_8080={TOKEN};")
    assert "HttpOnly" in cookie
    assert gate.answer("/", {"Cookie": f"x=1; lfd_console_8080={TOKEN}"}) is None
    for path, cookie in (
        ("/", ""),
        ("/?token=wrong", f"lfd_console_8080={TOKEN}"),
        ("/?token=", ""),
        ("/", "lfd_console_8080=wrong"),
        ("/", f"lfd_console_8081={TOKEN}"),
        ("/", "\x01;;=="),
        ("/index.html", f"other={TOKEN}"),
    ):
        refused = gate.answer(path, {"Cookie": cookie})
        assert refused is not None, (path, cookie)
        assert refused.status == 401, (path, cookie)


@pytest.mark.parametrize(("origin", "status"), [("http://h:1", None), ("http://evil", 403), ("", 403), ("null", 403)])
def test_another_page_may_not_open_a_connection(origin: str, status: int | None) -> None:
    asked = {"Cookie": f"lfd_console_1={TOKEN}", "Upgrade": "websocket", "Host": "h:1", "Origin": origin}
    answer = Gate(TOKEN, 1).answer("/input", asked)
    assert (None if answer is None else answer.status) == status


@contextmanager
def served(seats: Seats) -> Iterator[int]:
    """A page's server with an input channel and viser behind it."""
    port, seated = free_port(), []
    channel = InputChannel(seats, lambda seat, tab: seated.append((seat, tab)))
    with page_server("127.0.0.1", port, Gate(TOKEN, port), channel.serve):
        yield port


@contextmanager
def page(port: int, cookie: str = TOKEN):
    headers = {"Cookie": f"lfd_console_{port}={cookie}"}
    with connect(
        f"ws://127.0.0.1:{port}{INPUT}", additional_headers=headers, origin=Origin(f"http://127.0.0.1:{port}")
    ) as connection:
        yield connection


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[int, Seats]]:
    seats = Seats()
    with served(seats) as port:
        yield port, seats


def asked(port: int, path: str, **headers: str) -> tuple[int, Mapping[str, str], bytes]:
    """Status, headers and body."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


def test_the_page_comes_with_its_script_to_who_has_the_cookie_and_to_nobody_else(server) -> None:
    port, _ = server
    assert asked(port, "/")[0] == 401
    assert asked(port, "/?token=guess")[0] == 401
    status, headers, _ = asked(port, f"/?token={TOKEN}")
    assert status == 303
    cookie = headers["Set-Cookie"].partition(";")[0]
    for packed in ("", "gzip"):
        status, headers, body = asked(port, "/", Cookie=cookie, **{"Accept-Encoding": packed})
        assert status == 200
        assert headers["X-Frame-Options"] == "DENY"
        text = (gzip.decompress(body) if packed else body).decode()
        assert "data-lfd-seat" in text
        assert "<title>lfd</title>" in text
    assert asked(port, "/../../etc/passwd", Cookie=cookie)[0] == 404


def test_connections_need_the_cookie_too(server) -> None:
    port, _ = server
    for path in ("/", INPUT):
        with pytest.raises(InvalidStatus) as refused, connect(f"ws://127.0.0.1:{port}{path}"):
            pass
        assert refused.value.response.status_code == 401


@pytest.mark.parametrize(
    "message",
    [
        "no JSON",
        "[]",
        json.dumps({"n": -1}),
        json.dumps({"n": 1, "keys": ["w"] * 100}),
        json.dumps({"n": 1, "pad": {"axes": [1e300], "buttons": []}}),
        '{"n": 1, "pad": {"axes": [NaN], "buttons": []}}',
        '{"n": 1, "late": [Infinity]}',
        json.dumps({"hello": {"tab": "", "seat": "s"}}),
        "[" * 4000,
        "x" * 10_000,
        b"bytes",
    ],
)
def test_what_is_no_message_ends_its_connection_and_no_other(server, message) -> None:
    port, seats = server
    with page(port) as good, page(port) as bad:
        good.send(json.dumps({"hello": {"tab": "good", "seat": "s"}}))
        assert json.loads(good.recv(5))["tab"] == "good"
        bad.send(json.dumps({"hello": {"tab": "bad", "seat": "t"}}))
        bad.send(message)
        with pytest.raises(ConnectionClosed):
            read_all(bad)
        good.send(json.dumps({"n": 7, "keys": ["w"]}))
        until(lambda: (read := seats.read()) is not None and read[0].number == 7)
    until(lambda: seats.count == 0)
    seats.pass_on("good")


def test_a_flood_is_cut_off(server) -> None:
    port, seats = server
    with page(port) as connection:
        connection.send(json.dumps({"hello": {"tab": "flood", "seat": "s"}}))
        with pytest.raises(ConnectionClosed) as closed:
            flood(connection)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == REFUSED
    until(lambda: seats.count == 0)
    seats.pass_on("flood")


def test_a_message_before_hello_is_refused(server) -> None:
    port, _ = server
    with page(port) as connection:
        connection.send(json.dumps({"n": 1}))
        with pytest.raises(ConnectionClosed):
            connection.recv(5)


def test_a_page_is_told_its_name_that_it_drives_and_its_keys(server) -> None:
    port, seats = server
    with page(port) as connection:
        connection.send(json.dumps({"hello": {"tab": "one", "seat": "s"}}))
        told = json.loads(connection.recv(5))
        assert told["drives"] is True
        assert {"w", "Enter", " "} <= set(told["known"])
    until(lambda: seats.count == 0)
    seats.pass_on("one")


def test_events_before_a_pause_of_the_arm_say_nothing_of_latency() -> None:
    seats, port = Seats(), free_port()
    channel = InputChannel(seats, lambda _seat, _tab: None)
    with page_server("127.0.0.1", port, Gate(TOKEN, port), channel.serve), page(port) as connection:
        connection.send(json.dumps({"hello": {"tab": "one", "seat": "s"}}))
        connection.recv(5)
        for number, told in ((1, {"n": 1, "paused": True}), (2, {"n": 2})):
            channel.taken(number)
            assert json.loads(connection.recv(5)) == told


def test_a_port_in_use_is_told_before_anything_is_served(server) -> None:
    port, _ = server

    async def never(_: object) -> None:
        raise AssertionError

    before = threading.active_count()
    with (
        pytest.raises(InputError, match=f"port {port} cannot be had.*--port"),
        page_server("127.0.0.1", port, Gate(TOKEN, port), never),
    ):
        pass
    assert threading.active_count() == before
    with (
        pytest.raises(InputError, match="cannot be had|no address"),
        page_server("192.0.2.1", free_port(), Gate(TOKEN, 1), never),
    ):
        pass


def read_all(connection) -> None:
    for _ in range(100):
        connection.recv(5)


def flood(connection) -> None:
    for number in range(20 * MOST_PER_S):
        connection.send(json.dumps({"n": number}))
    read_all(connection)


def until(true, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)
