"""Differences between ArduCopter and PX4 in modes, commands, thrust and safety nets. Pure.

``docs/mavlink.md`` describes where each difference was observed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.mavlink.microservices import VehicleCommand
from skyloop.vehicles.mavlink.telemetry import (
    EKF_CONSTANT,
    EKF_PLACE,
    PREARM,
    SLOW_S,
    STANDARD_GRAVITY,
    MavlinkTelemetry,
    VehicleState,
)
from skyloop.vehicles.mavlink.wire.codec import COPTER_NUMBERS, PX4_NUMBERS, Landed, MavAutopilot, copter_mode, px4_mode
from skyloop.vehicles.mavlink.wire.codec import dialect as m

CLIMB_GAIN_PER_S: Final = 2.0  #: acceleration per unit of climb rate error
ALTITUDE_GAIN_PER_S2: Final = 0.8  #: acceleration per unit of altitude error, the integral of the climb rate error
MOST_ALTITUDE_ERROR_M: Final = 1.5  #: limit of the altitude error
LEAST_THRUST: Final = 0.1  #: lower limit of the thrust field
MOST_THRUST: Final = 0.9  #: upper limit of the thrust field


class ClimbRateThrust:
    """Thrust field of ``SET_ATTITUDE_TARGET`` for ArduCopter: a fraction of its maximum climb or descent rate."""

    def __init__(self, up_m_s: float, down_m_s: float) -> None:
        self._up, self._down = up_m_s, down_m_s

    def limit_climb(self, climb_m_s: float) -> float:
        """Return the climb rate limited to what the autopilot accepts, positive up [m/s]."""
        return max(-self._down, min(self._up, climb_m_s))

    def thrust(self, climb_m_s: float, climbing_m_s: float | None, tilt_rad: float, step_s: float) -> float:  # noqa: ARG002
        """Return the thrust field, 0 to 1, for a requested climb rate, positive up; 0.5 holds the altitude."""
        climb = self.limit_climb(climb_m_s)
        return 0.5 + 0.5 * climb / (self._up if climb > 0 else self._down)


class CollectiveThrust:
    """The same field as collective thrust, for PX4, and for ArduCopter if its ``GUID_OPTIONS`` selects it.

    During one attitude-controlled flight, a proportional-integral loop holds the climb rate; its integral is an
    altitude error. An implausible hover thrust is replaced by 0.5.
    """

    def __init__(self, hover: float) -> None:
        self._hover = hover if math.isfinite(hover) and 0.1 <= hover <= 0.9 else 0.5
        self._error_m = 0.0

    def limit_climb(self, climb_m_s: float) -> float:
        """Return the climb rate, which PX4 does not limit."""
        return climb_m_s

    def thrust(self, climb_m_s: float, climbing_m_s: float | None, tilt_rad: float, step_s: float) -> float:
        """Return the thrust field (0 to 1) for the requested and measured climb rates, positive up, and the tilt."""
        error = climb_m_s - climbing_m_s if climbing_m_s is not None else 0.0
        self._error_m += error * step_s
        self._error_m = max(-MOST_ALTITUDE_ERROR_M, min(MOST_ALTITUDE_ERROR_M, self._error_m))
        upward = CLIMB_GAIN_PER_S * error + ALTITUDE_GAIN_PER_S2 * self._error_m
        thrust = self._hover * (1.0 + upward / STANDARD_GRAVITY) / max(0.5, math.cos(tilt_rad))
        return max(LEAST_THRUST, min(MOST_THRUST, thrust))


ThrustModel = ClimbRateThrust | CollectiveThrust
CUSTOM: Final = 1.0  #: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
REACHED_M: Final = 0.2  #: distance below its target altitude at which a take-off counts as complete
EKF_UNINITIALISED: Final = 0x400  #: flag in EKF_STATUS_REPORT
THRUST_AS_THRUST: Final = 8  #: bit of ArduCopter's GUID_OPTIONS: the thrust field is collective thrust

Values = Mapping[str, float]  #: parameter values keyed by the autopilot's own names


@dataclass(frozen=True, slots=True)
class _SafetyNet:
    """An autopilot failsafe set by a parameter. Effects were observed, or are in the parameter references."""

    name: str  #: name of the parameter
    what: str
    good: Callable[[float], bool]  #: returns whether a value is safe
    otherwise: str  #: consequence of an unsafe value
    advised: float  #: a safe value
    unit: str = ""

    def diagnostic(self, value: float) -> Diagnostic:
        """Return a diagnostic for the parameter's value."""
        detail = f"{self.name} is {value:g} {self.unit}".rstrip()
        if self.good(value):
            return Diagnostic(self.what, True, detail)
        return Diagnostic(
            self.what,
            False,
            f"{detail}: {self.otherwise}",
            f"skyloop param NAME mavlink.{self.name.lower()} {self.advised:g}",
        )


def _on(value: float) -> bool:
    return value != 0


class AutopilotProfile(ABC):
    """The specifics of one autopilot. Stateless."""

    NAME: ClassVar[str]
    GUIDED: ClassVar[str]  #: the mode that follows set-points
    HOLD: ClassVar[str]  #: the mode that holds position without set-points
    LAND: ClassVar[str]
    ARMING: ClassVar[str]  #: the mode required for arming
    HOLDING: ClassVar[frozenset[str]]  #: modes in which the vehicle stays in place without set-points
    LANDING: ClassVar[frozenset[str]]
    TAKING_OFF: ClassVar[frozenset[str]]
    NEEDS_STICKS: ClassVar[frozenset[str]]  #: modes that are flown with a remote control
    LEAD_S: ClassVar[float]  #: how long set-points must arrive before the vehicle enters GUIDED
    BYTEWISE: ClassVar[bool]  #: whether integers are written bytewise if the capabilities do not specify it
    EARTH_RADIUS_M: ClassVar[float]  #: radius of the sphere that the autopilot uses to convert latitude and longitude
    SAFETY_NETS: ClassVar[tuple[_SafetyNet, ...]]

    @abstractmethod
    def mode_of(self, custom_mode: int) -> str: ...

    @abstractmethod
    def mode_command(self, mode: str) -> VehicleCommand: ...

    @abstractmethod
    def takeoff_command(self, height_m: float, vehicle: VehicleState) -> VehicleCommand | None:
        """Return the take-off command; None while the altitude that it needs is unknown."""

    @abstractmethod
    def has_taken_off(self, vehicle: VehicleState, height_m: float, rose: bool) -> bool:
        """Return whether a take-off is complete; ``rose``: whether the vehicle has been airborne since accepting it."""

    @abstractmethod
    def ready(self, telemetry: MavlinkTelemetry, now_ns: int) -> bool | None:
        """Return whether the vehicle can be armed; None if it does not report that."""

    @abstractmethod
    def message_rates(self, rate_hz: float) -> dict[str, float]:
        """Return the rates of the required messages [1/s] by name."""

    @abstractmethod
    def thrust_model(self, values: Values) -> ThrustModel:
        """Return the model that turns climb rates into thrust."""

    def safety_diagnostics(self, values: Values, own_system: int) -> list[Diagnostic]:  # noqa: ARG002
        """Return a diagnostic for each safety net.

        By default, if this computer or its link fails, both autopilots merely stop following the last set-point.
        """
        return [net.diagnostic(values[net.name]) for net in self.SAFETY_NETS if net.name in values]


class ArduCopterProfile(AutopilotProfile):
    """ArduCopter."""

    NAME = "ArduCopter"
    EARTH_RADIUS_M = math.degrees(111_318.845_021_45)  # AP_Math/definitions.h: LATLON_TO_M, per 1e-7 °
    GUIDED = "GUIDED"
    HOLD = "BRAKE"
    LAND = "LAND"
    ARMING = "GUIDED"
    HOLDING = frozenset({"BRAKE"})
    LANDING = frozenset({"LAND"})
    TAKING_OFF: ClassVar[frozenset[str]] = frozenset()
    NEEDS_STICKS = frozenset({"STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "DRIFT", "SPORT", "POSHOLD", "FLOWHOLD"})
    LEAD_S = 0.0
    BYTEWISE = False
    SAFETY_NETS = (
        _SafetyNet("FS_GCS_ENABLE", "loss of this computer", _on, "it hovers until the battery is empty", 7),
        _SafetyNet("FS_GCS_TIMEOUT", "time until its loss counts", lambda s: s <= 5, "it takes over 5 s", 5, "s"),
        _SafetyNet("GUID_TIMEOUT", "loss of set-points", lambda s: 0 < s <= 3, "it keeps flying for too long", 1, "s"),
        _SafetyNet("FS_EKF_ACTION", "loss of position", _on, "it does nothing", 1),
        _SafetyNet("BATT_FS_LOW_ACT", "low battery", _on, "it does nothing", 1),
        _SafetyNet("FENCE_ENABLE", "fence", _on, "it has none of its own", 1),
    )

    mode_of = staticmethod(copter_mode)

    def mode_command(self, mode: str) -> VehicleCommand:
        return VehicleCommand(m.MAV_CMD_DO_SET_MODE, (CUSTOM, float(COPTER_NUMBERS[mode])))

    def takeoff_command(self, height_m: float, vehicle: VehicleState) -> VehicleCommand | None:  # noqa: ARG002
        """Return the take-off command, with a relative altitude."""
        return VehicleCommand(m.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m))

    def has_taken_off(self, vehicle: VehicleState, height_m: float, rose: bool) -> bool:
        """Return whether the altitude has been reached, which is the only sign that a take-off is complete."""
        return rose and vehicle.altitude_m is not None and vehicle.altitude_m >= height_m - REACHED_M

    def ready(self, telemetry: MavlinkTelemetry, now_ns: int) -> bool | None:
        """Return whether the pre-arm checks pass and the estimator has a position."""
        good = telemetry.prearm_good(now_ns)
        ekf = telemetry.newest("EKF_STATUS_REPORT", now_ns, SLOW_S)
        if not good or ekf is None:
            return good
        return bool(ekf.flags & EKF_PLACE) and not ekf.flags & (EKF_CONSTANT | EKF_UNINITIALISED)

    def message_rates(self, rate_hz: float) -> dict[str, float]:
        """Return every required message: by default, ArduCopter sends only a heartbeat every second."""
        return {
            "HEARTBEAT": 5.0,
            "ATTITUDE": rate_hz,
            "LOCAL_POSITION_NED": rate_hz,
            "EXTENDED_SYS_STATE": 5.0,
            "GLOBAL_POSITION_INT": 5.0,
            "SYS_STATUS": 2.0,
            "EKF_STATUS_REPORT": 2.0,
            "GPS_RAW_INT": 1.0,
            "RAW_IMU": rate_hz,
            "DISTANCE_SENSOR": 10.0,
        }

    def thrust_model(self, values: Values) -> ThrustModel:
        """Return the climb-rate model, or the thrust model if ``GUID_OPTIONS`` selects it."""
        if int(values.get("GUID_OPTIONS", 0)) & THRUST_AS_THRUST:
            return CollectiveThrust(hover=values.get("MOT_THST_HOVER", 0.35))
        return ClimbRateThrust(up_m_s=copter_speed(values, "UP", 2.5), down_m_s=copter_speed(values, "DN", 1.5))

    def safety_diagnostics(self, values: Values, own_system: int) -> list[Diagnostic]:
        """Return diagnostics for the safety nets, and for the system whose heartbeats the vehicle monitors."""
        diagnostics = super().safety_diagnostics(values, own_system)
        listens = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
        if listens is not None and listens != own_system:
            detail = f"it watches system {listens:g}, but this is system {own_system}: it won't notice our loss"
            diagnostics.append(Diagnostic("ground station", False, detail, f"give the address ?own_sysid={listens:g}"))
        return diagnostics


class Px4Profile(AutopilotProfile):
    """PX4."""

    NAME = "PX4"
    EARTH_RADIUS_M = 6_371_000.0  # lib/geo/geo.h: CONSTANTS_RADIUS_OF_EARTH
    GUIDED = "OFFBOARD"
    HOLD = "AUTO.LOITER"
    LAND = "AUTO.LAND"
    ARMING = "AUTO.LOITER"
    HOLDING = frozenset({"AUTO.LOITER"})
    LANDING = frozenset({"AUTO.LAND", "AUTO.PRECLAND"})
    TAKING_OFF = frozenset({"AUTO.TAKEOFF"})
    NEEDS_STICKS = frozenset({"MANUAL", "STABILIZED", "ACRO", "ALTCTL", "POSCTL"})
    LEAD_S = 1.0
    BYTEWISE = True
    SAFETY_NETS = (
        _SafetyNet("NAV_DLL_ACT", "loss of this computer", _on, "it only drops the last set-point", 1),
        _SafetyNet("COM_DL_LOSS_T", "time until its loss counts", lambda s: s <= 10, "it takes over 10 s", 5, "s"),
        _SafetyNet("COM_OF_LOSS_T", "set-point timeout", lambda s: s <= 1, "it takes over 1 s", 1, "s"),
        _SafetyNet(
            "COM_OBL_RC_ACT",
            "loss of set-points",
            lambda action: action in (3, 4, 5),  # return, land, hold
            "without a remote control it sinks to the ground",
            5,
        ),
        _SafetyNet("COM_LOW_BAT_ACT", "low battery", _on, "it only warns", 2),
        _SafetyNet("GF_MAX_VER_DIST", "ceiling", lambda height: height > 0, "it has none of its own", 30, "m"),
    )

    mode_of = staticmethod(px4_mode)

    def mode_command(self, mode: str) -> VehicleCommand:
        main, sub = PX4_NUMBERS[mode]
        return VehicleCommand(m.MAV_CMD_DO_SET_MODE, (CUSTOM, float(main), float(sub)))

    def takeoff_command(self, height_m: float, vehicle: VehicleState) -> VehicleCommand | None:
        """Return the take-off command, with an altitude above mean sea level."""
        if vehicle.amsl_m is None:
            return None
        nan = math.nan
        amsl_m = vehicle.amsl_m - (vehicle.altitude_m or 0.0) + height_m
        # The altitude is rounded to decimetres, so that noise on the ground does not turn a repeat into a new command.
        return VehicleCommand(m.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, nan, nan, nan, round(amsl_m, 1)))

    def has_taken_off(self, vehicle: VehicleState, height_m: float, rose: bool) -> bool:  # noqa: ARG002
        """Return whether the vehicle holds its position, as it does once its take-off mode has ended."""
        return rose and vehicle.mode == self.HOLD and vehicle.landed is not Landed.TAKING_OFF

    def ready(self, telemetry: MavlinkTelemetry, now_ns: int) -> bool | None:
        """Return whether the vehicle can be armed; None while it does not report that.

        PX4 never sets this check's *present* bit, and reports the outcome for the current mode. If that mode does not
        allow arming (it may be left over from a flight), the outcome does not apply to the mode in which a take-off
        begins. In that case only the position estimate is checked.
        """
        status = telemetry.newest("SYS_STATUS", now_ns, SLOW_S)
        custom_mode = telemetry.custom_mode()
        if status is None or custom_mode is None:
            return None
        if status.onboard_control_sensors_health & PREARM:
            return True
        if self.mode_of(custom_mode) == self.ARMING:
            return False
        estimator = telemetry.newest("ESTIMATOR_STATUS", now_ns, SLOW_S)
        return None if estimator is None else bool(estimator.flags & EKF_PLACE)

    def message_rates(self, rate_hz: float) -> dict[str, float]:
        """Return the required messages. The heartbeat stays at 1 Hz, so CURRENT_MODE is needed to see modes in time."""
        return {
            "ATTITUDE": rate_hz,
            "LOCAL_POSITION_NED": rate_hz,
            "CURRENT_MODE": 5.0,
            "EXTENDED_SYS_STATE": 5.0,
            "GLOBAL_POSITION_INT": 5.0,
            "SYS_STATUS": 2.0,
            "ESTIMATOR_STATUS": 2.0,
            "GPS_RAW_INT": 1.0,
            "HIGHRES_IMU": rate_hz,
            "DISTANCE_SENSOR": 10.0,
        }

    def thrust_model(self, values: Values) -> ThrustModel:
        """Return the collective-thrust model."""
        return CollectiveThrust(hover=values.get("MPC_THR_HOVER", 0.5))


def copter_speed(values: Values, which: str, usual_m_s: float) -> float:
    """Return one of ArduCopter's speeds [m/s].

    ``WPNAV_SPEED_UP`` and its siblings are in cm/s; newer firmware has ``WP_SPD_UP`` in m/s instead.
    """
    old, new = values.get(f"WPNAV_SPEED_{which}"), values.get(f"WP_SPD_{which}")
    speed = new if new is not None else old / 100.0 if old is not None else usual_m_s
    return speed if math.isfinite(speed) and speed > 0 else usual_m_s


def profile_of(autopilot: int) -> AutopilotProfile | None:
    """Return the profile for a heartbeat's ``MAV_AUTOPILOT``; None for an unknown one."""
    if autopilot == MavAutopilot.ARDUPILOT:
        return ArduCopterProfile()
    if autopilot == MavAutopilot.PX4:
        return Px4Profile()
    return None
