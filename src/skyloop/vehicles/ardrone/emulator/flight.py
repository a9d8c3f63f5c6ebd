"""The firmware's flight logic: turns AT commands, gaps in them and the battery state into set-points. Pure: no clock.

The decisions are those described in the Developer Guide. Flight animations are not modelled: a request is stored and
navdata reports a flip for its duration, but the vehicle continues to follow its last command.

The values of a ``PCMD`` are fractions of the configured limits from -1 to 1, with the drone's signs: roll > 0 right,
pitch < 0 nose down, gaz > 0 up, yaw > 0 clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.messages import Attitude, EmergencyStop, FlightState, Hover, Idle, Land, ResetEmergency, Takeoff
from skyloop.messages.geometry import clamped, turned, within
from skyloop.sim.autopilot import LOW_BATTERY
from skyloop.sim.parameters import GRAVITY_M_S2, LIMIT_RANGES, Limits
from skyloop.sim.reports import VehicleFeedback
from skyloop.vehicles.ardrone.emulator.configuration import Configuration
from skyloop.vehicles.ardrone.wire.at import Pcmd, Ref
from skyloop.vehicles.ardrone.wire.configuration import FIRST_FLIP, FLIGHT_ANIMATIONS
from skyloop.vehicles.ardrone.wire.navdata import State
from skyloop.vehicles.emulation.flight import Vehicle

TAKEOFF_ALTITUDE_M: Final = 0.85  #: height after a take-off; real drones hover at 0.7 to 1 m
_LEAST_TURNING_SPEED_M_S: Final = 1.0  # minimum speed with which to compute a coordinated turn
_COMBINED_YAW_LEVEL: Final = 2  # bit 1 of control:control_level


@dataclass(frozen=True, slots=True)
class ProgressCommand:
    """A ``PCMD`` or ``PCMD_MAG`` as received.

    ``heading`` is the remote control's heading, clockwise from north, as a fraction of 180°; None in a ``PCMD``.
    """

    flags: int
    roll: float
    pitch: float
    gaz: float
    yaw: float
    heading: float | None = None

    @property
    def makes_sense(self) -> bool:
        values = (self.roll, self.pitch, self.gaz, self.yaw, self.heading or 0.0)
        return all(math.isfinite(value) for value in values)


NO_PROGRESS: Final = ProgressCommand(0, 0.0, 0.0, 0.0, 0.0)


def limits_of(configuration: Configuration) -> Limits:
    """Return the limits given by the configuration, clamped to the simulated vehicle's range."""
    return Limits(
        tilt_rad=_possible("tilt_rad", configuration.number("control:euler_angle_max")),
        climb_m_s=_possible("climb_m_s", configuration.number("control:control_vz_max") / 1000),
        yaw_rate_rad_s=_possible("yaw_rate_rad_s", configuration.number("control:control_yaw")),
        altitude_m=_possible("altitude_m", configuration.number("control:altitude_max") / 1000),
        takeoff_altitude_m=TAKEOFF_ALTITUDE_M,
    )


def set_point(
    progress: ProgressCommand, configuration: Configuration, *, yaw_rad: float, forward_m_s: float
) -> Attitude | Hover:
    """Return the set-point that a ``PCMD`` requests, within the configured limits."""
    if not progress.flags & Pcmd.PROGRESSIVE:
        return Hover()
    most_tilt = configuration.number("control:euler_angle_max")
    right, ahead = clamped(progress.roll, 1.0), -clamped(progress.pitch, 1.0)
    if progress.flags & Pcmd.ABSOLUTE and progress.heading is not None:
        # The command is relative to the remote control's heading: rotate it by its offset from the drone's heading.
        right, ahead = turned(right, ahead, (math.pi / 2 - yaw_rad) - progress.heading * math.pi)
    roll, pitch = right * most_tilt, ahead * most_tilt
    yaw_rate = -clamped(progress.yaw, 1.0) * configuration.number("control:control_yaw")
    if progress.flags & Pcmd.COMBINED_YAW and int(configuration.number("control:control_level")) & _COMBINED_YAW_LEVEL:
        yaw_rate -= GRAVITY_M_S2 * math.tan(roll) / max(forward_m_s, _LEAST_TURNING_SPEED_M_S)
    climb = clamped(progress.gaz, 1.0) * configuration.number("control:control_vz_max") / 1000
    return Attitude(roll, pitch, climb, yaw_rate)


def _possible(name: str, value: float) -> float:
    return within(value, *LIMIT_RANGES[name])


HOVER_AFTER_S: Final = 0.25  #: time without commands before hovering: general:com_watchdog in the guide (unverified)
LOST_AFTER_S: Final = 2.0  #: time without commands before the link counts as lost
CUT_OUT_TILT_RAD: Final = math.radians(60)  #: tilt that cuts the motors; an estimate, because no source gives the angle
BATTERY_RECOVERY_MV: Final = 500  #: margin above vbat_min at which a battery no longer counts as low; an estimate
CALIBRATION_RATE_RAD_S: Final = 1.5  #: yaw rate while calibrating, a full turn in about 4 s; an estimate

_FLYING: Final = (FlightState.HOVERING, FlightState.FLYING)


class ArdroneFlightControl:
    """Flies one drone. Times are on the caller's clock [ns]."""

    def __init__(self, vehicle: Vehicle, configuration: Configuration, *, version: int) -> None:
        self._vehicle = vehicle
        self._configuration = configuration
        self._version = version
        self._toggle_ready = True  # whether the emergency bit has been 0 since it last took effect
        self._emergency = State(0)  # the bits for the reasons, without EMERGENCY itself
        self._calibrating_until_ns = 0
        self._believed: VehicleFeedback | None = None
        self.start = False  #: the take-off bit in the last REF
        self.battery_low = False
        self.trim_rad = (0.0, 0.0)  #: roll and pitch measured by FTRIM, subtracted in navdata
        self.progress = NO_PROGRESS  #: the last valid PCMD or PCMD_MAG
        self.animation: tuple[int, int] | None = None  #: number and end [ns] of the animation last requested
        self.calibrations = 0  #: number of magnetometer calibrations started so far

    # Commands --------------------------------------------------------------------------------------------------

    def ref(self, bits: int) -> None:
        """Handle ``REF``: take off, land, toggle the emergency. Fixed bits are not checked: some programs omit them."""
        self.start = bool(bits & Ref.TAKEOFF)
        if bits & Ref.EMERGENCY:
            if self._toggle_ready:
                self._toggle_emergency()
        else:
            self._toggle_ready = True
        state = self._vehicle.state
        if self.start and state in (FlightState.LANDED, FlightState.LANDING) and not self.battery_low:
            self._vehicle.command(Takeoff())
        elif not self.start and state in (FlightState.TAKING_OFF, *_FLYING):
            self._vehicle.command(Land())

    def follow(self, progress: ProgressCommand, now_ns: int) -> None:
        """Handle ``PCMD`` or ``PCMD_MAG``; ignore it if a number is not finite.

        Unless the drone is hovering or flying, and during a magnetometer calibration, the command is only stored.
        """
        if not progress.makes_sense:
            return
        self.progress = progress
        if self._vehicle.state not in _FLYING or self.calibrating(now_ns):
            return
        believed = self._believed
        self._vehicle.command(
            set_point(
                progress,
                self._configuration,
                yaw_rad=believed.yaw_rad if believed else 0.0,
                forward_m_s=believed.velocity_m_s[0] if believed else 0.0,
            )
        )

    def flat_trim(self) -> None:
        """Handle ``FTRIM``: use the current attitude as level. Ignored in the air."""
        if self._vehicle.state is FlightState.LANDED and self._believed is not None:
            self.trim_rad = self._believed.roll_rad, self._believed.pitch_rad

    def calibrate(self, device: int, now_ns: int) -> None:
        """Handle ``CALIB``: turn once on the spot. Ignored on the ground, and always by an AR.Drone 1."""
        if self._version == 1 or device != 0 or self._vehicle.state not in _FLYING or self.calibrating(now_ns):
            return
        self.calibrations += 1
        self._calibrating_until_ns = now_ns + nanoseconds(2 * math.pi / CALIBRATION_RATE_RAD_S)
        self._vehicle.command(Attitude(0.0, 0.0, 0.0, -CALIBRATION_RATE_RAD_S))

    def animate(self, number: int, duration_ms: int, now_ns: int) -> None:
        """Handle ``ANIM``, or a write to the key ``control:flight_anim``. Ignored unless flying."""
        if 0 <= number < len(FLIGHT_ANIMATIONS) and 0 <= duration_ms <= 60_000 and self._vehicle.state in _FLYING:
            self.animation = number, now_ns + duration_ms * 1_000_000

    def calibrating(self, now_ns: int) -> bool:
        """Return whether the drone is turning to calibrate its magnetometer."""
        return now_ns < self._calibrating_until_ns

    def flipping(self, now_ns: int) -> bool:
        """Return whether a requested flip is still in progress."""
        return self.animation is not None and self.animation[0] >= FIRST_FLIP and now_ns < self.animation[1]

    # Supervision -----------------------------------------------------------------------------------------------

    def supervise(self, believed: VehicleFeedback, silence_s: float, now_ns: int) -> None:
        """Check the battery, the angles and, by the time since the last command, the link. Called on every report."""
        self._believed = believed
        self._watch_battery(believed)
        if believed.state is FlightState.EMERGENCY:
            self._calibrating_until_ns = 0
        elif self._vehicle.state is not FlightState.EMERGENCY:
            self._emergency = State(0)
            self._watch_angles(believed)
        self._watch_link(silence_s)
        if self._calibrating_until_ns and not self.calibrating(now_ns):
            self._calibrating_until_ns = 0
            self._in_flight(lambda: self._vehicle.command(Hover()))

    def emergency_bits(self, state: FlightState) -> State:
        """Return the navdata bits for an emergency and its reason."""
        if state is not FlightState.EMERGENCY:
            return State(0)
        return State.EMERGENCY | (self._emergency or State.CUTOUT)

    def _toggle_emergency(self) -> None:
        if self._vehicle.state is not FlightState.EMERGENCY:
            self._emergency = State.USER_EMERGENCY
            self._vehicle.command(EmergencyStop())
            self._toggle_ready = False
        elif not isinstance(self._vehicle.command(ResetEmergency()), Idle):
            self._emergency = State(0)
            self._toggle_ready = False
        # A reset during the fall is ignored; on the ground it takes effect if the emergency bit is still set.

    def _watch_battery(self, believed: VehicleFeedback) -> None:
        least_mv = self._configuration.number("general:vbat_min")
        voltage_mv = believed.battery_v * 1000
        if believed.battery <= LOW_BATTERY or voltage_mv < least_mv:
            self.battery_low = True
        elif voltage_mv > least_mv + BATTERY_RECOVERY_MV:
            self.battery_low = False
        if self.battery_low:
            self._in_flight(lambda: self._vehicle.command(Land()))

    def _watch_angles(self, believed: VehicleFeedback) -> None:
        if max(abs(believed.roll_rad), abs(believed.pitch_rad)) > CUT_OUT_TILT_RAD and believed.state.airborne:
            self._emergency = State.ANGLES_OUT_OF_RANGE
            self._vehicle.command(EmergencyStop())

    def _watch_link(self, silence_s: float) -> None:
        if silence_s < HOVER_AFTER_S:
            return
        if silence_s >= max(LOST_AFTER_S, self._configuration.number("general:com_watchdog")):
            self._in_flight(lambda: self._vehicle.command(Land()))
        elif self._vehicle.state is FlightState.FLYING:
            self._vehicle.command(Hover())

    def _in_flight(self, act: Callable[[], object]) -> None:
        if self._vehicle.state in (FlightState.TAKING_OFF, *_FLYING):
            act()
