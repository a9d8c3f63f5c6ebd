"""The connection to one flight controller and the thread that serves it, reopened for ever."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.byte_stream import ByteStream, Rank, SerialStream, TcpStream
from skyloop.drivers.msp.protocol import MspSession
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import SinkCallback

RETRY_NS: Final = nanoseconds(0.25)  #: between attempts to connect
SILENT_NS: Final = nanoseconds(3.0)  #: a connection on which nothing comes for so long is opened anew
EXTRA: Final = "msp"


class MspLink(VehicleLink[MspSession]):
    """Keeps the connection and serves the session, on a thread of its own.

    Args:
        session: The vehicle's protocol.
        deliver: Called on the link's thread with what the session has for the sink.
        clock: Monotonic, ns.
    """

    def __init__(
        self, session: MspSession, deliver: Callable[[list[SinkCallback]], None], clock: Clock = monotonic_ns
    ) -> None:
        super().__init__("skyloop-msp", session, deliver, clock, family=socket.AF_UNSPEC, close_s=3.0)
        self._stream: ByteStream | None = None
        self._broken = False

    # From the proxy's threads ------------------------------------------------------------------------------------

    def pose(self, pose: ExternalPose) -> None:
        """Take in a pose from outside. Any thread. See :meth:`MspSession.on_pose`."""
        with self.lock:
            self.session.on_pose(pose, self._clock())

    def ask_takeoff(self) -> str:
        """See :meth:`MspSession.ask_takeoff`. Any thread."""
        with self.lock:
            return self.session.ask_takeoff(self._clock())

    # On the link's thread ----------------------------------------------------------------------------------------

    def _receive(self) -> None:
        stream = self._stream
        if stream is None:
            return
        try:
            data = stream.read()
        except OSError as error:
            with self.lock:
                self.session.failed(error)
                self._close_sockets()
            return
        with self.lock:
            now_ns = self._clock()
            self.session.receive(data, now_ns)
            if self.session.due_ns <= now_ns:
                self._send_due(now_ns)

    def _send_due(self, now_ns: int) -> None:
        data = self.session.poll(now_ns)
        if self._stream is None or self._broken or not data:
            return
        try:
            self._stream.write(data)
        except OSError as error:
            self._broken = True
            self.session.broken(error, now_ns)

    def _renewal_ns(self) -> int | None:
        if self._stream is None or self._broken:
            return RETRY_NS
        return None if self.session.is_receiving else SILENT_NS

    def _open_sockets(self) -> None:
        with self.lock:
            self._close_sockets()
        made = self._opened()
        with self.lock:
            self._stream = made
            self.session.connected()
        self._watch(made, self._receive)

    def _opened(self) -> ByteStream:
        options = self.session.options
        if options.port is not None:
            return TcpStream(self._lookup.address(options.place), options.port)
        return SerialStream(options.place, options.baud, f"msp://{options.place}", EXTRA)

    def _close_sockets(self) -> None:
        stream, self._stream, self._broken = self._stream, None, False
        if stream is None:
            return
        if self._stopping.is_set():
            with suppress(OSError):
                stream.write(self.session.last_words(self._clock()), Rank.COMMAND)
        self._forget(stream)
