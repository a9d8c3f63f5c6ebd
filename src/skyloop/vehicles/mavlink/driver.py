"""The driver for ``mavlink://``, which combines the link, the camera and the parameters."""

from __future__ import annotations

from functools import partial
from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.live_camera import LiveCamera
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import deliver
from skyloop.errors import DriverError, ParameterError
from skyloop.messages import AnyAction, Capabilities, Hover, Land, Parameter, Refusal, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.mavlink.link import MavlinkLink
from skyloop.vehicles.mavlink.microservices import pose_message
from skyloop.vehicles.mavlink.options import camera_info, camera_receiver, options_of, source
from skyloop.vehicles.mavlink.parameters import (
    VehicleParameter,
    check_exact,
    limit_parameters,
    vehicle_parameters,
    with_limit,
    writable_parameter,
)
from skyloop.vehicles.mavlink.protocol import MavlinkSession
from skyloop.vehicles.mavlink.wire.codec import is_integer

ACTIONS: Final = frozenset(
    {"idle", "takeoff", "hover", "land", "attitude", "velocity", "position", "emergency_stop", "reset_emergency"}
)


class MavlinkDriver(Driver):
    """An ArduCopter or PX4 multirotor. ``docs/mavlink.md`` lists its options, parameters, events and telemetry."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        if self.options.camera is not None:
            source(uri, self.options.camera)  # raises an error now if the source is invalid
        self._link: MavlinkLink | None = None
        self._camera: LiveCamera | None = None
        self._limits = dict(self.options.limits)

    def capabilities(self) -> Capabilities:
        """Return the capabilities that both autopilots share."""
        camera = self.options.camera
        return Capabilities(
            vehicle="mavlink",
            actions=ACTIONS,
            cameras=(camera_info(self.uri, camera),) if camera is not None else (),
            description=f"a MAVLink vehicle on {self.options.address}",
        )

    def _open(self, sink: Sink) -> None:
        if self.options.camera is not None:
            self._camera = camera_receiver(self.uri, self.options.camera, sink)
            self._camera.start()
        session = MavlinkSession(self.options, monotonic_ns(), extra=self._camera_telemetry)
        session.limit(self._limits)
        self._link = MavlinkLink(session, partial(deliver, sink), serve=self.serve_link)
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        if self._camera is not None:
            self._camera.stop()
        self._link = self._camera = None

    def _camera_telemetry(self) -> dict[str, Value]:
        return {} if self._camera is None else self._camera.telemetry()

    def _apply(self, action: AnyAction) -> AnyAction:
        return self._opened().command(action)

    def _repeat(self, action: AnyAction) -> AnyAction:
        return self._opened().command(action, new=False)

    def left_to(self) -> str:
        """Return the mode chosen by a remote control, a ground station or the autopilot itself, if any."""
        link = self._link
        setpoints = link.session.setpoints if link is not None else None
        return "" if setpoints is None else setpoints.ownership.others

    def _alone(self, action: Hover | Land) -> AnyAction:
        """Hold position or land using the autopilot's own mode, without streaming set-points."""
        return self._opened().command(action, alone=True)

    def external_pose(self, pose: ExternalPose) -> None:
        """Send the pose as ``ODOMETRY``, or as the message chosen with ``?pose=``."""
        link, now_ns = self._opened(), monotonic_ns()
        bounded = pose.bounded(now_ns)
        if why := link.session.pose_problem(bounded.captured_ns, now_ns):
            raise DriverError(why)
        link.send(pose_message(bounded, self.options.pose))

    def checkup(self) -> list[Diagnostic]:
        """Return diagnostics for arming and for each of the autopilot's own failsafes, with recommended settings."""
        link = self._opened()
        with link.lock:
            session = link.session
            autopilot, values = session.autopilot, session.parameters.values
            vehicle = session.vehicle_state(monotonic_ns())
        if autopilot is None or not values:
            unread = "the vehicle's parameters have not been read: its own safety nets are unknown"
            return [Diagnostic("parameters", False, unread, "wait until its link is up, then check again")]
        name = Diagnostic("autopilot", True, session.description)
        ready = None if vehicle is None else vehicle.ready
        arming = Diagnostic("arming", ready is not False, _ARMING[ready], "" if ready else _PREARM, severe=True)
        return [
            name,
            *([] if ready is None else [arming]),
            *autopilot.safety_diagnostics(values, self.options.own_system),
        ]

    def _opened(self) -> MavlinkLink:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link

    def parameters(self) -> list[Parameter]:
        """Return the driver's own limits, plus the autopilot's parameters once they have been read."""
        return [*limit_parameters(self._limits), *(each.parameter for each in self._vehicle_parameters().values())]

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a parameter and wait up to 0.9 s for the vehicle to confirm the value in force."""
        if name in self._limits:
            return self._limit(name, value)
        parameter = writable_parameter(self._vehicle_parameters(), name)
        number = parameter.to_native(value)
        link = self._link
        if link is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        with link.lock:
            before = link.session.parameters.reported[parameter.native]
            bytewise = link.session.parameters.bytewise
        if is_integer(before.kind):
            number = check_exact(name, round(number), bytewise=bytewise)
        failure = link.write(parameter.native, number)
        if failure is not None:
            raise ParameterError(f"{name}: {failure}", code=Refusal.DRIVER_FAILED)
        with link.lock:
            after = link.session.parameters.reported[parameter.native]
        return parameter.from_native(after.value)

    def _limit(self, name: str, value: Value) -> Value:
        self._limits = with_limit(self._limits, name, value)
        link = self._link
        if link is not None:
            with link.lock:
                link.session.limit(self._limits)
        return self._limits[name]

    def _vehicle_parameters(self) -> dict[str, VehicleParameter]:
        link = self._link
        if link is None:
            return {}
        with link.lock:
            reported = dict(link.session.parameters.reported)
        return vehicle_parameters(reported)


_ARMING: Final = {True: "it reports that it can be armed", False: "it can't be armed and refuses to take off", None: ""}
_PREARM: Final = "see its messages (events with prearm): wait for GPS or its estimate, calibrate, or unlock it"
