"""The driver for ``msp://`` addresses, and its link to the flight controller, reopened whenever it is lost."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.byte_stream import END_S, ByteStream, Rank, SerialStream, TcpStream
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_link import ConnectionLink
from skyloop.drivers.vehicle_session import SinkCallback, deliver
from skyloop.errors import DriverError, MissingExtraError, ParameterError
from skyloop.messages import AnyAction, Capabilities, Parameter, Refusal, Takeoff, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.msp.parameters import DriverParameters, options_of
from skyloop.vehicles.msp.protocol import MspSession
from skyloop.vehicles.msp.setpoints import MspSetpoints
from skyloop.vehicles.msp.wire.frames import whole_frames

ACTIONS: Final = frozenset({"idle", "attitude", "emergency_stop", "reset_emergency"})


class MspDriver(Driver):
    """A flight controller with Betaflight or INAV. ``docs/msp.md`` lists its options, parameters, events and telemetry.

    The driver accepts attitudes with a climb rate. Take-off, landing, hovering and velocities are provided by the
    proxy's software autopilot.
    """

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._setpoints = MspSetpoints(self.options.override)
        self._link: MspLink | None = None

    def capabilities(self) -> Capabilities:
        return Capabilities(vehicle="msp", actions=ACTIONS, description=f"a flight controller on {self.options}")

    def _open(self, sink: Sink) -> None:
        if self.options.serial:
            try:
                import serial  # noqa: F401  fails now if it is missing; the link's thread imports it to open the port
            except ImportError as error:
                raise MissingExtraError(f"{self.uri}", EXTRA, cause=str(error)) from error
        # A fresh controller, which keeps only the settings and learnt values of the previous one.
        before, fresh = self._setpoints, MspSetpoints(self.options.override)
        fresh.limits, fresh.gains, fresh.given_aux = before.limits, before.gains, before.given_aux
        fresh.hover, fresh.full_tilt_rad = before.hover, before.full_tilt_rad
        self._setpoints = fresh
        session = MspSession(self.options, monotonic_ns(), fresh)
        self._link = MspLink(session, partial(deliver, sink))
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        self._link = None

    def _apply(self, action: AnyAction) -> AnyAction:
        return self._opened().command(action)

    def check(self, action: AnyAction) -> None:
        """Refuse a take-off if the flight controller can't be armed; otherwise let the next climb start a take-off."""
        if isinstance(action, Takeoff):
            why = self._opened().ask_takeoff()
            if why:
                raise DriverError(why)

    def left_to(self) -> str:
        """Return ``RECEIVER`` while the pilot is flying with a receiver, otherwise an empty string."""
        link = self._link
        return "" if link is None else link.session.setpoints.left_to

    def external_pose(self, pose: ExternalPose) -> None:
        """Handle an external pose, from which velocity, height and climb are taken."""
        self._opened().pose(pose)

    def checkup(self) -> list[Diagnostic]:
        """Return diagnostics about the flight controller's settings and state."""
        link = self._opened()
        with link.lock:
            return link.session.diagnose()

    def _opened(self) -> MspLink:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link

    def parameters(self) -> list[Parameter]:
        """Return the driver's own limits, scales, gains and AUX channels."""
        link = self._link
        if link is None:
            return DriverParameters(self._setpoints).parameters()
        with link.lock:
            return DriverParameters(self._setpoints).parameters()

    def set_parameter(self, name: str, value: Value) -> Value:
        link = self._link
        if link is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        with link.lock:
            return DriverParameters(self._setpoints).write(name, value)


EXTRA: Final = "msp"


class MspLink(ConnectionLink[MspSession, ByteStream]):
    """The link to the flight controller: its thread keeps the connection open and serves the session."""

    RETRY_NS = nanoseconds(0.25)

    _silent_ns = nanoseconds(3.0)

    def __init__(
        self, session: MspSession, deliver: Callable[[list[SinkCallback]], None], clock: Clock = monotonic_ns
    ) -> None:
        super().__init__("skyloop-msp", session, deliver, clock, family=socket.AF_UNSPEC, close_s=3.0)

    # From the proxy's threads ------------------------------------------------------------------------------------

    def pose(self, pose: ExternalPose) -> None:
        """Handle an external pose; see :meth:`MspSession.on_pose`. May be called from any thread."""
        with self.lock:
            self.session.on_pose(pose, self._clock())

    def ask_takeoff(self) -> str:
        """Request a take-off; see :meth:`MspSession.ask_takeoff`. May be called from any thread."""
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
            for frame in whole_frames(data):  # if the port is full, at most one frame is truncated and none is delayed
                self._connection.write(frame, Rank.STOP if self.session.urgent else Rank.SETPOINT)
        except OSError as error:
            self._on_broken(error, now_ns)

    def _on_end(self, connection: ByteStream) -> None:
        connection.drain_s = END_S
        with suppress(OSError):
            connection.write(self.session.final_bytes(self._clock()), Rank.COMMAND)
