"""Who may see the page: whoever has the token, and then the cookie that it is traded for.

    GET /?token=T     303 to / with the cookie, or 401
    GET anything      what is asked for with the cookie, or 401
    WebSocket         with the cookie, and from this page alone: the Origin must be the Host that was asked

A WebSocket is not bound by the rule that pages may read their own site alone, hence the look at the Origin.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from hmac import compare_digest
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

NO_ENTRY = "This is the console of lfd. Open the whole address that `lfd console` printed: it ends in a token.\n"
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Of every answer: the page is kept nowhere, and is in no other page's frame."""


@dataclass(frozen=True)
class Answer:
    """What is answered in the place of the page."""

    status: HTTPStatus
    text: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)


class Gate:
    """Lets in who has the token of the console at a port."""

    def __init__(self, token: str, port: int):
        self._token, self._cookie = token, f"lfd_console_{port}"  # cookies do not tell ports apart

    def answer(self, path: str, headers: Mapping[str, str]) -> Answer | None:
        """The answer to who may not have what they ask for; None for who may.

        `headers` are looked up by any case.
        """
        asked = parse_qs(urlsplit(path).query).get("token", [])
        if asked:
            if not self._is_token(asked[0]):
                return Answer(HTTPStatus.UNAUTHORIZED, NO_ENTRY)
            cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Lax; Path=/"
            return Answer(HTTPStatus.SEE_OTHER, headers={"Location": "/", "Set-Cookie": cookie})
        if not self._is_token(self._kept(headers.get("Cookie", ""))):
            return Answer(HTTPStatus.UNAUTHORIZED, NO_ENTRY)
        if headers.get("Upgrade", "").lower() == "websocket":
            origin, host = headers.get("Origin", ""), headers.get("Host", "")
            if urlsplit(origin).netloc != host or not host:
                return Answer(HTTPStatus.FORBIDDEN, "Another page may not connect to the console.\n")
        return None

    def _is_token(self, text: str) -> bool:
        return compare_digest(text.encode(), self._token.encode())

    def _kept(self, cookies: str) -> str:
        try:
            morsel = SimpleCookie(cookies).get(self._cookie)
        except CookieError:  # what some other page of this host has kept
            return ""
        return morsel.value if morsel is not None else ""
