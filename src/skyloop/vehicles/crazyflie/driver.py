"""The driver for ``crazyflie://``, which combines the link and the parameters."""

from __future__ import annotations

from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import deliver
from skyloop.errors import DriverError, ParameterError, UsageError
from skyloop.messages import AnyAction, Capabilities, Hover, Land, Parameter, Refusal, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.crazyflie.deck import DECK_OPTIONS, DeckVideo, deck_options
from skyloop.vehicles.crazyflie.link import CrazyflieLink
from skyloop.vehicles.crazyflie.options import LinkKind, options_of
from skyloop.vehicles.crazyflie.parameters import CrazyflieParameters
from skyloop.vehicles.crazyflie.protocol import CrazyflieSession
from skyloop.vehicles.crazyflie.radio import require_usb

ACTIONS: Final = frozenset(
    {"idle", "takeoff", "hover", "land", "velocity", "attitude", "position", "emergency_stop", "reset_emergency"}
)


class CrazyflieDriver(Driver):
    """A Crazyflie, ESP-Drone or LiteWing. See ``docs/crazyflie.md`` for options, parameters, events and telemetry."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri, DECK_OPTIONS)
        deck = deck_options(uri)
        self._deck = None if deck is None else DeckVideo(deck)
        self._link: CrazyflieLink | None = None
        self._parameters: CrazyflieParameters | None = None

    def capabilities(self) -> Capabilities:
        """Return the vehicle's capabilities. A vehicle without a position refuses all flights but attitudes."""
        cameras = () if self._deck is None else (self._deck.options.camera,)
        return Capabilities(
            vehicle="crazyflie", actions=ACTIONS, cameras=cameras, description=f"a Crazyflie at {self.options}"
        )

    def _open(self, sink: Sink) -> None:
        deck = self._deck
        session = CrazyflieSession(self.options, monotonic_ns(), extra=dict if deck is None else deck.telemetry)
        if self.options.kind is LinkKind.TCP:
            raise UsageError(f"{self.uri}: flying over TCP is not supported yet")
        if self.options.kind is LinkKind.RADIO:
            require_usb()
        link = CrazyflieLink(session, lambda pending: deliver(sink, pending), serve=self.serve_link)
        self._link, self._parameters = link, CrazyflieParameters(link)
        link.start()
        if deck is not None:
            deck.open(sink)

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        if self._deck is not None:
            self._deck.close()
        self._link = self._parameters = None

    def _apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        return self._opened().command(action, new=new)

    def _repeat(self, action: AnyAction) -> AnyAction:
        return self._apply(action, new=False)

    def _alone(self, action: Hover | Land) -> AnyAction:
        return self._apply(action, new=False)

    def external_pose(self, pose: ExternalPose) -> None:
        """Send the vehicle its pose, which its Kalman filter uses."""
        self._opened().send_pose(pose)

    def checkup(self) -> list[Diagnostic]:
        """Return preflight findings from the vehicle's latest state."""
        link = self._opened()
        with link.lock:
            return link.session.diagnose()

    def parameters(self) -> list[Parameter]:
        """Return the parameters. The vehicle's own appear as soon as their values are known."""
        return [] if self._parameters is None else self._parameters.parameters()

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a parameter. Waits up to 0.95 s for the vehicle's answer."""
        if self._parameters is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        return self._parameters.write(name, value)

    def _opened(self) -> CrazyflieLink:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link
