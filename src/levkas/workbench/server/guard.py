"""Guard of every route: host, origin, token, content type, body size.

A server on 127.0.0.1 is no secret: any page that is open in a browser can send it requests. So the host has
to be its own (a page that rebinds its name to 127.0.0.1 sends its own name), requests of other
sites are refused, and all data needs a token that only the terminal has shown.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from secrets import compare_digest
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

SAFE = frozenset({"GET", "HEAD"})
SCRIPTS = tuple(
    f"/assets/{page}.{kind}" for page in ("workbench", "watch") for kind in ("js", "css")
)
OPEN = frozenset({"/", "/enter", *SCRIPTS})
"""What needs no token: the pages without any data, and where the token is handed in."""
LARGEST_ENTRY, LARGEST_BODY, LARGEST_IMPORT = 512, 1 << 20, 48 << 20
"""Bytes of a body: where no token is needed, with one, and with two files of 16 MiB in base64."""
CSP = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
HEADERS = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@dataclass(frozen=True)
class Refusal:
    """Why a request goes no further."""

    status: int
    reason: str


class Guard:
    """The outermost ASGI application.

    Parameters
    ----------
    app : ASGI application
    port : int
        That the server listens on: part of its names, and of the cookie's.
    token : str
        256 bits, as `secrets.token_urlsafe(32)` gives them.
    """

    def __init__(self, app: App, *, port: int, token: str) -> None:
        self.app, self.token = app, token
        self.cookie = cookie_of(port)
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self.origins = {f"http://{host}" for host in self.hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return
        refusal = self.judge(scope)
        body = await _body_of(receive, largest_of(scope["path"])) if refusal is None else b""
        if body is None:
            refusal = _too_long(scope["path"])
        if refusal is None and body is not None:
            await self.app(scope, _replayed(body, receive), _with_headers(send))
        elif refusal is not None:
            await _refuse(refusal, _with_headers(send))

    def judge(self, scope: Scope) -> Refusal | None:
        """Return why a request is refused, None where it may pass."""
        headers = _headers(scope)
        if headers.get("host", [""]) not in ([host] for host in self.hosts):
            return Refusal(421, "this server answers to its own name only")
        if refusal := self._origin(headers, scope):
            return refusal
        if scope["path"] not in OPEN and not self._knows(headers):
            return Refusal(401, "the token is missing or wrong; open the address of the terminal")
        if scope["method"] not in SAFE:
            kind = headers.get("content-type", [""])[-1].partition(";")[0].strip().lower()
            if kind != "application/json":
                return Refusal(415, "requests are JSON")
        lengths = headers.get("content-length", [])
        if any(_is_above(text, largest_of(scope["path"])) for text in lengths):
            return _too_long(scope["path"])
        return None

    def _origin(self, headers: dict[str, list[str]], scope: Scope) -> Refusal | None:
        origins, sites = headers.get("origin", []), headers.get("sec-fetch-site", [])
        foreign = any(origin not in self.origins for origin in origins)
        # A link may lead to the page, which holds no data; nothing else is for other sites.
        followed = scope["path"] == "/" and headers.get("sec-fetch-mode") == ["navigate"]
        foreign |= not followed and any(site not in ("same-origin", "none") for site in sites)
        if foreign or (scope["method"] not in SAFE and not origins and not sites):
            return Refusal(403, "another site, or none, sends this request")
        return None

    def _knows(self, headers: dict[str, list[str]]) -> bool:
        given = ""
        for line in headers.get("cookie", []):
            try:
                jar: SimpleCookie = SimpleCookie(line)
            except CookieError:
                continue
            given = jar[self.cookie].value if self.cookie in jar else given
        return compare_digest(given.encode(), self.token.encode())


def cookie_of(port: int) -> str:
    """Name of the cookie: browsers share cookies between the ports of one host."""
    return f"levkas-{port}"


def _headers(scope: Scope) -> dict[str, list[str]]:
    """Headers by name, every value of each: two hosts are not one."""
    found: dict[str, list[str]] = {}
    for name, value in scope.get("headers", []):
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            given = {name.lower() for name, _ in message.get("headers", [])}
            more = {**HEADERS, "cache-control": "no-store"}
            message["headers"] = [
                *message.get("headers", []),
                *((k.encode(), v.encode()) for k, v in more.items() if k.encode() not in given),
            ]
        await send(message)

    return sending


def largest_of(path: str) -> int:
    """Return how many bytes a body may have that is sent to this path."""
    if path in OPEN:
        return LARGEST_ENTRY
    return LARGEST_IMPORT if path.endswith("/import") else LARGEST_BODY


def _is_above(length: str, most: int) -> bool:
    """Whether a length that is announced is more, or no length at all."""
    return not (length.isascii() and length.isdigit()) or len(length) > 9 or int(length) > most


def _too_long(path: str) -> Refusal:
    return Refusal(413, f"the request is too long: at most {largest_of(path):,} bytes")


async def _body_of(receive: Receive, most: int) -> bytes | None:
    """Return the body; None as soon as more than `most` bytes have come, whatever was announced."""
    parts: list[bytes] = []
    taken, more = 0, True
    while more:
        message = await receive()
        if message["type"] != "http.request":  # the client has disconnected
            break
        parts.append(message.get("body", b""))
        taken, more = taken + len(parts[-1]), message.get("more_body", False)
        if taken > most:
            return None
    return b"".join(parts)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Give a body that was read already, then what comes after it."""
    given = False

    async def receiving() -> MutableMapping[str, Any]:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return receiving


async def _refuse(refusal: Refusal, send: Send) -> None:
    problem = {"code": "E_NOT_ALLOWED", "message": refusal.reason}
    body = json.dumps({"ok": False, "problems": [problem]}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": refusal.status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
