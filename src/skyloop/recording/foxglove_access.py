"""Access control for Foxglove viewers: which web pages may connect, and how viewers read and write parameters.

Any viewer can read parameters; writing one briefly acquires a lease.
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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

from skyloop.address import is_loopback
from skyloop.client import Authority, Drone, connect
from skyloop.client.channels import Listener
from skyloop.errors import ParameterError, SkyloopError, UnknownNameError
from skyloop.messages import Event, Parameter, ParameterType, Value
from skyloop.recording.taps import Parameters

LOOKS_ONLY: Final = "this view is read-only: start it with --write to write parameters"


@dataclass(frozen=True, slots=True)
class Written:
    """The result of writing a parameter."""

    name: str  #: parameter name, prefixed with the drone's name
    value: Value | None  #: the current value; None if it could not be read
    refused: str = ""  #: why the write was refused; empty if it succeeded


class ParameterAccess:
    """Reads and writes parameters by names such as ``alpha/limits.tilt``. Safe to use from any thread."""

    def __init__(
        self,
        drones: Sequence[Drone],
        priority: int | None,
        on_change: Callable[[str, Value], None] = lambda *_: None,
    ) -> None:
        """Initialise without sending any request.

        Args:
            drones: Observed drones, with distinct names.
            priority: Priority used for writes, 0 (the highest) to 31; None forbids writing.
            on_change: Called with a parameter's name and value on a separate thread: once for each parameter when
                :meth:`follow` is called, then after each change.
        """
        self._drones = {drone.name: drone for drone in drones}
        self._priority = priority
        self._on_change = on_change
        self._lock = threading.Lock()  # serialises writes and starting to follow
        self._following: list[tuple[Parameters, Listener[Event]]] = []

    def read(self, names: Iterable[str] = ()) -> dict[str, Value]:
        """Return the values of the named parameters, or of all. Wait up to 2 s for a drone that does not answer.

        Raises:
            SkyloopError: A drone does not answer.
        """
        wanted = set(names)
        of = {name.partition("/")[0] for name in wanted} if wanted else self._drones.keys()
        found = {
            f"{drone.name}/{parameter.name}": parameter.value
            for name, drone in self._drones.items()
            if name in of
            for parameter in drone.config.parameters()
        }
        return {name: value for name, value in found.items() if not wanted or name in wanted}

    def write(self, name: str, value: object) -> Written:
        """Write a parameter and return the value it has afterwards."""
        refused = ""
        with self._lock:
            try:
                self._write(name, value)
            except SkyloopError as error:
                refused = f"{name} was not written: {error.reason}"
            return Written(name, self._present(name), refused)

    def follow(self) -> None:
        """Report every parameter, then every change. Idempotent."""
        with self._lock:
            if self._following:
                return
            for drone in self._drones.values():
                followed = Parameters(drone, self._reporter(drone.name))
                self._following.append((followed, drone.on_event(followed.event, inline=True)))
                followed.start()

    def close(self) -> None:
        """Stop reporting changes."""
        for followed, listener in self._following:
            listener.cancel()
            followed.stop()

    def _reporter(self, drone: str) -> Callable[[Parameter], None]:
        return lambda parameter: self._on_change(f"{drone}/{parameter.name}", parameter.value)

    def _write(self, name: str, value: object) -> None:
        drone, key = self._found(name)
        parameter = drone.config.describe(key)
        if self._priority is None:
            raise ParameterError(LOOKS_ONLY)
        authority = Authority(priority=self._priority)
        with connect(drone.name, authority=authority, name="skyloop view", on_exit="hover") as writer:
            writer.config[key] = _typed(parameter, value)

    def _present(self, name: str) -> Value | None:
        try:
            drone, key = self._found(name)
            return drone.config[key]
        except SkyloopError:
            return None

    def _found(self, name: str) -> tuple[Drone, str]:
        drone, _, key = name.partition("/")
        if drone not in self._drones:
            raise UnknownNameError("drone in this view", drone, self._drones)
        return self._drones[drone], key


def _typed(parameter: Parameter, value: object) -> object:
    """Convert a viewer's value to the parameter's type: viewers send 1 for 1.0."""
    if parameter.type is ParameterType.FLOAT and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if parameter.type is ParameterType.INT and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


# Origins --------------------------------------------------------------------------------------------------------


MAX_HEAD: Final = 16_384  #: maximum size of a request's head [bytes]
HEAD_S: Final = 5.0  #: time limit for receiving a request's head
_CHUNK: Final = 1 << 16
_ORIGIN: Final = re.compile(rb"^origin[ \t]*:[ \t]*(.*?)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_FOXGLOVE: Final = "foxglove.dev"
_REFUSED: Final = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"pages of other origins can't connect while parameters are writable\n"
)


def is_trusted(origin: str) -> bool:
    """Return whether a page may connect: Foxglove's web page or desktop application, or a local page."""
    parts = urlsplit(origin)
    name = parts.hostname or ""
    if parts.scheme == "https" and (name == _FOXGLOVE or name.endswith(f".{_FOXGLOVE}")):
        return True
    if parts.scheme in ("http", "https"):
        return is_loopback(name)
    return parts.scheme == "file"  # Foxglove's desktop application; the origin "null" could be any page


def hidden_host() -> str:
    """Return a random loopback address, which a page can't find by scanning ports."""
    if sys.platform != "linux":
        return "127.0.0.1"
    return str(ipaddress.IPv4Address((127 << 24) + random.SystemRandom().randrange(1 << 16, 1 << 24)))


class OriginGuard:
    """Listens until :meth:`close` and forwards connections from trusted origins to the server.

    Args:
        host: Address to listen on.
        port: Port to listen on; 0 picks a free one.

    Attributes:
        port: The port it listens on.
        behind: Address and port of the server behind it; set before the port is announced.

    Raises:
        OSError: Listening on the address failed.
    """

    def __init__(self, host: str, port: int) -> None:
        guard = self

        class Visitor(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                guard._accept(self.request)

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
            target=self._server.serve_forever, args=(0.1,), name="skyloop-foxglove-guard", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop accepting connections. Existing ones end when the server does."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _accept(self, visitor: socket.socket) -> None:
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
            back = threading.Thread(target=_pump, args=(server, visitor), name="skyloop-foxglove-guard", daemon=True)
            back.start()
            _pump(visitor, server)
            back.join()


def _pump(source: socket.socket, target: socket.socket) -> None:
    """Copy bytes until either socket closes, then shut down both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            target.sendall(data)
    for one in (source, target):
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
