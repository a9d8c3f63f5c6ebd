"""Decide which requests are answered, based on the page they come from and the person who sent them. Guards all routes.

A page from another site can make a browser send requests to this server. Three checks prevent that. The ``Host`` header
must name this server, to prevent DNS rebinding. The ``Origin`` must be that of this page: browsers add this header to
every WebSocket and every request that changes something, and pages can't forge it. A link has no origin, but
``Sec-Fetch-Site`` reveals where it comes from: a link from another site may lead only to the page itself. Finally, the
page may load only its own files and can't be framed (Content-Security-Policy).

After these checks, the person's role decides (:mod:`skyloop.cockpit.access`). This module sets the role that each route
needs: observer by default, or pilot for routes that change something.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skyloop.cockpit.access import Gate, Person, TokenGate, has_token
from skyloop.errors import UsageError
from skyloop.messages import Role

LOG_IN: Final = 4401  #: WebSocket close code: not logged in
NOT_ALLOWED: Final = 4403  #: WebSocket close code: only a pilot may do this
ADMIT: Final = "admit"  #: key of the connection's state under which a function returns why a person is refused
_FOREIGN: Final = 1008  # close code: a page from another site
_LATER: Final = 1013  # close code: too many connections at present

#: Paths open to everyone: the page itself and the routes for logging in.
_PUBLIC: Final = re.compile(r"/|/static/.*|/favicon\.ico|/api/session|/api/login|/api/logout|/api/authority")
_CONTROL: Final = re.compile(r"/ws/(drones/[^/]+/)?control")
_READING: Final = ("GET", "HEAD")
_ADDRESS: Final = re.compile(r"(\[[0-9a-f:.]+\]|[0-9.]+)(?::(\d{1,5}))?")
_OWN_SITE: Final = {"same-origin", "none"}  # none: the user typed the address or opened a bookmark
_USUAL_PORT: Final = {"http": 80, "https": 443}


def bind_address(host: str) -> tuple[str, bool]:
    """Return the address to bind to and whether it is a loopback address; raise ``UsageError`` if it is no address."""
    if host == "localhost":
        return "127.0.0.1", True
    try:
        address = ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        raise UsageError(
            f"host must be an address to listen on, got {host!r}: 127.0.0.1 or ::1 for this machine only, 0.0.0.0 "
            "or :: for the network"
        ) from None
    return str(address), address.is_loopback


@dataclass(frozen=True, slots=True)
class Names:
    """The values of ``Host`` that browsers send when they genuinely want this server.

    ``any_address``: also accept any IP address with the right port, because the server listens on all addresses of the
    machine. Unlike a name, an address can't be redirected.
    """

    exact: frozenset[str]
    scheme: str
    port: int
    any_address: bool = False

    def own(self, host: str) -> bool:
        """Return whether a lowercased ``Host`` value refers to this server."""
        if host in self.exact:
            return True
        found = _ADDRESS.fullmatch(host) if self.any_address else None
        if found is None or int(found[2] or _USUAL_PORT[self.scheme]) != self.port:
            return False
        try:
            ipaddress.ip_address(found[1].strip("[]"))
        except ValueError:
            return False
        return True


def own_names(address: str, port: int, more: Iterable[str] = (), scheme: str = "http") -> Names:
    """Return the names by which browsers reach a server. ``more``: host names in addition to its own address."""
    known = ipaddress.ip_address(address)
    bare = {name.lower() for name in more}
    if known.is_loopback:
        bare.add("localhost")
    if not known.is_unspecified:
        bare.add(f"[{address}]" if known.version == 6 else address)
    exact = {f"{name}:{port}" for name in bare} | (bare if port == _USUAL_PORT[scheme] else set())
    return Names(frozenset(exact), scheme, port, known.is_unspecified)


def foreign(kind: str, method: str, headers: Iterable[tuple[bytes, bytes]], names: Names, path: str = "") -> str:
    """Return why a request can't have come from this page; empty if it can."""
    given: dict[str, list[str]] = {"host": [], "origin": [], "sec-fetch-site": []}
    for name, value in headers:
        if (key := name.decode("latin-1").lower()) in given:
            given[key].append(value.decode("latin-1").lower())
    if len(given["host"]) != 1 or not names.own(given["host"][0]):
        return "this server only answers to its own address"
    if not {*given["sec-fetch-site"]} <= _OWN_SITE and not (method in _READING and path == "/"):
        return "links and resources in other pages are refused: open the cockpit's own page"
    if not given["origin"]:
        must = kind == "websocket" or method not in _READING
        return "a WebSocket, or a request that changes something, must have an Origin header" if must else ""
    if given["origin"] != [f"{names.scheme}://{given['host'][0]}"]:
        return "requests from other pages are refused"
    return ""


def needed(kind: str, method: str, path: str) -> Role | None:
    """Return the role that a request requires, or None if anyone may send it."""
    if kind == "websocket":
        return Role.PILOT if _CONTROL.fullmatch(path) else Role.OBSERVER
    if _PUBLIC.fullmatch(path):
        return None
    return Role.OBSERVER if method in _READING else Role.PILOT


class Guard:
    """ASGI middleware that decides which requests are answered, and adds protective headers to every response.

    :func:`foreign` and :func:`needed` determine which requests are refused. The sender of every other request is stored
    in ``scope["person"]`` (None for a stranger).
    """

    def __init__(self, app: ASGIApp, names: Names, gate: Gate) -> None:
        self._app = app
        self._names = names
        self._gate = gate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        method = scope.get("method", "")
        if kind == "http":
            send = _protected(send, self._policy(scope))
        admit = scope.get("state", {}).get(ADMIT, _everybody)
        if reason := foreign(kind, method, scope["headers"], self._names, scope["path"]):
            admit(None)
            await _refuse(kind, receive, send, 403, _FOREIGN, reason)
            return
        role = needed(kind, method, scope["path"])
        person = self._gate.person(scope)
        reason = admit(person)
        if person is None and isinstance(self._gate, TokenGate) and has_token(scope):
            if not await gone_within(receive, self._gate.wrong_token_s(scope)):
                await _refuse(kind, _connected, send, 401, LOG_IN, "this token is unknown here")
        elif reason:
            await _refuse(kind, receive, send, 503, _LATER, reason)
        elif role is not None and person is None:
            await _refuse(kind, receive, send, 401, LOG_IN, self._gate.hint)
        elif role is not None and person is not None and not person.may(role):
            await _refuse(kind, receive, send, 403, NOT_ALLOWED, "only a pilot may do this, and you are an observer")
        else:
            scope["person"] = person
            await self._app(scope, receive, send)

    def _policy(self, scope: Scope) -> str:
        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name.lower() == b"host"]
        socket = "wss" if self._names.scheme == "https" else "ws"
        # A request for another host name is refused, so the policy of such a request needs no host.
        host = hosts[0] if len(hosts) == 1 and self._names.own(hosts[0].lower()) else ""
        connect = f"connect-src 'self' {socket}://{host}; " if host else ""
        return (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
            f"{connect}base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )


def person_of(scope: Scope) -> Person | None:
    """Return the sender of this request, as determined by the guard."""
    person: Person | None = scope["person"]
    return person


async def gone_within(receive: Receive, within_s: float) -> bool:
    """Wait for the client to disconnect, dropping its messages; return whether it disconnected in time."""
    try:
        async with asyncio.timeout(within_s):
            while not (await receive())["type"].endswith(".disconnect"):
                pass
    except TimeoutError:
        return False
    return True


async def _connected() -> Message:
    """Return the first message of a WebSocket, which has already been received."""
    return {"type": "websocket.connect"}


def _everybody(_: Person | None) -> str:
    """Admit everyone; used if connections are not limited."""
    return ""


async def _refuse(kind: str, receive: Receive, send: Send, status: int, code: int, reason: str) -> None:
    if kind == "http":
        headers = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": reason.encode()})
        return
    await receive()
    if code != _FOREIGN:  # accept first, because browsers report the reason only for a socket that was open
        await send({"type": "websocket.accept"})
    await send({"type": "websocket.close", "code": code, "reason": reason})


def _protected(send: Send, policy: str) -> Send:
    protecting = [
        (b"content-security-policy", policy.encode("latin-1")),
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
        (b"cross-origin-opener-policy", b"same-origin"),
        (b"cross-origin-resource-policy", b"same-origin"),
        (b"cache-control", b"no-cache"),
    ]

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", []))
            given_names = {name.lower() for name, _ in own}
            message = {**message, "headers": own + [pair for pair in protecting if pair[0] not in given_names]}
        await send(message)

    return sending
