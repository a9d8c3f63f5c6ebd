"""From log variables to feedback: units, axes and signs, whether the vehicle flies, and whether it knows its position.

Pure. Which variables exist depends on the firmware. :data:`MAIN` names alternatives, of which the first that the
vehicle has all variables of is logged; of :data:`SLOW`, each that it has. Nothing is made up for what it lacks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import VehicleEvent, message
from skyloop.messages import Feedback, FlightState, Severity, Value, Vector
from skyloop.messages.geometry import turned, wrap_angle
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.crazyflie.wire.commander import Supervisor, decompressed
from skyloop.vehicles.crazyflie.wire.contents import Entry

_COMPRESSED: Final = tuple(
    f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "quat", "rateRoll", "ratePitch", "rateYaw")
)
_PLAIN: Final = tuple(f"stateEstimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz"))
_INFO: Final = "supervisor.info"
#: Alternatives, best first: the state in one packet, or in several.
MAIN: Final = ((*_COMPRESSED, _INFO), _COMPRESSED, (*_PLAIN, _INFO), _PLAIN)
_MOTORS: Final = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_MOTOR_OFF: Final = 1000  # power up to which a motor counts as off, of 65535
_VARIANCES: Final = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
SLOW: Final = (
    *("sys.isFlying", "sys.isTumbled", "sys.canfly", "sys.armed", "stabilizer.thrust"),
    *_MOTORS,
    *("pm.vbat", "pm.batteryLevel", "pm.state", "range.zrange", "radio.rssi"),
    *_VARIANCES,
)
SLOW_PERIOD_MS: Final = 100
#: Parameters that tell of a position: decks for it, and the estimator (1: complementary, without a position).
DECKS: Final = ("deck.bcFlow", "deck.bcFlow2", "deck.bcLighthouse4", "deck.bcLoco", "deck.bcDWM1000")
RANGE_FINDERS: Final = ("deck.bcFlow2", "deck.bcZRanger2", "deck.bcZRanger")
ESTIMATOR: Final = "stabilizer.estimator"
_COMPLEMENTARY: Final = 1

KNOWN_VARIANCE_M2: Final = 1.0  #: greatest variance of a position that counts as known without a deck
FLYING_NS: Final = nanoseconds(1.0)  #: how long a vehicle that reports only its thrust counts as flying without any
_NO_RANGE_MM: Final = 8000  # the range finder reports at least this where it sees nothing


def choose_variables(entries: Sequence[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Return the variables to log often and seldom. The first is empty if the vehicle reports no state."""
    known = {entry.full_name: entry for entry in entries}
    main = next((names for names in MAIN if all(name in known for name in names)), ())
    return [known[name] for name in main], [known[name] for name in SLOW if name in known]


@dataclass(frozen=True, slots=True)
class Estimate:
    """The vehicle's state in Skyloop's units and axes; None: not reported."""

    position_m: Vector | None = None  #: as estimated, whether it is known or not
    velocity_m_s: Vector | None = None  #: in world axes
    roll_rad: float | None = None
    pitch_rad: float | None = None
    yaw_rad: float | None = None
    rates_rad_s: Vector | None = None

    @property
    def speed_m_s(self) -> float:
        """Speed in any direction; infinite if unknown."""
        return math.inf if self.velocity_m_s is None else math.hypot(*self.velocity_m_s)


def estimate_of(values: Mapping[str, float]) -> Estimate:
    packed = values.get("stateEstimateZ.quat")
    if packed is not None:
        x, y, z, w = decompressed(int(packed))
        rates = _vector(values, "stateEstimateZ.rate", ("Roll", "Pitch", "Yaw"), 1000)
        return Estimate(
            position_m=_vector(values, "stateEstimateZ.", "xyz", 1000),
            velocity_m_s=_vector(values, "stateEstimateZ.v", "xyz", 1000),
            roll_rad=math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            pitch_rad=math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
            yaw_rad=math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
            # The pitch rate is positive with the nose rising, like the pitch of the other form.
            rates_rad_s=None if rates is None else (rates[0], -rates[1], rates[2]),
        )
    angles = _vector(values, "stateEstimate.", ("roll", "pitch", "yaw"))
    roll, pitch, yaw = (None, None, None) if angles is None else map(math.radians, angles)
    return Estimate(
        position_m=_vector(values, "stateEstimate.", "xyz"),
        velocity_m_s=_vector(values, "stateEstimate.v", "xyz"),
        roll_rad=None if roll is None else wrap_angle(roll),
        pitch_rad=None if pitch is None else wrap_angle(-pitch),
        yaw_rad=None if yaw is None else wrap_angle(yaw),
    )


def _vector(values: Mapping[str, float], prefix: str, names: Sequence[str], scale: float = 1.0) -> Vector | None:
    found = tuple(values.get(f"{prefix}{name}", math.nan) / scale for name in names)
    return (found[0], found[1], found[2]) if all(map(math.isfinite, found)) else None


class CrazyflieTelemetry:
    """The newest values of all logged variables, and the conclusions from them."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.parameters: dict[str, float] = {}  #: those of :data:`DECKS` and :data:`ESTIMATOR` that the vehicle has
        self.estimate = Estimate()
        self.motors_ns: int | None = None  #: when the motors' power last arrived
        self._motors_ran = False  # whether a motor was ever seen to have power
        self._powered_ns: int | None = None  # when thrust or a motor was last above zero
        self._health = 0  # the supervisor's bits at the last look

    def forget(self) -> None:
        """Forget everything: the vehicle was lost."""
        self.__init__()  # type: ignore[misc]

    def update(self, values: Mapping[str, float], now_ns: int) -> None:
        self.values.update({name: value for name, value in values.items() if math.isfinite(value)})
        self.estimate = estimate_of(self.values)
        if _MOTORS[0] in values:
            self.motors_ns = now_ns
            self._motors_ran |= self._motors_run()
        if self.motors_run or self.values.get("stabilizer.thrust", 0.0) > 0:
            self._powered_ns = now_ns

    # The supervisor -------------------------------------------------------------------------------------------------

    def is_set(self, bit: Supervisor, older: str = "") -> bool | None:
        """Return one of the supervisor's bits, or the older variable for the same; None if neither is reported."""
        if _INFO in self.values:
            return bool(int(self.values[_INFO]) & bit)
        return bool(self.values[older]) if older in self.values else None

    @property
    def motors_run(self) -> bool | None:
        """Whether a motor has power; None if not reported, or if none ever had: these numbers may not show it."""
        return self._motors_run() if self._motors_ran else None

    def _motors_run(self) -> bool:
        return any(self.values.get(name, 0.0) > _MOTOR_OFF for name in _MOTORS)

    @property
    def is_locked(self) -> bool | None:
        return self.is_set(Supervisor.IS_LOCKED)

    @property
    def is_armed(self) -> bool | None:
        return self.is_set(Supervisor.IS_ARMED, "sys.armed")

    def is_flying(self, now_ns: int) -> bool | None:
        """Whether the vehicle flies; None if unknown."""
        reported = self.is_set(Supervisor.IS_FLYING, "sys.isFlying")
        if reported is not None:
            return reported
        if "stabilizer.thrust" not in self.values and _MOTORS[0] not in self.values:
            return None
        return self._powered_ns is not None and now_ns - self._powered_ns < FLYING_NS

    def refusal(self) -> str:
        """Return why the vehicle can't take off; empty if nothing speaks against it."""
        if self.is_locked:
            return "it is locked, after an emergency stop or a fault: switch it off and on again"
        if self.is_set(Supervisor.IS_CRASHED):
            return "it has crashed: put it upright, then reset the emergency"
        if self.is_set(Supervisor.IS_TUMBLED, "sys.isTumbled"):
            return "it is not upright"
        return "" if self.knows_position else NO_POSITION

    # The position ---------------------------------------------------------------------------------------------------

    @property
    def knows_position(self) -> bool:
        """Whether the estimated position means anything: a deck or motion capture supports it."""
        if self.estimate.position_m is None or self.parameters.get(ESTIMATOR) == _COMPLEMENTARY:
            return False
        if any(self.parameters.get(name) for name in DECKS):
            return True
        variances = [self.values[name] for name in _VARIANCES if name in self.values]
        return all(variance < KNOWN_VARIANCE_M2 for variance in variances)

    # Reports --------------------------------------------------------------------------------------------------------

    def feedback(self, state: FlightState, captured_ns: int, further: Mapping[str, Value]) -> Feedback:
        """Return the newest state as feedback."""
        estimate, values = self.estimate, self.values
        known = self.knows_position
        velocity, volts = estimate.velocity_m_s, values.get("pm.vbat", 0.0)
        if velocity is not None and estimate.yaw_rad is not None:
            velocity = (*turned(velocity[0], velocity[1], -estimate.yaw_rad), velocity[2])
        level = values.get("pm.batteryLevel")
        native: dict[str, Value] = {**values, **further}
        return Feedback(
            captured_ns=captured_ns,
            state=state,
            battery=None if level is None or volts <= 0 else min(1.0, level / 100),
            battery_v=volts if volts > 0 else None,
            roll_rad=estimate.roll_rad,
            pitch_rad=estimate.pitch_rad,
            yaw_rad=None if estimate.yaw_rad is None else wrap_angle(estimate.yaw_rad),
            altitude_m=self.altitude_m,
            velocity_m_s=velocity if known else None,
            angular_velocity_rad_s=estimate.rates_rad_s,
            position_m=estimate.position_m if known else None,
            native=native,
        )

    @property
    def range_m(self) -> float | None:
        """Distance to the surface below, measured by the range finder; None without a measurement."""
        if not any(self.parameters.get(name) for name in RANGE_FINDERS):
            return None
        range_mm = self.values.get("range.zrange", math.inf)
        return range_mm / 1000 if 0 < range_mm < _NO_RANGE_MM else None

    @property
    def altitude_m(self) -> float | None:
        """Height above the surface below, if a range finder measures it; otherwise above the origin."""
        if self.range_m is not None or self.estimate.position_m is None:
            return self.range_m
        return self.estimate.position_m[2]

    def changes(self) -> list[VehicleEvent]:
        """Return events for faults that the supervisor has reported since the last call."""
        bits = int(self.values.get(_INFO, 0))
        new, self._health = bits & ~self._health, bits
        return [message(text, reason, Severity.ERROR) for bit, reason, text in _ALARMS if new & bit]

    def diagnose(self) -> list[Diagnostic]:
        """Return findings for a preflight check."""
        found = []
        for bit, _, text in _ALARMS:
            if self.is_set(bit):
                found.append(Diagnostic("supervisor", False, text, "switch it off and on again", severe=True))
        position = Diagnostic("position", True, "it knows its position")
        if not self.knows_position:
            position = Diagnostic(
                "position", False, NO_POSITION, "attach a Flow deck, or use motion capture", severe=True
            )
        return [*found, position]


NO_POSITION: Final = (
    "it does not know its position: it needs a deck for positions, or motion capture (docs/motion-capture.md)"
)
_ALARMS: Final = (
    (Supervisor.IS_TUMBLED, "tumbled", "the vehicle is not upright: it stops its motors"),
    (Supervisor.IS_CRASHED, "crashed", "the vehicle reports a crash and has stopped its motors"),
    (Supervisor.IS_LOCKED, "locked", "the vehicle is locked: its motors stay off until it is switched off and on"),
)
