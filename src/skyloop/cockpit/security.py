"""Who may read the page and its sockets: browsers on this host that were sent to this address, and nobody else.

A page from elsewhere can make a browser on this host send requests here. Three things stop it: the ``Host`` header must
be this server's own (or a foreign name was made to point at loopback: DNS rebinding); the ``Origin``, which browsers
add to every WebSocket and cross-site request and pages can't forge, must be this page's; and the page may load
nothing but its own files and can't be framed (Content-Security-Policy).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skyloop.errors import UsageError


def loopback_address(host: str) -> str:
    """The address to bind to. Raises :class:`UsageError` if ``host`` is not of this machine's loopback."""
    if host == "localhost":
        return "127.0.0.1"
    try:
        address = ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        raise UsageError(f"host is {host!r} and must be a loopback address: 127.0.0.1, ::1 or localhost") from None
    if not address.is_loopback:
        raise UsageError(
            f"host is {host!r}: the cockpit has no passwords and listens on loopback only (127.0.0.1 or ::1); "
            "to watch from another machine, forward the port over SSH"
        )
    return str(address)


def own_names(address: str, port: int) -> frozenset[str]:
    """What a browser may have in ``Host`` when it really means this server."""
    bare = {"localhost", f"[{address}]" if ":" in address else address}
    return frozenset(f"{name}:{port}" for name in bare) | (frozenset(bare) if port == 80 else frozenset())


def refusal(kind: str, headers: Iterable[tuple[bytes, bytes]], names: frozenset[str]) -> str | None:
    """Why a request (``kind`` is ``http`` or ``websocket``) is refused; None if it may pass."""
    given: dict[str, list[str]] = {"host": [], "origin": []}
    for name, value in headers:
        if (key := name.decode("latin-1").lower()) in given:
            given[key].append(value.decode("latin-1").lower())
    if len(given["host"]) != 1 or given["host"][0] not in names:
        return "this server answers to its own address only"
    if not given["origin"]:
        return "a WebSocket must tell its origin" if kind == "websocket" else None
    if given["origin"] != [f"http://{given['host'][0]}"]:
        return "requests from other pages are refused"
    return None


class Guard:
    """ASGI middleware: refuses what :func:`refusal` says, and puts the protecting headers on every answer."""

    def __init__(self, app: ASGIApp, names: frozenset[str]) -> None:
        self._app = app
        self._names = names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        reason = refusal(kind, scope["headers"], self._names)
        if reason is None and kind == "websocket":
            await self._app(scope, receive, send)
        elif reason is None:
            await self._app(scope, receive, _protected(send, _host(scope)))
        elif kind == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": reason})
        else:
            headers = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": 403, "headers": headers})
            await send({"type": "http.response.body", "body": reason.encode()})


def _host(scope: Scope) -> str:
    value: bytes = next(value for name, value in scope["headers"] if name.lower() == b"host")
    return value.decode("latin-1")


def _protected(send: Send, host: str) -> Send:
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        f"connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
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
            message = {**message, "headers": [*message.get("headers", []), *protecting]}
        await send(message)

    return sending
