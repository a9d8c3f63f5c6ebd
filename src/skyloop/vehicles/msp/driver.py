"""The driver of ``msp://``: what the proxy calls."""

from __future__ import annotations

from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.errors import DriverError, MissingExtraError, ParameterError
from skyloop.messages import AnyAction, Capabilities, Parameter, Refusal, Takeoff, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.msp.link import EXTRA, MspLink
from skyloop.vehicles.msp.options import options_of
from skyloop.vehicles.msp.parameters import DriverParameters
from skyloop.vehicles.msp.protocol import MspSession
from skyloop.vehicles.msp.setpoints import SetpointController

ACTIONS: Final = frozenset({"idle", "attitude", "emergency_stop", "reset_emergency"})


class MspDriver(Driver):
    """A flight controller with Betaflight or INAV. ``docs/msp.md`` has its options, parameters, events and telemetry.

    It takes attitudes with a climb rate; take-off, landing, hovering and velocities come from the proxy's software
    autopilot.
    """

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._setpoints = SetpointController(self.options.override)
        self._link: MspLink | None = None

    def capabilities(self) -> Capabilities:
        """Return what it can do."""
        return Capabilities(vehicle="msp", actions=ACTIONS, description=f"a flight controller on {self.options}")

    # Life cycle ------------------------------------------------------------------------------------------------

    def _open(self, sink: Sink) -> None:
        if self.options.serial:
            try:
                import serial  # noqa: F401  the link opens it again and again, on its own thread
            except ImportError as error:
                raise MissingExtraError(f"{self.uri}", EXTRA, cause=str(error)) from error
        known = SetpointController(self.options.override)  # what was set and learnt is kept, and nothing else
        known.limits, known.gains, known.given_aux = (
            self._setpoints.limits,
            self._setpoints.gains,
            self._setpoints.given_aux,
        )
        known.hover, known.full_tilt_rad = self._setpoints.hover, self._setpoints.full_tilt_rad
        self._setpoints = known
        session = MspSession(self.options, monotonic_ns(), known)
        self._link = MspLink(session, lambda pending: _deliver(sink, pending))
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        self._link = None

    # Flying ----------------------------------------------------------------------------------------------------

    def _apply(self, action: AnyAction) -> AnyAction:
        return self._opened().command(action)

    def check(self, action: AnyAction) -> None:
        """Refuse a take-off for what keeps the flight controller from being armed, else let the next climb begin it."""
        if isinstance(action, Takeoff):
            why = self._opened().ask_takeoff()
            if why:
                raise DriverError(why)

    def left_to(self) -> str:
        """Return whether the pilot flies by the receiver."""
        link = self._link
        return "" if link is None else link.session.setpoints.left_to

    def external_pose(self, pose: ExternalPose) -> None:
        """Take in where something outside saw it: velocity, height and climb come from that."""
        self._opened().pose(pose)

    def checkup(self) -> list[Diagnostic]:
        """Return what the flight controller's settings and state say about a flight."""
        link = self._opened()
        with link.lock:
            return link.session.diagnose()

    def _opened(self) -> MspLink:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link

    # Parameters ------------------------------------------------------------------------------------------------

    def parameters(self) -> list[Parameter]:
        """Return the driver's own limits, scales, gains and AUX channels."""
        link = self._link
        if link is None:
            return DriverParameters(self._setpoints).parameters()
        with link.lock:
            return DriverParameters(self._setpoints).parameters()

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a parameter.

        Raises:
            UnknownNameError: There is no such parameter.
            ParameterError: The driver is not open, or the value does not fit.
        """
        link = self._link
        if link is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        with link.lock:
            return DriverParameters(self._setpoints).write(name, value)


def _deliver(sink: Sink, pending: list[SinkCallback]) -> None:
    for publish in pending:
        publish(sink)
