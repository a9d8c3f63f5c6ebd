"""The base of every emulator: its thread, its ports (UDP with faults, TCP for one client), and its life cycle."""

from __future__ import annotations

import heapq
import itertools
import logging
import math
import selectors
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Final, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.errors import LinkError, UsageError
from skyloop.faults import FaultInjector, Faults
from skyloop.platform import claim_port, socket_pair
from skyloop.sim.camera import CameraModel
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence, OccurrenceKind
from skyloop.vehicles.emulation.video import VideoEncoding

_LONGEST_WAIT_S: Final = 1.0  # a socket, a timer or _wake() normally ends the loop's wait sooner
_log = logging.getLogger(__name__)


class Loop:
    """Runs callbacks on one thread, which waits for sockets, timers and work from other threads.

    Except for :meth:`post`, :meth:`start` and :meth:`stop`, call methods only on that thread, or before it starts.
    Exceptions in callbacks are logged, and the loop continues.
    """

    def __init__(self, name: str) -> None:
        self._selector = selectors.DefaultSelector()
        self._waker, self._wakened = socket_pair()
        self._waker.setblocking(False)
        self._wakened.setblocking(False)
        self._posted: deque[Callable[[], None]] = deque()
        self._timers: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.watch(self._wakened, self._empty)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; no callback runs after this returns. Must not be called by a callback."""
        self._stopping = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join()
        self._selector.close()
        self._waker.close()
        self._wakened.close()

    def post(self, call: Callable[[], None]) -> None:
        """Call a function on the loop's thread. May be called from any thread."""
        self._posted.append(call)
        self._wake()

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        """Call a function at a given time of the monotonic clock [ns]."""
        heapq.heappush(self._timers, (due_ns, next(self._order), call))

    def watch(
        self, sock: socket.socket, readable: Callable[[], None], writable: Callable[[], None] | None = None
    ) -> None:
        """Call functions whenever a socket is readable or writable, until :meth:`forget`."""
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if writable else 0)
        try:
            self._selector.modify(sock, events, (readable, writable))
        except KeyError:
            self._selector.register(sock, events, (readable, writable))

    def forget(self, sock: socket.socket) -> None:
        with suppress(KeyError, ValueError):
            self._selector.unregister(sock)

    def _run(self) -> None:
        while not self._stopping:
            wait_s = _LONGEST_WAIT_S
            if self._timers:
                wait_s = min(wait_s, max(0.0, seconds(self._timers[0][0] - monotonic_ns())))
            for key, events in self._selector.select(wait_s):
                readable, writable = key.data
                if events & selectors.EVENT_READ:
                    self._call(readable)
                if events & selectors.EVENT_WRITE and writable is not None:
                    self._call(writable)
            for _ in range(len(self._posted)):
                self._call(self._posted.popleft())
            while self._timers and self._timers[0][0] <= monotonic_ns():
                self._call(heapq.heappop(self._timers)[2])

    def _call(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception:  # noqa: BLE001  one bad datagram must not end the drone
            _log.exception("the emulated firmware raised an error and continues")

    def _wake(self) -> None:
        with suppress(OSError):  # the socket is full, so the loop is already being woken
            self._waker.send(b"\0")

    def _empty(self) -> None:
        with suppress(BlockingIOError):
            self._wakened.recv(4096)


Address = tuple[str, int]

MAX_DATAGRAM: Final = 65_507  #: largest payload of a UDP datagram over IPv4 [bytes]
_MOST_AT_ONCE: Final = 64  # number of datagrams read before other callbacks run
_SEND_BUFFER: Final = 1 << 20  # size in bytes; large enough for an AR.Drone 1's images


class DatagramPort:
    """A UDP port that replies to the address each datagram came from. Use only on the loop's thread."""

    def __init__(
        self,
        loop: Loop,
        bind: Address,
        on_datagram: Callable[[bytes, Address], None],
        *,
        name: str,
        faults: Faults,
        delay_s: float,
    ) -> None:
        self._loop = loop
        self._on_datagram = on_datagram
        self._faults = faults
        self._name = name
        self._delay_ns = nanoseconds(delay_s)
        self._inward = FaultInjector(faults, f"{name}/in")
        self._outward = FaultInjector(faults, f"{name}/out")
        self._socket = bound(socket.SOCK_DGRAM, bind, name)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        loop.watch(self._socket, self._receive)

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram. As usual with UDP, the datagram is lost if the buffer is full or there is no receiver."""
        for each in self._outward.packets(datagram):
            self._later(partial(self._send, each, to))

    def close(self) -> None:
        self._loop.forget(self._socket)
        self._socket.close()

    def _receive(self) -> None:
        for _ in range(_MOST_AT_ONCE):
            try:
                datagram, sender = self._socket.recvfrom(MAX_DATAGRAM)
            except OSError:  # there are no more datagrams, or a reply could not be delivered
                return
            for each, address in self._inward.items((datagram, sender)):
                self._later(partial(self._on_datagram, each, address))

    def _later(self, call: Callable[[], None]) -> None:
        if self._delay_ns:
            self._loop.at(monotonic_ns() + self._delay_ns, call)
        else:
            call()

    def _send(self, datagram: bytes, to: Address) -> None:
        with suppress(OSError):
            self._socket.sendto(datagram, to)


def bound(kind: socket.SocketKind, bind: Address, name: str) -> socket.socket:
    """Return a non-blocking bound socket; raise LinkError with a remedy if binding fails.

    A TCP port may be bound again while connections to an earlier firmware are still closing. A UDP port must not be
    shared, or two firmwares would steal each other's datagrams.
    """
    made = socket.socket(socket.AF_INET, kind)
    made.setblocking(False)
    if kind is socket.SOCK_STREAM:
        claim_port(made)
    try:
        made.bind(bind)
    except OSError as error:
        made.close()
        protocol = "TCP" if kind is socket.SOCK_STREAM else "UDP"
        raise LinkError(
            f"the drone's {name} port, {protocol} {bind[1]} on {bind[0]}, can't be opened ({error.strerror}): "
            "stop the program that uses it, or choose other ports"
        ) from error
    return made


_BUFFER: Final = 1 << 16  # bytes per read


class ByteServer:
    """Serves one client at a time. Meanwhile, the next client stays connected but unanswered in the kernel's backlog.

    Use only on the loop's thread.
    """

    def __init__(
        self, loop: Loop, bind: Address, on_bytes: Callable[[bytes], None], on_client: Callable[[], None], *, name: str
    ) -> None:
        self._loop = loop
        self._on_bytes = on_bytes
        self._on_client = on_client
        self._client: socket.socket | None = None
        self._server = bound(socket.SOCK_STREAM, bind, name)
        self._server.listen(4)
        loop.watch(self._server, self._accept)

    @property
    def port(self) -> int:
        return int(self._server.getsockname()[1])

    def send(self, data: bytes) -> None:
        """Send to the client, if any; bytes that do not fit in its buffer are lost, as on a serial line."""
        if self._client is None:
            return
        try:
            self._client.send(data)
        except BlockingIOError:
            return
        except OSError:
            self.drop()
            raise

    def close(self) -> None:
        self._loop.forget(self._server)
        self._server.close()
        if self._client is not None:
            self._loop.forget(self._client)
            self._client.close()

    def drop(self) -> None:
        if self._client is not None:
            self._loop.forget(self._client)
            self._client.close()
            self._client = None
            self._loop.watch(self._server, self._accept)

    def _accept(self) -> None:
        self._client, _ = self._server.accept()
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._loop.forget(self._server)
        self._loop.watch(self._client, self._receive)
        self._on_client()

    def _receive(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(_BUFFER)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.drop()
            return
        self._on_bytes(data)


# Firmware that is switched on and off --------------------------------------------------------------------------------


class Closable(Protocol):
    """A port or another recipient of images that can be closed."""

    def close(self) -> None: ...


class RunningEmulator(ABC):
    """Firmware that runs from its construction to :meth:`stop`, which is also called if the constructor fails halfway.

    State added by subclasses belongs to the loop's thread. The host's threads only store their reports and images, and
    only read values that are replaced as a whole. ``loop`` is the name for the loop's thread, or a shared loop, whose
    creator starts it after the firmware and stops it before the firmware.
    """

    def __init__(self, host: SimHost, drone: int, loop: str | Loop) -> None:
        self._host, self._drone = host, drone
        self._own_loop = isinstance(loop, str)
        self._loop = Loop(loop) if isinstance(loop, str) else loop
        self._video: VideoEncoding[Any] | None = None
        self._open: list[Closable] = []
        self._report: Report | None = None  #: the newest report
        self._posted = False

    def stop(self) -> None:
        """Switch the firmware off. The firmware's ports are free when this returns."""
        self._host.detach(self._drone, self)
        if self._video is not None:
            self._video.stop()
        if self._own_loop:
            self._loop.stop()
        for port in self._open:
            port.close()

    @abstractmethod
    def _tick(self, report: Report) -> None:
        """Handle a new report. Runs on the loop's thread."""

    def _crashed(self, text: str) -> None:  # noqa: B027
        """Handle a crash; by default its effect appears only in the drone's own data. Runs on the loop's thread."""

    def _handle_report(self) -> None:
        self._posted = False  # first, so that a report that arrives from now on is posted again
        if self._report is not None:
            self._tick(self._report)

    # Called by the host on its threads ---------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """Store the drone's newest estimate for the loop's thread, replacing any that has not been handled yet."""
        self._report = report
        if not self._posted:
            self._posted = True
            self._loop.post(self._handle_report)

    def happened(self, occurrence: Occurrence) -> None:
        """Log an event such as a collision; a crash has also stopped the motors."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)
        if occurrence.kind is OccurrenceKind.EMERGENCY:
            self._loop.post(partial(self._crashed, occurrence.text))

    def wanted_fps(self, camera: str) -> float:
        """Return the frame rate at which to render this camera: its full rate or 0."""
        return math.inf if self._video is not None and self._video.wants(camera) else 0.0

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Encode an image: BGR, uint8, shape (height, width, 3). The array must not be modified afterwards."""
        if self._video is not None:
            self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """Log an error in the simulation or the renderer. Without reports, the firmware then sends nothing."""
        _log.error("the simulation of drone %d failed: %r", self._drone, error)


LONGEST_DELAY_S: Final = 10.0  #: maximum delay that can be configured for datagrams
NO_FAULTS: Final = Faults()

R = TypeVar("R", bound=RunningEmulator)


class Emulator(ABC, Generic[R]):
    """The firmware of one drone in a host's world. As a context manager, the firmware is on within the block."""

    def __init__(self, host: SimHost, drone: int) -> None:
        self.host = host
        self.drone = drone
        self._running: R | None = None

    def start(self) -> None:
        """Switch the firmware on. Everything except the ports is reset."""
        if self._running is not None:
            raise UsageError("this firmware is already running")
        self._running = self._switched_on()

    def stop(self) -> None:
        """Switch the firmware off at once, even during an activity. Does nothing if the firmware is already off.

        The vehicle continues to follow its last command. The ports are free when this returns.
        """
        running, self._running = self._running, None
        if running is not None:
            running.stop()

    @abstractmethod
    def _switched_on(self) -> R: ...

    @property
    def _started(self) -> R:
        if self._running is None:
            raise UsageError("firmware that is not started has no ports and no state: call start() first")
        return self._running

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def checked_delay(delay_s: float) -> float:
    """Return the delay [s]; raise :class:`UsageError` unless it is from 0 to :data:`LONGEST_DELAY_S`."""
    if not 0 <= delay_s <= LONGEST_DELAY_S:
        raise UsageError(f"delay_s must be from 0 to {LONGEST_DELAY_S:g} s, got {delay_s!r}")
    return delay_s
