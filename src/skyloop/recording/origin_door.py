"""Keeps web pages of others from a WebSocket server that asks nobody who they are.

A browser lets any page connect to any port of its machine, and says in the header ``Origin`` which page it is: a server
has to look (RFC 6455, section 10.2). Foxglove's SDK does not, so that it listens behind this door.
"""

from __future__ import annotations

import contextlib
import ipaddress
import random
import re
import socket
import socketserver
import sys
import threading
from typing import Any, Final
from urllib.parse import urlsplit

MAX_HEAD: Final = 16_384  #: bytes of a request's head
HEAD_S: Final = 5.0  #: for it to come
_CHUNK: Final = 1 << 16
_ORIGIN: Final = re.compile(rb"^origin[ \t]*:[ \t]*(.*?)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_FOXGLOVE: Final = "foxglove.dev"
_REFUSED: Final = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"pages of other origins are not let in while parameters can be written\n"
)


def is_trusted(origin: str) -> bool:
    """Return whether a page may connect: Foxglove's, in a browser or as an application, or one of this machine."""
    parts = urlsplit(origin)
    name = parts.hostname or ""
    if parts.scheme == "https" and (name == _FOXGLOVE or name.endswith(f".{_FOXGLOVE}")):
        return True
    if parts.scheme in ("http", "https"):
        try:
            return name == "localhost" or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False
    return parts.scheme == "file"  # the application's own; "null" may be any page's


def hidden_host() -> str:
    """Return an address of this machine's loopback that a page can't find by trying ports."""
    if sys.platform != "linux":
        return "127.0.0.1"
    return str(ipaddress.IPv4Address((127 << 24) + random.SystemRandom().randrange(1 << 16, 1 << 24)))


class OriginDoor:
    """Listens from its construction to :meth:`close`, and hands on the connections of those who are trusted.

    Args:
        host: Address to listen on.
        port: To listen on; 0 takes a free one.

    Attributes:
        port: The port.
        behind: Address and port of the server behind it; set before anybody is told of the door.

    Raises:
        OSError: It can't be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        door = self

        class Visitor(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                door._let_in(self.request)

        class Server(socketserver.ThreadingTCPServer):
            address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
            allow_reuse_address = True
            daemon_threads = True
            block_on_close = False

            def handle_error(self, request: Any, client_address: Any) -> None: ...

        self.behind: tuple[str, int] = ("", 0)
        self._server = Server((host, port), Visitor)
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="skyloop-foxglove-door", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Let nobody in any more. Connections end with the server behind the door."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _let_in(self, visitor: socket.socket) -> None:
        visitor.settimeout(HEAD_S)
        head = b""
        while b"\r\n\r\n" not in head and len(head) < MAX_HEAD:
            if not (more := visitor.recv(_CHUNK)):
                return
            head += more
        origins = _ORIGIN.findall(head.partition(b"\r\n\r\n")[0])
        if len(head) >= MAX_HEAD or not all(is_trusted(origin.decode("latin-1")) for origin in origins):
            visitor.sendall(_REFUSED)
            return
        visitor.settimeout(None)
        with socket.create_connection(self.behind, timeout=HEAD_S) as server:
            server.settimeout(None)
            server.sendall(head)
            back = threading.Thread(target=_pump, args=(server, visitor), name="skyloop-foxglove-door", daemon=True)
            back.start()
            _pump(visitor, server)
            back.join()


def _pump(source: socket.socket, target: socket.socket) -> None:
    """Copy bytes until either end is gone, and let both know then."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            target.sendall(data)
    for one in (source, target):
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
