"""The driver of ``mavlink://``: what the proxy calls, put together from the link, the camera and the parameters."""

from __future__ import annotations

from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.mavlink.camera import Camera, camera_info, check_source
from skyloop.drivers.mavlink.link import Link
from skyloop.drivers.mavlink.options import options_of
from skyloop.drivers.mavlink.parameters import TAKEOFF_ALTITUDE, Entry, entries_of, entry_of, takeoff_altitude
from skyloop.drivers.mavlink.poses import pose_message
from skyloop.drivers.mavlink.safety import remarks_of
from skyloop.drivers.mavlink.session import Session
from skyloop.drivers.seams import ExternalPose, Remark
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import Telling
from skyloop.errors import DriverError, ParameterError
from skyloop.messages import (
    AnyAction,
    Capabilities,
    EventKind,
    Hover,
    Land,
    Parameter,
    Refusal,
    Severity,
    Value,
)
from skyloop.wire.mavlink.parameter_values import is_integer

ACTIONS: Final = frozenset(
    {"idle", "takeoff", "hover", "land", "attitude", "velocity", "emergency_stop", "reset_emergency"}
)


class MavlinkDriver(Driver):
    """An ArduCopter or PX4 multirotor. ``docs/mavlink.md`` has its options, parameters, events and telemetry."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        if self.options.camera is not None:
            check_source(uri, self.options.camera)
        self._link: Link | None = None
        self._camera: Camera | None = None
        self._takeoff_m = self.options.takeoff_altitude_m

    def capabilities(self) -> Capabilities:
        """The same for both autopilots."""
        camera = self.options.camera
        return Capabilities(
            vehicle="mavlink",
            actions=ACTIONS,
            cameras=(camera_info(self.uri, camera),) if camera is not None else (),
            description=f"a MAVLink vehicle on {self.options.address}",
        )

    # Life cycle ------------------------------------------------------------------------------------------------

    def _open(self, sink: Sink) -> None:
        if self.options.camera is not None:
            self._camera = Camera(self.uri, self.options.camera, sink)
            self._camera.start()
        session = Session(self.options, monotonic_ns(), extra=self._camera_telemetry)
        session.takeoff_m = self._takeoff_m
        self._link = Link(session, lambda tellings: _deliver(sink, tellings))
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        if self._camera is not None:
            self._camera.stop()
        self._link = self._camera = None

    def _camera_telemetry(self) -> dict[str, Value]:
        return {} if self._camera is None else self._camera.telemetry

    # Flying ----------------------------------------------------------------------------------------------------

    def _apply(self, action: AnyAction) -> AnyAction:
        return self._opened().command(action)

    def failsafe(self, action: Hover | Land) -> bool:
        """Hold the place, or land, by the autopilot's own mode and without a stream of set-points."""
        sink = self._sink
        try:
            self._opened().command(action, alone=True)
        except Exception as error:  # noqa: BLE001  a failsafe must come back whatever happens
            if sink is not None:
                sink.event(EventKind.DRIVER_ERROR, f"failsafe {action.name} failed: {error!r}", Severity.ERROR)
            return False
        return True

    def external_pose(self, pose: ExternalPose) -> None:
        """As ``ODOMETRY``, or what ``?pose=`` says."""
        link = self._opened()
        if not link.session.is_heard:
            raise DriverError("the vehicle is not heard: it can't be told where it is")
        link.say(pose_message(pose, self.options.pose))

    def checkup(self) -> list[Remark]:
        """Which of the autopilot's own safety nets are off, and what to set."""
        link = self._opened()
        with link.lock:
            session = link.session
            dialect, values = session.dialect, session.parameters.values
        if dialect is None or not values:
            return [Remark("parameters", False, "the vehicle's parameters were not read, so nothing is known")]
        name = Remark("autopilot", True, session.description)
        return [name, *remarks_of(dialect, values, self.options.own_system)]

    def _opened(self) -> Link:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link

    # Parameters ------------------------------------------------------------------------------------------------

    def parameters(self) -> list[Parameter]:
        """The autopilot's, once they were read, and the names that all drivers share."""
        own = takeoff_altitude(self._takeoff_m)
        return [own, *(entry.parameter for entry in self._entries().values())]

    def set_parameter(self, name: str, value: Value) -> Value:
        """Takes up to 0.9 s: the vehicle confirms with the value that is in force."""
        if name == TAKEOFF_ALTITUDE:
            return self._set_takeoff(value)
        entry = entry_of(self._entries(), name)
        number = entry.to_native(value)
        link = self._link
        if link is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        with link.lock:
            held = link.session.parameters.held[entry.native]
        if is_integer(held.kind):
            number = round(number)
        failure = link.write(entry.native, number)
        if failure is not None:
            raise ParameterError(f"{name}: {failure}", code=Refusal.DRIVER_FAILED)
        with link.lock:
            told = link.session.parameters.held[entry.native]
        return entry.from_native(told.value)

    def _set_takeoff(self, value: Value) -> Value:
        entry = Entry(takeoff_altitude(self._takeoff_m), "")
        self._takeoff_m = entry.to_native(value)
        link = self._link
        if link is not None:
            with link.lock:
                link.session.takeoff_m = self._takeoff_m
                if link.session.pilot is not None:
                    link.session.pilot.takeoff_m = self._takeoff_m
        return self._takeoff_m

    def _entries(self) -> dict[str, Entry]:
        link = self._link
        if link is None:
            return {}
        with link.lock:
            held = dict(link.session.parameters.held)
        return entries_of(held)


def _deliver(sink: Sink, tellings: list[Telling]) -> None:
    for telling in tellings:
        telling(sink)
