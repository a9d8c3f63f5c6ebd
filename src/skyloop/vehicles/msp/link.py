"""The connection to one flight controller and the thread that serves it, reopened for ever."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.byte_stream import END_S, ByteStream, Rank, SerialStream, TcpStream
from skyloop.drivers.vehicle_link import ConnectionLink
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.vehicles.msp.protocol import MspSession
from skyloop.vehicles.msp.wire.frames import whole_frames

EXTRA: Final = "msp"


class MspLink(ConnectionLink[MspSession, ByteStream]):
    """Keeps the connection and serves the session, on a thread of its own.

    Args:
        session: The vehicle's protocol.
        deliver: Called on the link's thread with what the session has for the sink.
        clock: Monotonic, ns.
    """

    RETRY_NS = nanoseconds(0.25)

    _silent_ns = nanoseconds(3.0)

    def __init__(
        self, session: MspSession, deliver: Callable[[list[SinkCallback]], None], clock: Clock = monotonic_ns
    ) -> None:
        super().__init__("skyloop-msp", session, deliver, clock, family=socket.AF_UNSPEC, close_s=3.0)

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

    def _connect(self) -> ByteStream:
        options = self.session.options
        if options.port is not None:
            return TcpStream(self._lookup.address(options.place), options.port)
        return SerialStream(options.place, options.baud, f"msp://{options.place}", EXTRA)

    def _read(self, connection: ByteStream) -> None:
        data = connection.read()
        with self.lock:
            now_ns = self._clock()
            self.session.receive(data, now_ns)
            if self.session.due_ns <= now_ns:
                self._send_due(now_ns)

    def _send_due(self, now_ns: int) -> None:
        data = self.session.poll(now_ns)
        if self._connection is None or self._broken or not data:
            return
        try:
            for frame in whole_frames(data):  # what a full port cuts is one frame, and none behind it is sent late
                self._connection.write(frame, Rank.STOP if self.session.urgent else Rank.SETPOINT)
        except OSError as error:
            self._on_broken(error, now_ns)

    def _on_end(self, connection: ByteStream) -> None:
        connection.drain_s = END_S
        with suppress(OSError):
            connection.write(self.session.last_words(self._clock()), Rank.COMMAND)
