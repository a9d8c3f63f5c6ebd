"""Turn set-points into sticks: arming, holding a climb rate, touch-down and disarming. Pure.

The hover throttle is learnt: during take-off the throttle rises slowly until the vehicle lifts off, and from then on a
slow integral corrects the value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.vehicle_session import MotorStop, VehicleEvent, message
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, Attitude, EmergencyStop, FlightState, Idle, ResetEmergency, Severity
from skyloop.messages.geometry import clamped
from skyloop.vehicles.msp.firmware import MspSetup
from skyloop.vehicles.msp.telemetry import MspMotion
from skyloop.vehicles.msp.wire.firmwares import ARM_SWITCH, Curve, explained, stick_for

GRAVITY_M_S2: Final = 9.80665
LEVEL: Final = Attitude()
OFF_US: Final = 1000  #: pulse width of a throttle that is off
SPOOL_PER_S: Final = 0.15  #: rate at which the throttle rises during take-off, fraction of full throttle per second
SPOOL_FROM: Final = 0.6  #: fraction of the hover throttle, if known, at which the rise begins
IDLE: Final = 0.05  #: throttle at which the rise begins if the hover throttle is unknown
ARM_NS: Final = nanoseconds(6.0)  #: time allowed for arming to be confirmed; Betaflight's BOOTGRACE is 5 s
NAMED_NS: Final = nanoseconds(0.4)  #: how long a reported obstacle to arming must last to count as a refusal
REFUSED_NS: Final = nanoseconds(1.0)  #: how long the arm switch stays off after a refusal
ASKED_NS: Final = nanoseconds(1.0)  #: time after which a requested take-off that has not started expires
ABORT_NS: Final = nanoseconds(1.0)  #: longest interruption of a take-off before it is aborted
#: Temporary conditions after connecting or landing. Arming waits until they clear, with the arm switch off.
PASSING: Final = frozenset(
    (
        "RXLOSS",
        "FAILSAFE",
        "NOT_DISARMED",
        "CALIB",
        "BOOTGRACE",
        "THROTTLE",
        "RC_LINK",
        "SENSORS_CALIBRATING",
        ARM_SWITCH,
    )
)
SETTLING: Final = frozenset({"ANGLE", "LOAD"})  #: other temporary flags, reported until the attitude is known
LIFTED: Final = {True: (0.06, 0.15), False: (0.4, 0.4)}  #: lift-off height [m] or climb [m/s], by precision
LATE_S: Final = {True: 0.35, False: 0.15}  #: delay from sufficient throttle to a visible lift-off
OTHER: Final = 0.15  #: fraction by which the learnt throttle may differ from the throttle at lift-off
GROUND_NS: Final = {True: nanoseconds(0.6), False: nanoseconds(1.0)}  #: duration of a stall that counts as a touchdown
HEADWAY: Final = 0.4  #: fraction of the requested rate below which a descent counts as stalled
STILL: Final = {True: 0.1, False: 0.4}  #: vertical speed [m/s] above which the vehicle is airborne, by precision
#: Time constant [s] of the filter for the climb and height used to detect lift-off and touch-down. It reduces UWB noise
#: from 0.2 m/s (which never stayed below STILL for GROUND_NS) to 0.03 m/s, but a descent at 0.15 m/s still shows.
SMOOTH_S: Final = 0.4
SINK_PER_S: Final = 0.5  #: throttle reduction while the vehicle seems to be on the ground, fraction per second
#: Fraction of the hover throttle below which a vehicle that seems motionless counts as landed, keyed by whether it is
#: more than HIGH_M above the ground it left. A vehicle that is still airborne falls at the lower throttle, fast enough
#: to be noticed even if its motion is underestimated, as in a simulated world that lags behind the firmware's clock.
OFF_BELOW: Final = {False: 0.6, True: 0.15}
HIGH_M: Final = 0.5  #: see :data:`OFF_BELOW`
BLIND: Final = 0.93  #: fraction of the hover throttle used while the climb rate is unknown; the vehicle sinks
BLIND_NS: Final = nanoseconds(6.0)  #: time with an unknown climb rate after which the vehicle is disarmed
MOST_LEARNT: Final = 0.9  #: upper limit of the learnt hover throttle
LEAST_LEARNT: Final = 0.05  #: lower limit of the learnt hover throttle
LIFT_M_S2: Final = 4.0  #: limit of the climb loop's output
#: Reason given for not restarting a vehicle that did not confirm a stop.
UNSHOWN: Final = "the motors were stopped, and it is still armed: it can fly again once it reports that it is disarmed"


@dataclass(frozen=True, slots=True)
class Limits:
    tilt: float = 0.35  #: [rad]
    climb: float = 1.0  #: [m/s]
    yaw_rate: float = 1.75  #: [rad/s]
    throttle: float = 0.85  #: fraction of full throttle


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the climb loop."""

    climb_p: float = 2.5  #: acceleration per unit of climb error [1/s]
    climb_i: float = 1.2  #: learning rate of the hover throttle [1/s²]


class Phase(Enum):
    STANDING = auto()  #: on the ground, or being flown by a pilot
    ARMING = auto()
    SPOOLING = auto()  #: armed, with the throttle rising
    FLYING = auto()


@dataclass(slots=True)
class MspReport:
    """The flight controller's latest report."""

    armed: bool | None = None  #: None if unknown
    hindrances: list[str] = field(default_factory=list)
    overridden: bool = False  #: whether the pilot's switch is letting our sticks through


class MspSetpoints:
    """Stores the last set-point and turns it into receiver channels.

    With ``override``, a pilot keeps a real receiver, and nobody else can arm the vehicle.
    """

    def __init__(self, override: bool = False) -> None:
        self.limits = Limits()
        self.gains = Gains()
        self.given_aux: dict[int, int] = {}
        self.full_tilt_rad: float | None = None  #: tilt at full stick [rad], if set by the user
        self.hover: float | None = None  #: hover throttle, 0 to 1; None until it has been learnt
        self.report = MspReport()
        self.phase = Phase.STANDING
        self.stop = MotorStop(lambda event: self._events.append(event))
        self.throttle = 0.0
        self.receiving = False
        self._cut = False  # whether the motors were stopped without confirmation, so the vehicle may still be flying
        self._override = override
        self._setup = MspSetup()
        self._tilt: tuple[Curve, Curve] = self._setup.tilt_curves()
        self._turn: Curve = self._setup.yaw_curve()
        self._hindrance = "its settings have not been read"  # why the vehicle must not be armed
        self._wanted = LEVEL
        self._motion = MspMotion()
        self._since_ns = 0  # start of the phase
        self._stepped_ns: int | None = None  # when the channels were last computed
        self._switched = False  # whether the arm switch is on, while arming
        self._named: tuple[list[str], int] | None = None  # obstacles to arming, and since when they are reported
        self._refused: tuple[str, int] | None = None  # why the last take-off failed, and when
        self._abort_ns: int | None = None  # since when the climb of a take-off is interrupted
        self._still_ns: int | None = None  # since when a descent is stalled
        self._smooth_climb = self._smooth_wanted = 0.0  # measured and requested climb, filtered with the same delay
        self._smooth_height = 0.0
        self._blind_ns: int | None = None  # since when the climb rate is unknown
        self._sink = 1.0  # factor on the throttle, reduced while the vehicle seems to be on the ground
        self._asked_ns: int | None = None  # when the pending take-off was requested
        self._events: list[VehicleEvent] = []

    def set_up(self, setup: MspSetup, hindrance: str) -> None:
        """Store the flight controller's setup, and the reason why the vehicle must not be armed."""
        self._setup, self._hindrance = setup, hindrance
        self._tilt, self._turn = setup.tilt_curves(), setup.yaw_curve()

    def flight_state(self) -> FlightState:
        """Return the flight state to report in feedback."""
        if self.stop.shown:
            return FlightState.EMERGENCY
        if self.report.armed is None or (self._cut and self.report.armed):
            return FlightState.UNKNOWN
        return FlightState.FLYING if self.phase is Phase.FLYING and self.report.armed else FlightState.LANDED

    @property
    def full_tilt(self) -> float:
        """The tilt at full stick [rad]."""
        return self.full_tilt_rad or self._setup.full_tilt_rad or math.radians(45.0)

    @property
    def left_to(self) -> str:
        """``RECEIVER`` while the pilot is flying with a receiver, otherwise empty."""
        return "RECEIVER" if self._override and self.report.armed and not self.report.overridden else ""

    # Decisions -----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept one of the driver's ``ACTIONS``; return the action in force, within the limits.

        Raises :class:`DriverError` if the vehicle is on the ground and can't be armed for this climb, or if a reset was
        requested while the motors were still running.
        """
        if isinstance(action, EmergencyStop):
            self.stop.press(now_ns)
            self._wanted, self._cut = LEVEL, True
            self._enter(Phase.STANDING, now_ns)
        elif isinstance(action, ResetEmergency):
            if self._cut and not self.stop.active:
                raise DriverError(UNSHOWN)
            self.stop.reset()
            self._cut = False
        elif isinstance(action, Attitude):
            return self._follow(action, now_ns)
        else:
            assert isinstance(action, Idle)
        return action

    def _follow(self, action: Attitude, now_ns: int) -> Attitude:
        if self.stop.active:
            return LEVEL
        limits = self.limits
        tilt = min(limits.tilt, self.full_tilt)
        lean = math.hypot(action.roll, action.pitch)
        share = 1.0 if lean <= tilt else tilt / lean
        self._wanted = Attitude(
            roll=action.roll * share,
            pitch=action.pitch * share,
            climb=clamped(action.climb, limits.climb),
            yaw_rate=clamped(action.yaw_rate, min(limits.yaw_rate, self._turn(1.0))),
        )
        if self.phase is Phase.ARMING and self._wanted.climb <= 0:
            self._enter(Phase.STANDING, now_ns)  # the take-off is no longer requested, so it must not arm later
        if self.phase is Phase.STANDING and self._wanted.climb > 0:
            self._start(now_ns)  # this takes off only if a take-off was requested, not for other set-points
        return self._wanted

    def why_not(self, now_ns: int) -> str:
        """Return why the vehicle can't take off now; empty if no reason is known, or a take-off has already begun."""
        if self.phase is not Phase.STANDING:
            return ""
        if self.stop.active:
            return "the motors were stopped: reset the emergency first"
        if self._cut:
            return UNSHOWN
        if not self.receiving or self.report.armed is None:
            return "no data from the flight controller"
        if self._hindrance:
            return f"it must not be armed: {self._hindrance}"
        if self._motion.climb_m_s is None:
            return (
                "its climb is not measured, so its throttle can't be controlled: send it poses (motion capture) or "
                "fit a barometer"
            )
        if self._refused is not None and now_ns - self._refused[1] < REFUSED_NS:
            return self._refused[0]
        if self._override and not (self.report.armed and self.report.overridden):
            return "arm it and switch on MSP override at the pilot's receiver to let it take off"
        names = [name for name in self.report.hindrances if name not in PASSING]
        return "" if self.report.armed or not names else f"the flight controller refuses to arm: {explained(names)}"

    def ask_takeoff(self, now_ns: int) -> str:
        """Let the next climb start a take-off, unless the take-off is certain to fail; return why it would fail."""
        why = self.why_not(now_ns)
        self._asked_ns = None if why or self.phase is not Phase.STANDING else now_ns
        return why

    def _start(self, now_ns: int) -> None:
        why = self.why_not(now_ns)
        if not why and (self._asked_ns is None or now_ns - self._asked_ns > ASKED_NS):
            why = "it is on the ground: take off first"
        if why:
            self._wanted = LEVEL
            raise DriverError(why)
        self._named, self._switched = None, False
        self._enter(Phase.SPOOLING if self.report.armed else Phase.ARMING, now_ns)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase, self._since_ns = phase, now_ns
        self._abort_ns = self._still_ns = self._blind_ns = None
        self._sink, self._asked_ns = 1.0, None
        self._smooth_climb = self._smooth_wanted = self._smooth_height = 0.0
        self._cut = self._cut and phase is Phase.STANDING
        if phase is Phase.SPOOLING:
            self.throttle = IDLE if self.hover is None else SPOOL_FROM * self.hover
        elif phase is not Phase.FLYING:
            self.throttle = 0.0

    # Reports -------------------------------------------------------------------------------------------------------

    def on_report(self, report: MspReport, now_ns: int) -> None:
        before, self.report, heard = self.report, report, self.receiving
        self.receiving = True
        self._cut = self._cut and report.armed is not False
        if self.phase is Phase.ARMING:
            self._check_arming(now_ns)
        elif self.phase in (Phase.SPOOLING, Phase.FLYING) and report.armed is False:
            flew = self.phase is Phase.FLYING
            self._enter(Phase.STANDING, now_ns)
            self._wanted = LEVEL
            if before.armed:
                where = "in flight" if flew else "before it had taken off"
                why = f": {explained(report.hindrances)}" if report.hindrances else ""
                text = f"the flight controller disarmed {where}{why}"
                if heard:  # a take-off in progress must not arm the vehicle again; after a link loss, there is none
                    self._refused = text, now_ns
                self._events.append(message(text, "disarmed", Severity.WARNING, flags=", ".join(report.hindrances)))
        elif self._override and before.overridden and not report.overridden:
            self._enter(Phase.STANDING, now_ns)
            self._events.append(message("the pilot took over the sticks", "override", Severity.WARNING, active=False))
        elif self._override and report.overridden and not before.overridden:
            self._events.append(message("the pilot handed over the sticks", "override", active=True))
            if report.armed and self.throttle > IDLE and not self.stop.active:
                self._wanted = LEVEL
                self._enter(Phase.FLYING, now_ns)

    def adopt(self, throttle: float, now_ns: int) -> None:
        """Continue the flight of a vehicle found armed, starting with the last throttle sent, 0 to 1."""
        if throttle > IDLE and not self.stop.active:
            self.hover = self.throttle = max(LEAST_LEARNT, min(MOST_LEARNT, throttle))
            self._enter(Phase.FLYING, now_ns)

    def on_pilot_throttle(self, throttle: float) -> None:
        """Learn the hover throttle from the pilot, so that the throttle does not jump when the pilot hands over."""
        self.throttle = throttle
        climb = self._motion.climb_m_s
        if throttle > IDLE and climb is not None and abs(climb) < 0.3:
            self.hover = max(LEAST_LEARNT, min(MOST_LEARNT, throttle))

    def on_motion(self, motion: MspMotion) -> None:
        self._motion = motion

    def lost(self) -> None:
        """Level the sticks, because nothing is being received any more."""
        self.receiving = False
        self._motion = MspMotion()
        self._wanted = LEVEL
        if self.phase is Phase.ARMING:
            self.phase = Phase.STANDING

    def _check_arming(self, now_ns: int) -> None:
        report = self.report
        if report.armed:
            self._enter(Phase.SPOOLING, now_ns)
            return
        names = [name for name in report.hindrances if name not in PASSING]
        if not report.hindrances:
            self._switched = True
        if not names:
            self._named = None
        elif self._named is None:
            self._named = names, now_ns
        elif now_ns - self._named[1] >= NAMED_NS:
            self._refuse(names, now_ns)
            return
        if now_ns - self._since_ns >= ARM_NS:
            self._refuse(report.hindrances, now_ns)

    def _refuse(self, names: list[str], now_ns: int) -> None:
        why = explained(names) if names else "it gives no reason"
        text = f"the flight controller refuses to arm: {why}"
        self._refused = text, now_ns
        self._wanted = LEVEL
        self._enter(Phase.STANDING, now_ns)
        self._events.append(message(text, "arming_refused", Severity.WARNING, flags=", ".join(names)))

    # Sticks --------------------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        events, self._events = self._events, []
        return events

    def step_stop(self, now_ns: int) -> bool:
        """Continue an emergency stop; return whether its sticks are due, regardless of the rate of other sticks."""
        return self.stop.step(self._motors_are_off(), now_ns)

    def _motors_are_off(self) -> bool | None:
        report = self.report
        if not self.receiving or report.armed is None:
            return None
        if not (self._override and report.armed):
            return not report.armed
        return True if report.overridden else None  # only the pilot can disarm: our sticks just cut the throttle

    def channels(self, now_ns: int) -> list[int]:
        """Return the receiver channels [µs] in the flight controller's order. Call this at a steady rate."""
        step_s = 0.0 if self._stepped_ns is None else min(0.1, seconds(now_ns - self._stepped_ns))
        self._stepped_ns = now_ns
        if self.phase is Phase.SPOOLING:
            self._spool(step_s, now_ns)
        elif self.phase is Phase.FLYING:
            self._hold_climb(step_s, now_ns)
        steers = self.phase is Phase.FLYING and self.receiving
        wanted = self._wanted if steers else LEVEL
        on = self.phase in (Phase.SPOOLING, Phase.FLYING) or (self.phase is Phase.ARMING and self._switched)
        roll, pitch = self._lean(wanted.roll, self._tilt[0]), self._lean(wanted.pitch, self._tilt[1])
        yaw = -stick_for(self._turn, wanted.yaw_rate)
        throttle = round(OFF_US + 1000 * (self.throttle if on else 0.0))
        sticks = [0, 0, 0, 0]
        centred = (round(1500 + 500 * stick) for stick in (roll, pitch, yaw))
        for place, width in zip(self._setup.sticks, (*centred, throttle), strict=True):
            sticks[place] = width
        if self.stop.active and not self._setup.sticks_known:
            sticks = [OFF_US] * len(sticks)  # turns off the throttle, whichever channel it is on
        given: Mapping[int, int] = self.given_aux
        return [*sticks, *self._setup.aux_us(arm=on, given=given)]

    def _lean(self, angle: float, curve: Curve) -> float:
        return stick_for(curve, angle / self.full_tilt)

    def _spool(self, step_s: float, now_ns: int) -> None:
        if self._wanted.climb > 0:
            self._abort_ns = None
        elif self._abort_ns is None:
            self._abort_ns = now_ns
        elif now_ns - self._abort_ns >= ABORT_NS:
            self._enter(Phase.STANDING, now_ns)
            return
        motion = self._motion
        if motion.climb_m_s is None or not self.receiving:
            lacking = "it sends no data" if motion.precise else "its climb is no longer measured"
            self._give_up(lacking, now_ns)
            return
        if self._lifted(motion.climb_m_s, motion.height_m or 0.0, step_s):
            carried = max(SPOOL_FROM * self.throttle, self.throttle - SPOOL_PER_S * LATE_S[motion.precise])
            if self.hover is not None:  # learnt in an earlier flight
                carried = max((1 - OTHER) * carried, min((1 + OTHER) * carried, self.hover))
            self.hover = max(LEAST_LEARNT, min(MOST_LEARNT, carried))
            self._enter(Phase.FLYING, now_ns)
        elif self.throttle >= self.limits.throttle:
            self._give_up(f"it did not leave the ground at {self.limits.throttle:.0%} throttle", now_ns)
        elif self._abort_ns is None:
            self.throttle = min(self.limits.throttle, self.throttle + SPOOL_PER_S * step_s)

    def _lifted(self, climb: float, height: float, step_s: float) -> bool:
        """Return whether it has lifted off. Precise motion is smoothed so that noise is not mistaken for a lift-off."""
        if self._motion.precise:
            self._smooth_climb = climb = _smoothed(self._smooth_climb, climb, step_s)
            self._smooth_height = height = _smoothed(self._smooth_height, height, step_s)
        high, fast = LIFTED[self._motion.precise]
        return climb > fast or height > high

    def _give_up(self, why: str, now_ns: int) -> None:
        self._refused = why, now_ns
        self._wanted = LEVEL
        self._enter(Phase.STANDING, now_ns)
        self._events.append(message(f"take-off given up: {why}", "no_takeoff", Severity.WARNING))

    def _hold_climb(self, step_s: float, now_ns: int) -> None:
        hover = self.hover or self.throttle
        climb = self._motion.climb_m_s
        if climb is None or not self.receiving:
            self._sink_blindly(hover, now_ns)
            return
        if self._blind_ns is not None:
            self._blind_ns = None
            self._events.append(message("its climb is measured again", "blind", active=False))
        error = self._wanted.climb - climb
        lift = clamped(self.gains.climb_p * error, LIFT_M_S2)
        stands = self._stands(climb, step_s, now_ns)
        if not stands:
            hover *= 1 + self.gains.climb_i * clamped(error, 1.0) * step_s / GRAVITY_M_S2
            self.hover = hover = max(LEAST_LEARNT, min(MOST_LEARNT, hover))
        upright = max(0.5, math.cos(self._wanted.roll) * math.cos(self._wanted.pitch))
        wanted = hover * (1 + lift / GRAVITY_M_S2) / upright * self._sink
        self.throttle = max(0.0, min(self.limits.throttle, wanted))
        high = (self._motion.height_m or 0.0) > HIGH_M
        if stands and self.throttle < OFF_BELOW[high] * hover:
            self._wanted = LEVEL
            self._enter(Phase.STANDING, now_ns)

    def _stands(self, climb: float, step_s: float, now_ns: int) -> bool:
        """Return whether a descent has reached the ground; reduce the throttle while this seems to be the case."""
        still = STILL[self._motion.precise]
        self._smooth_climb = climb = _smoothed(self._smooth_climb, climb, step_s)
        self._smooth_wanted = _smoothed(self._smooth_wanted, self._wanted.climb, step_s)
        wanted = max(self._wanted.climb, self._smooth_wanted)
        if wanted >= -0.05 or climb > still or climb < max(HEADWAY * wanted, -still):
            self._still_ns = None
            self._sink = min(1.0, self._sink + 2 * SINK_PER_S * step_s)
            return False
        if self._still_ns is None:
            self._still_ns = now_ns
        if now_ns - self._still_ns < GROUND_NS[self._motion.precise]:
            return False
        self._sink = max(0.0, self._sink - SINK_PER_S * step_s)
        return True

    def _sink_blindly(self, hover: float, now_ns: int) -> None:
        if self._blind_ns is None:
            self._blind_ns = now_ns
            text = f"its climb is not measured: it sinks, level, and is disarmed after {seconds(BLIND_NS):g} s"
            self._events.append(message(text, "blind", Severity.ERROR, active=True))
        elif now_ns - self._blind_ns >= BLIND_NS:
            self._enter(Phase.STANDING, now_ns)
            return
        self.throttle = min(self.limits.throttle, BLIND * hover)


def _smoothed(before: float, measured: float, step_s: float) -> float:
    return before + (1 - math.exp(-step_s / SMOOTH_S)) * (measured - before)
