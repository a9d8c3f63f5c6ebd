"""The driver for ``sim://`` addresses: one simulated drone, in its own world or in a shared one."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError
from skyloop.messages import (
    AnyAction,
    Attitude,
    Capabilities,
    EventKind,
    FlightState,
    Hover,
    Land,
    LinkState,
    Parameter,
    Severity,
    Takeoff,
    Value,
    Velocity,
)
from skyloop.messages.parameter import Diagnostic
from skyloop.sim.camera import CameraModel
from skyloop.sim.host import Report, SimHost
from skyloop.sim.parameters import LIMIT_RANGES, Limits
from skyloop.sim.reports import Occurrence, OccurrenceKind, VehicleFeedback
from skyloop.sim.simulation import Simulation
from skyloop.sim.world import Wind, World
from skyloop.vehicles.sim import parameters as table
from skyloop.vehicles.sim.options import firmware_options, options_of
from skyloop.vehicles.sim.telemetry import feedback_of

if TYPE_CHECKING:
    from skyloop.sim.camera_pipeline import PipelineCamera
    from skyloop.vehicles.sim.firmware_flight import FirmwareFlight

_OCCURRENCES: Final = {
    OccurrenceKind.COLLISION: (EventKind.COLLISION, Severity.WARNING),
    OccurrenceKind.EMERGENCY: (EventKind.EMERGENCY, Severity.ERROR),
    OccurrenceKind.BATTERY_LOW: (EventKind.VEHICLE_MESSAGE, Severity.WARNING),
    OccurrenceKind.SLOW: (EventKind.VEHICLE_MESSAGE, Severity.WARNING),
}


class SimDriver(Driver):
    """A simulated drone, in its own world or on a host that several drivers share.

    Feedback also contains the true state, in ``native``: ``truth.x``, ``.y``, ``.z`` [m], ``.roll``, ``.pitch``,
    ``.yaw`` [rad], ``.vx``, ``.vy``, ``.vz`` [m/s], and for each moving target ``truth.target.x``, ``.y``, ``.z``,
    ``.yaw`` (``truth.target2`` for the second one; x, y and z also under its name: ``truth.NAME.x``), all in world
    axes. ``sim.time_s`` is the simulation's own time.

    With ``autopilot`` in the address, real firmware flies the drone. Capabilities, feedback and most parameters are
    then those of the firmware's driver, such as ``mavlink://``; everything else works as for any simulated drone.
    See ``docs/autopilots.md``.

    Args:
        uri: The vehicle's address. If ``host`` is given, only the address's options for firmware count.
        host: A shared world; None to let :meth:`open` create one.
        drone: Number of the drone on the host.
    """

    def __init__(self, uri: VehicleUri, *, host: SimHost | None = None, drone: int = 0) -> None:
        super().__init__(uri)
        own = options_of(uri)
        self.options = own
        if host is not None:
            self.options = replace(host.options, autopilot=own.autopilot, autopilot_folder=own.autopilot_folder)
        self.drone = drone
        self.host = host  #: the world; None until :meth:`open` unless a shared one was given
        self._shared = host is not None
        self._changing = threading.Lock()
        self._limits = Limits()
        self._models = self.options.cameras
        self._wind: Wind | None = None  # the value written before opening
        self._battery = self.options.battery
        self._link = True
        self._setpoints: SimSetpoints | None = None
        self._cameras: tuple[PipelineCamera, ...] = ()
        self._world: World | None = None
        self._firmware: FirmwareFlight | None = None  # None if the built-in autopilot flies the drone
        if self.options.autopilot is not None:
            from skyloop.vehicles.sim.firmware_flight import FirmwareFlight

            self._firmware = FirmwareFlight(self.options, firmware_options(uri))

    @property
    def firmware(self) -> FirmwareFlight | None:
        """The real firmware that flies the drone; None if the built-in autopilot does."""
        return self._firmware

    def capabilities(self) -> Capabilities:
        """Return the actions and cameras that the address selects."""
        if self._firmware is not None:
            return self._firmware.capabilities(self.options)
        return Capabilities(
            vehicle="sim",
            actions=self.options.native,
            cameras=tuple(model.info() for model in self._models),
            description=f"a simulated drone in the world {self.options.world!r}, seed {self.options.seed}",
        )

    def _open(self, sink: Sink) -> None:
        host = self.host if self._shared else SimHost(self.options)
        assert host is not None
        self.host = host
        self._link = True
        if self._wind is not None:
            host.set_wind(self._wind)
        simulation = host.simulation
        if self._battery != self.options.battery:
            simulation.set_charge(self.drone, self._battery)
        if self._firmware is not None:
            self._firmware.open(host, self.drone, sink)
            self._cameras = host.attach(self.drone, self, self, list(self._models))
            return
        self._setpoints = None if "takeoff" in self.options.native else SimSetpoints(simulation, self.drone)
        simulation.set_limits(self.drone, self._in_force(self._limits))
        self._cameras = host.attach(self.drone, self, self, list(self._models))
        sink.link(LinkState.UP)

    def _close(self) -> None:
        if self._firmware is not None:
            self._firmware.close()
        if self.host is not None:
            self.host.detach(self.drone, self)
        self._battery = self.options.battery

    def _in_force(self, limits: Limits) -> Limits:
        """Return the limits in force. If only set-points are native, the drone's own take-off just lifts it off."""
        if self._setpoints is None:
            return limits
        return replace(limits, takeoff_altitude_m=LIMIT_RANGES["takeoff_altitude_m"][0])

    def _apply(self, action: AnyAction) -> AnyAction:
        if self._firmware is not None:
            return self._firmware.apply(action, new=True)
        if action.name not in self.options.native:
            return super()._apply(action)
        host = self.host
        if host is None or self._sink is None or not self._link:
            return action  # lost, because the drone receives nothing
        return self._command(host, action)

    def _repeat(self, action: AnyAction) -> AnyAction:
        return self._apply(action) if self._firmware is None else self._firmware.apply(action, new=False)

    def check(self, action: AnyAction) -> None:
        """Refuse actions that the firmware would refuse; the built-in autopilot refuses no actions."""
        if self._firmware is not None:
            self._firmware.driver.check(action)

    def left_to(self) -> str:
        """Return the firmware's mode if another operator selected it, else an empty string."""
        return "" if self._firmware is None else self._firmware.driver.left_to()

    def failsafe(self, action: Hover | Land) -> bool:
        """Apply an action requested by the failsafe, through the firmware's driver if firmware flies the drone."""
        return super().failsafe(action) if self._firmware is None else self._firmware.driver.failsafe(action)

    def external_pose(self, pose: ExternalPose) -> None:
        """Pass a pose to the firmware; the built-in autopilot does not accept poses."""
        if self._firmware is None:
            super().external_pose(pose)
        else:
            self._firmware.external_pose(pose)

    def checkup(self) -> list[Diagnostic]:
        """Return the firmware's preflight findings; none for the built-in autopilot."""
        return [] if self._firmware is None else self._firmware.driver.checkup()

    def _command(self, host: SimHost, action: AnyAction) -> AnyAction:
        if self._setpoints is not None:
            return self._setpoints.command(action)
        return host.simulation.command(self.drone, action)

    def parameters(self) -> list[Parameter]:
        """Return limits, cameras, battery, wind, the radio link, the room and the objects in it."""
        world = self._known_world()
        surroundings = [] if world is None else [table.room(world.room), table.geometry(world)]
        firmware = [] if self._firmware is None else self._firmware.driver.parameters()
        return [*table.describe(self._present(), self._standard()), *surroundings, *firmware]

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a parameter; raise an error for an unknown name or an invalid value. Wind affects the whole world."""
        if self._firmware is not None and name not in table.names(self._present()):
            return self._firmware.driver.set_parameter(name, value)
        with self._changing:
            before = self._present()
            after, written = table.with_value(before, name, value)
            self._write(before, after)
            return written

    def _present(self) -> table.ParameterValues:
        wind = self._wind or (self.host.wind if self.host is not None else self._usual_wind())
        limits = None if self._firmware is not None else self._limits
        return table.ParameterValues(limits, self._models, wind, self._battery, self._link)

    def _standard(self) -> table.ParameterValues:
        limits = None if self._firmware is not None else Limits()
        return table.ParameterValues(limits, self.options.cameras, self._usual_wind(), self.options.battery)

    def _usual_wind(self) -> Wind:
        world = self._known_world()
        return Wind() if world is None else self.options.blowing(world.wind)

    def _known_world(self) -> World | None:
        """Return the world; None if it can't be loaded (:meth:`open` reports why)."""
        if self._world is None:
            with suppress(SkyloopError):
                self._world = self.host.simulation.world if self.host is not None else self.options.load_world()
        return self._world

    def _write(self, before: table.ParameterValues, after: table.ParameterValues) -> None:
        host = self.host if self._sink is not None else None
        self._models, self._battery = after.cameras, after.battery
        if after.limits is not None:
            self._limits = after.limits
        for camera, model in zip(self._cameras, after.cameras, strict=False):
            camera.model = model
        if after.wind != before.wind:
            if host is None or not self._shared:
                self._wind = after.wind
            if host is not None:
                host.set_wind(after.wind)
        if host is None:
            return
        if after.limits is not None and after.limits != before.limits:
            host.simulation.set_limits(self.drone, self._in_force(after.limits))
        if after.battery != before.battery:
            host.simulation.set_charge(self.drone, after.battery)
        if after.link != before.link:
            self._switch_link(host, after.link)

    def _switch_link(self, host: SimHost, on: bool) -> None:
        """Switch the simulated radio on or off. Without it, the built-in autopilot holds the drone's position."""
        sink = self._sink
        if sink is None:
            return
        if self._firmware is not None:
            self._link = on
            self._firmware.switch_link(on=on)
        elif on:
            self._link = True
            sink.link(LinkState.UP)
        else:
            self._link = False
            sink.link(LinkState.LOST, "the simulated radio is switched off (parameter sim.link)")
            self._command(host, Hover())

    # Called by the host on its threads -------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """Publish the drone's estimated and true state. Runs on one of the host's threads."""
        believed, sink = report.believed, self._sink
        self._battery = believed.battery
        if self._firmware is not None:
            self._firmware.report(report)
            return
        state = believed.state
        if self._setpoints is not None:
            self._setpoints.on_feedback(believed)
            state = self._setpoints.reported_state(state)
        if sink is None or not self._link:
            return
        sink.feedback(feedback_of(report, state, self.options))

    def happened(self, occurrence: Occurrence) -> None:
        """Emit an event for an occurrence. Runs on one of the host's threads."""
        sink = self._sink
        if sink is None or not self._link:
            return
        kind, severity = _OCCURRENCES[occurrence.kind]
        if occurrence.kind is OccurrenceKind.COLLISION:
            sink.event(kind, occurrence.text, severity, speed_m_s=occurrence.speed_m_s)
        else:
            reason = "simulation_slow" if occurrence.kind is OccurrenceKind.SLOW else occurrence.text
            sink.event(kind, occurrence.text, severity, reason=reason)

    def wanted_fps(self, camera: str) -> float:
        """Return the rate at which images from this camera are needed [1/s]."""
        sink = self._sink
        return sink.wanted_fps(camera) if sink is not None and self._link else 0.0

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Publish an image: BGR, uint8, shape (height, width, 3)."""
        sink = self._sink
        if sink is not None and self._link:
            sink.frame(
                model.name, pixels, captured_ns, width=model.width, height=model.height, intrinsics=model.intrinsics()
            )

    def failed(self, error: Exception) -> None:
        """Emit an event for an error in the simulation or the renderer."""
        sink = self._sink
        if sink is not None:
            sink.event(EventKind.DRIVER_ERROR, f"the simulation failed: {error!r}", Severity.ERROR, where="simulation")


LIFT_M_S: Final = 0.05  #: climb rate of a set-point above which the motors start
DOWN_M: Final = 0.08  #: height below which a descending drone counts as landed


class SimSetpoints:
    """Starts the motors for a climbing set-point, and stops them on the ground for a descending set-point.

    The simulated firmware accepts set-points only in the air, so its own take-off to the lowest height comes first.
    """

    def __init__(self, simulation: Simulation, drone: int) -> None:
        self._simulation = simulation
        self._drone = drone
        self._lock = threading.Lock()
        self._setpoint: Attitude | Velocity | None = None

    def command(self, action: AnyAction) -> AnyAction:
        """Command the drone as :meth:`Simulation.command` does, but accept set-points in every state."""
        with self._lock:
            if not isinstance(action, Attitude | Velocity):
                self._setpoint = None
                return self._simulation.command(self._drone, action)
            self._setpoint = action
            applied = self._follow(self._simulation.state(self._drone), self._simulation.feedback(self._drone))
        return action if applied is None else applied

    def on_feedback(self, believed: VehicleFeedback) -> None:
        """Start or stop the motors as required by the set-point in force and the newest reported state."""
        with self._lock:
            if self._setpoint is not None:
                self._follow(believed.state, believed)

    def reported_state(self, state: FlightState) -> FlightState:
        """Return the state as reported by a vehicle that does not distinguish hovering, taking off and landing."""
        return FlightState.FLYING if state.airborne else state

    def _follow(self, state: FlightState, believed: VehicleFeedback) -> AnyAction | None:
        setpoint = self._setpoint
        assert setpoint is not None
        climb = setpoint.climb if isinstance(setpoint, Attitude) else setpoint.up
        if state in (FlightState.LANDED, FlightState.LANDING):
            if climb > LIFT_M_S:
                self._simulation.command(self._drone, Takeoff())
            return None
        if state is FlightState.TAKING_OFF:
            return None
        if climb < 0 and believed.altitude_m < DOWN_M:
            self._simulation.command(self._drone, Land())
            return None
        return self._simulation.command(self._drone, setpoint)
