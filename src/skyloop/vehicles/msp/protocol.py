"""The protocol with one flight controller: replies in, requests and sticks out. No sockets, no clock."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.vehicle_session import (
    LinkTimeouts,
    LinkTrouble,
    VehicleEvent,
    VehicleSession,
    message,
    serial_trouble,
)
from skyloop.errors import DecodeError
from skyloop.messages import AnyAction, EmergencyStop, LinkState, Severity, Value
from skyloop.messages.feedback import WAKING_UP
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.msp.firmware import SUPPORTED, Identification, MspSetup, hindrances
from skyloop.vehicles.msp.parameters import MspOptions
from skyloop.vehicles.msp.setpoints import PASSING, SETTLING, MspReport, MspSetpoints, Phase
from skyloop.vehicles.msp.telemetry import MotionEstimate, MspTelemetry, Questions, Reported, feedback_of
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.firmwares import ARM, ARMED_OF_INAV, MSP_OVERRIDE, explained, flag_names
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, Parser, encode
from skyloop.vehicles.msp.wire.messages import BETAFLIGHT, INAV, Function, Sensor

DEGRADED_NS: Final = nanoseconds(0.4)  #: time without data after which the link counts as degraded
LOST_NS: Final = nanoseconds(1.0)  #: time without data after which the link counts as lost
FIRST_WORD_NS: Final = nanoseconds(2.0)  #: time without a reply after which a flight controller is reported as lost
IDLE_NS: Final = nanoseconds(0.05)  #: longest time between polls
MOST_STICKS: Final = 4  #: maximum number of unacknowledged stick frames
STICKS_LOST_NS: Final = nanoseconds(0.1)  #: an older unacknowledged frame is lost if a newer reply has arrived
LAST_STICKS: Final = 3  #: number of final stick frames, level or disarming, sent to a silent flight controller
COUNT_NS: Final = nanoseconds(1.0)  #: period over which acknowledged sticks are counted
#: Time without sticks after which a flight controller arms only once its arm switch has been off.
UNTOLD_NS: Final = nanoseconds(0.5)
LEAST_STICKS_HZ: Final = 25.0  #: rate below which a warning is given
BUNDLING_API: Final = (1, 42)  #: Betaflight's API version that introduced MULTIPLE
_MODES_AT: Final = 6  # offset of the modes in STATUS
WAKING_NS: Final = nanoseconds(8.0)  #: longest time after being found for which a flight controller is starting up
AGAIN_NS: Final = nanoseconds(1.0)  #: time between attempts to identify the flight controller

# Rates at which states are requested. Replies limit them: see :class:`MspTelemetry`.
ATTITUDE_HZ: Final = 50.0
ALTITUDE_HZ: Final = 25.0
STATUS_HZ: Final = 20.0
GPS_HZ: Final = 10.0
BATTERY_HZ: Final = 2.0
PILOT_HZ: Final = 10.0  #: rate at which the pilot's sticks are read with ``override``


class MspSession(VehicleSession):
    """The protocol between an open driver and its flight controller. Not thread-safe."""

    TIMEOUTS = LinkTimeouts(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)

    def __init__(self, options: MspOptions, now_ns: int, setpoints: MspSetpoints | None = None) -> None:
        super().__init__(now_ns)
        self.options = options
        self.setpoints = setpoints or MspSetpoints(options.override)
        self.motion = MotionEstimate()
        self.setup: MspSetup | None = None  #: None until the setup has been read
        self.reported = Reported()
        self.sticks_hz: float | None = None  #: rate of acknowledged stick frames
        self.unknown = 0  #: number of frames that do not answer any request
        self.urgent = False  #: whether the latest command is an emergency stop
        self._parser = Parser()
        self._questions = Questions()
        self._identification: Identification | None = None
        self._telemetry: MspTelemetry | None = None
        self._known = False  # whether identification has been completed since the flight controller was found
        self._refused_variant = ""
        self._unread = ""  # settings that were not reported
        self._part = MspSetup()  # the settings read so far, which suffice for a stop
        self._armed: bool | None = None  # the state reported before the settings were read; None if not reported
        self._stop_waits = False  # whether a stop is waiting for the armed state to be known
        self._asked_ns: int | None = None
        self._sticks_due_ns = now_ns
        self._sticks: deque[int] = deque()  # when each unacknowledged frame was sent
        self._last_sticks = 0  # number of final frames still to be sent to a silent flight controller
        self._acknowledged = 0
        self._counted_ns = now_ns
        self._slow = False
        self._wakes_until_ns: int | None = None  # None if the vehicle's state is unknown; 0 once it has been ready
        self._woke = False  # whether the flight controller was still starting up at the last check
        self._may_steer = False  # whether the vehicle's state is known, so that our sticks won't disarm it in flight
        self._armed_throttle: float | None = None
        self._set_link_state(LinkState.CONNECTING, f"waiting for the flight controller on {options}")

    # From the driver -----------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept an action; see :meth:`MspSetpoints.apply`."""
        self.setpoints.on_motion(self.motion.at(now_ns))
        applied = self.setpoints.apply(action, now_ns)
        self.due_ns = min(self.due_ns, now_ns if isinstance(action, EmergencyStop) else self._sticks_due_ns)
        return applied

    def ask_takeoff(self, now_ns: int) -> str:
        """Let the next climb start a take-off; return why that would fail, or an empty text if it may succeed."""
        self.setpoints.on_motion(self.motion.at(now_ns))
        return self.setpoints.ask_takeoff(now_ns)

    def on_pose(self, pose: ExternalPose, now_ns: int) -> None:
        """Handle an external pose; see :meth:`ExternalPose.bounded`."""
        self.motion.on_pose(pose.bounded(now_ns))

    def close(self) -> None:
        self._questions.clear()

    def final_bytes(self, now_ns: int) -> bytes:
        """Return the final bytes to send before the connection closes, which disarm a vehicle on the ground.

        Nothing is sent to a flying vehicle: its failsafe is configured to handle the loss of the receiver.
        """
        if not self._may_steer or self.options.override or self.setpoints.phase is Phase.FLYING:
            return b""
        self.setpoints.phase = Phase.STANDING
        return self._stick_frame(now_ns)

    def diagnose(self) -> list[Diagnostic]:
        if self.setup is None:
            unread = "the flight controller's settings have not been read"
            return [Diagnostic("settings", False, unread, "wait until its link is up, then check again", severe=True)]
        found = self.setup.diagnose(override=self.options.override)
        names = self.setpoints.report.hindrances
        if names:
            found.append(Diagnostic("arming", False, f"it can't be armed: {explained(names)}", severe=True))
        elif self.setpoints.report.armed is False:
            found.append(Diagnostic("arming", True, "it reports nothing that prevents arming"))
        if self.sticks_hz is not None:
            found.append(_pace(self.sticks_hz, self.setup.identity.variant))
        return found

    # From the connection -------------------------------------------------------------------------------------------

    def connected(self) -> None:
        """Handle a new connection, on which no replies to older requests can arrive."""
        self._parser.reset()
        self._sticks.clear()
        self.due_ns = 0

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle received bytes. Never raises, whatever the content."""
        for frame in self._parser.feed(data):
            if frame.direction is not Direction.REQUEST:
                self._on_frame(frame, now_ns)

    def _on_frame(self, frame: MspFrame, now_ns: int) -> None:
        begins, self._received_ns = self._received_ns is None, now_ns
        self._unreachable = ""
        if begins:
            self.due_ns = 0
        if frame.function == Function.SET_RAW_RC:
            if self._sticks:
                self._sticks.popleft()
                self._acknowledged += 1
            return
        if self._questions.on_frame(frame):
            self.due_ns = 0
            return
        answers = [] if self._telemetry is None else self._telemetry.on_frame(frame)
        if not answers:
            self.unknown += 1
        for function, payload in answers:
            if payload is None:
                assert self._telemetry is not None
                self._telemetry.drop(function)
                continue
            with suppress(DecodeError):  # damaged in spite of a matching checksum
                self._on_state(function, payload, now_ns)

    def _on_state(self, function: int, payload: bytes, now_ns: int) -> None:
        reported = self.reported
        if function == Function.ATTITUDE:
            reported.attitude = msp.MspAttitude.decode(payload)
            self.motion.on_attitude(reported.attitude)
            self._publish(now_ns)
        elif function == Function.ALTITUDE:
            reported.altitude = msp.Altitude.decode(payload)
            if reported.status is None or _has_height(reported.status):
                self.motion.on_altitude(reported.altitude, now_ns)
        elif function in (Function.STATUS_EX, Function.STATUS):
            self._on_status(msp.MspStatus.of_betaflight(payload), now_ns)
        elif function == Function.INAV_STATUS:
            self._on_status(msp.MspStatus.of_inav(payload), now_ns)
        elif function == Function.RAW_GPS:
            self.motion.on_gps(msp.Gps.decode(payload), now_ns)
        elif function == Function.BATTERY_STATE:
            reported.battery = msp.Battery.of_state(payload)
        elif function == Function.INAV_ANALOG:
            reported.battery = msp.Battery.of_inav(payload)
        elif function == Function.RC:
            self._on_pilot(msp.channels(payload), now_ns)

    def _on_status(self, status: msp.MspStatus, now_ns: int) -> None:
        assert self.setup is not None
        self.reported.status = status
        variant = self.setup.identity.variant
        flags = status.flags or 0
        names = flag_names(variant, flags, status.count)
        armed = bool(flags & ARMED_OF_INAV) if variant == INAV else self.setup.is_active(status.modes, ARM)
        overridden = self.setup.is_active(status.modes, *MSP_OVERRIDE)
        if not self._may_steer:
            if armed and not self.options.override and self._armed_throttle is None:
                return  # nothing may be sent to a flying vehicle until its throttle is known
            self._may_steer = True
            if armed and self._armed_throttle is not None and not self.options.override:
                self.setpoints.report = MspReport(armed, names, overridden)
                self.setpoints.adopt(self._armed_throttle, now_ns)
        self.setpoints.on_report(MspReport(armed, names, overridden), now_ns)
        self.motion.stands(does=not armed)

    def _on_pilot(self, widths: list[int], now_ns: int) -> None:
        if len(widths) < 4:
            return
        throttle = max(0.0, min(1.0, (widths[3] - 1000) / 1000))
        self._armed_throttle = throttle
        if self.options.override and not self.setpoints.report.overridden:
            self.setpoints.on_motion(self.motion.at(now_ns))
            self.setpoints.on_pilot_throttle(throttle)

    def _publish(self, now_ns: int) -> None:
        if self.setpoints.report.armed is None or self.reported.altitude is None:
            return  # the vehicle's state is not known yet
        wakes = self._wakes_up(now_ns)
        if self.link_state is not LinkState.UP or wakes is not self._woke:
            names = ", ".join(self.setpoints.report.hindrances)
            why = f"{WAKING_UP}: the flight controller can't be armed yet ({names})" if wakes else ""
            self._woke = wakes
            self._report_link(LinkState.UP, why)
        motion = self.motion.at(now_ns)
        self.setpoints.on_motion(motion)
        flight = self.setpoints.flight_state()
        feedback = feedback_of(self.reported, motion, flight, now_ns, self._native())
        self._pending.append(lambda sink: sink.feedback(feedback))

    def _wakes_up(self, now_ns: int) -> bool:
        """Return whether the flight controller was found recently and only temporary conditions prevent arming."""
        report = self.setpoints.report
        if self._wakes_until_ns is None:
            self._wakes_until_ns = now_ns + WAKING_NS
        found = PASSING.intersection(report.hindrances)
        passes = bool(found) and SETTLING.issuperset(found.symmetric_difference(report.hindrances))
        if report.armed or not passes or self.options.override or now_ns >= self._wakes_until_ns:
            self._wakes_until_ns = 0
        return bool(self._wakes_until_ns)

    def _native(self) -> dict[str, Value]:
        setpoints, reported, setup = self.setpoints, self.reported, self.setup
        native: dict[str, Value] = {
            "armed": bool(setpoints.report.armed),
            "arming.flags": ", ".join(setpoints.report.hindrances),
            "phase": setpoints.phase.name.lower(),
            "throttle": setpoints.throttle,
            "frames.damaged": self._parser.damaged,
            "frames.unknown": self.unknown,
        }
        if self._telemetry is not None:
            native["requests.unanswered"] = self._telemetry.unanswered
        if self.sticks_hz is not None:
            native["sticks.rate_hz"] = self.sticks_hz
        if setpoints.hover is not None:
            native["throttle.hover"] = setpoints.hover
        if reported.status is not None and setup is not None:
            native["modes"] = ", ".join(setup.mode_names(reported.status.modes))
            native["load_percent"] = reported.status.load
        if reported.altitude is not None:
            native["altitude_m"], native["climb_m_s"] = reported.altitude.height_m, reported.altitude.climb_m_s
        if reported.attitude is not None:
            native["heading_deg"] = reported.attitude.heading_deg
        if reported.battery is not None:
            native["current_a"] = reported.battery.current_a
        if self.motion.satellites is not None:
            native["gps.satellites"] = self.motion.satellites
        origin = self.motion.origin
        return native if origin is None else {**native, **origin.native()}

    # Time ----------------------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> bytes:
        """Return the bytes to send now."""
        self._check_silence(now_ns)
        made = self._due_sticks(now_ns)
        if self._telemetry is not None:
            made += b"".join(encode(frame) for frame in self._telemetry.requests(now_ns))
        if not self._known:
            self._begin(now_ns)
        question = self._questions.due(now_ns)
        if question is not None:
            made += encode(question)
        self.due_ns = now_ns + IDLE_NS
        if self._may_steer:
            self.due_ns = min(self.due_ns, self._sticks_due_ns)
        wanted = None if self._telemetry is None else self._telemetry.due_ns()
        if wanted is not None:
            self.due_ns = min(self.due_ns, max(wanted, now_ns + nanoseconds(0.005)))
        return made

    def _due_sticks(self, now_ns: int) -> bytes:
        urgent = self._step_stop(now_ns)
        known = self.setup is not None
        if not known:
            urgent |= self._stop_waits and self.setpoints.stop.active
            self._keep_part()
            known = urgent and self._may_stop_unread(now_ns)
            self._stop_waits = urgent and not known
        self.urgent = urgent and known
        if not known or not (urgent or (self._may_steer and now_ns >= self._sticks_due_ns)):
            return b""
        period = nanoseconds(1 / self.options.rate_hz)
        self._sticks_due_ns = max(self._sticks_due_ns + period, now_ns + period // 2)
        self._count(now_ns)
        self.setpoints.on_motion(self.motion.at(now_ns))
        made = self._stick_frame(now_ns)
        if not urgent and self._holds_back(now_ns):
            return b""
        self._sticks.append(now_ns)
        return made

    def _may_stop_unread(self, now_ns: int) -> bool:
        """Return whether a stop sent before all settings are read is certain not to arm a vehicle on the ground.

        If the arm switch's range is unknown, its channel is sent low, and on some vehicles a low channel arms them.
        """
        if self._refused_variant or self._part.ranges_of(ARM):
            return not self._refused_variant
        if self._armed is not None or self.options.override:  # with override, the pilot's receiver stays in use
            return bool(self._armed)
        return now_ns - self._opened_ns >= UNTOLD_NS

    def _holds_back(self, now_ns: int) -> bool:
        """Return whether to withhold sticks, which might wait in a buffer and act late, or override another pilot.

        A paused flight controller resumes as if no time had passed and obeys everything that arrived during the pause;
        only its replies prove that it is reading commands. Until the link is lost, a few frames are sent anyway, to
        hold off the failsafe in case only the flight controller's replies are lost.
        """
        heard_ns = self._received_ns
        while self._sticks and self._sticks[0] < (heard_ns or 0) and now_ns - self._sticks[0] >= STICKS_LOST_NS:
            self._sticks.popleft()
        soon = bool(self._sticks) and now_ns - self._sticks[-1] < STICKS_LOST_NS
        if heard_ns is not None:
            return self.reported.status is None or (len(self._sticks) >= MOST_STICKS and soon)
        self._last_sticks -= not soon
        return soon or self._last_sticks < 0

    def _step_stop(self, now_ns: int) -> bool:
        """Continue an emergency stop; return whether its sticks are due."""
        setpoints = self.setpoints
        active, urgent = setpoints.stop.active, setpoints.step_stop(now_ns)
        if active and not setpoints.stop.active and not setpoints.receiving:
            # Adopt a vehicle that turns out to be flying again instead of disarming it because of an old stop.
            self._may_steer, self._armed_throttle = False, None
            setpoints.report = MspReport()
        return urgent

    def _stick_frame(self, now_ns: int) -> bytes:
        return encode(MspFrame(Function.SET_RAW_RC, msp.pack_channels(self.setpoints.channels(now_ns))))

    def _count(self, now_ns: int) -> None:
        """Measure the rate of acknowledged stick frames."""
        since_ns = now_ns - self._counted_ns
        if since_ns < COUNT_NS or self.setup is None:
            return
        self.sticks_hz = self._acknowledged / seconds(since_ns)
        self._counted_ns, self._acknowledged = now_ns, 0
        slow = self.sticks_hz < LEAST_STICKS_HZ
        if slow and not self._slow and self._received_ns is not None:
            pace = _pace(self.sticks_hz, self.setup.identity.variant)
            self._publish_event(message(f"{pace.detail}: {pace.advice}", "slow", Severity.WARNING, rate=self.sticks_hz))
        self._slow = slow

    def _begin(self, now_ns: int) -> None:
        """Start identifying the flight controller, unless requests are already pending."""
        if not self._questions.idle or (self._asked_ns is not None and now_ns - self._asked_ns < AGAIN_NS):
            return
        self._asked_ns = now_ns
        self._questions.ask(Function.STATUS, self._on_armed)
        self._identification = Identification(self._questions, self._on_setup)
        self._questions.ask(Function.STATUS, self._on_identity)

    def _on_armed(self, status: bytes | None) -> None:
        if status is not None and len(status) > _MODES_AT:
            self._armed = bool(status[_MODES_AT] & 1)  # ARM is the first mode in both firmwares' status bits

    def _on_identity(self, status: bytes | None) -> None:
        self._on_armed(status)
        assert self._identification is not None
        identity = self._identification.setup.identity
        if identity.variant in SUPPORTED:
            self._identification.ask_settings()
        elif identity.variant and identity.variant != self._refused_variant:
            self._refused_variant = identity.variant
            known = "Betaflight (BTFL) and INAV"
            text = f"the firmware is {identity.variant!r}, which can't be flown over MSP; supported: {known}"
            self._publish_event(message(text, "firmware", Severity.ERROR))
            self._set_link_state(LinkState.DEGRADED, text)

    def _on_setup(self, setup: MspSetup) -> None:
        assert self._identification is not None
        if self._identification.missing:  # without them, the throttle or arm switch would be a guess, so ask again
            missing = ", ".join(self._identification.missing)
            if missing != self._unread:
                text = f"the flight controller did not report the {missing}: asking again before steering it"
                self._publish_event(message(text, "setup_unread", Severity.WARNING))
            self._unread = missing
            self._keep_part()
            return
        self.setup, self._known, self._unread = setup, True, ""
        self.reported.cells = setup.cells
        diagnostics = setup.diagnose(override=self.options.override)
        self.setpoints.set_up(setup, hindrances(diagnostics))
        self._publish_event(message(str(setup.identity), "firmware"))
        for each in diagnostics:
            if not each.good:
                text = f"{each.detail}: {each.advice}" if each.advice else each.detail
                severity = Severity.ERROR if each.severe else Severity.WARNING
                self._publish_event(message(text, "setup", severity, what=each.what))
        betaflight = setup.identity.variant == BETAFLIGHT
        streams: dict[int, float] = {
            Function.RC: PILOT_HZ if self.options.override else 1.0,
            Function.ATTITUDE: ATTITUDE_HZ,
            Function.ALTITUDE: ALTITUDE_HZ,
            Function.STATUS_EX if betaflight else Function.INAV_STATUS: STATUS_HZ,
            Function.RAW_GPS: GPS_HZ,
            Function.BATTERY_STATE if betaflight else Function.INAV_ANALOG: BATTERY_HZ,
        }
        bundles = betaflight and setup.identity.api >= BUNDLING_API
        bundle = (Function.ATTITUDE, Function.ALTITUDE, Function.STATUS_EX) if bundles else ()
        self._telemetry = MspTelemetry(streams, bundle)

    def _keep_part(self) -> None:
        """Keep the settings read so far or in an earlier attempt, so that at least a stop is possible."""
        if self.setup is not None or self._identification is None:
            return
        found, before = self._identification.setup, self._part
        if found.identity.variant in SUPPORTED and _known_settings(found) >= _known_settings(before):
            self._part = found
            self.setpoints.set_up(found, "its settings have not been read")

    def _new_events(self) -> list[VehicleEvent]:
        return self.setpoints.pop_events()

    # Loss ----------------------------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        """Identify the flight controller again while requesting its state, so that control in flight soon resumes.

        After :data:`LAST_STICKS` final frames, only requests and stops are sent, so that the vehicle's failsafe acts.
        """
        del now_ns
        self._keep_part()
        self._received_ns = self._asked_ns = self._identification = None
        self._known, self._refused_variant, self._wakes_until_ns, self._armed = False, "", None, None
        self._questions.clear()
        if self._telemetry is not None:
            self._telemetry.forget()
        if self.setup is not None:
            self.setpoints.set_up(self.setup, "its settings are being read again")
        self._sticks.clear()
        self._last_sticks = LAST_STICKS
        self.motion.lost()
        self.setpoints.lost()
        self.reported = replace(self.reported, attitude=None, altitude=None, status=None)
        self._set_link_state(LinkState.LOST, reason)

    def _describe_silence(self, since: str, why: str) -> str:
        return f"no reply{since} from the flight controller on {self.options}{why}"

    def _advice(self) -> str:
        if self.options.serial:
            return "connect it, give the baud rate of its MSP port in the address, and close the configurator"
        if self.options.place.startswith("127."):
            return "start Betaflight's SITL or the emulator: skyloop sim --firmware betaflight"
        return "check host and port in the address, and close other programs connected to that port"

    def _trouble(self, error: OSError) -> LinkTrouble:
        if self.options.serial:
            return serial_trouble(error, self.options.place, self._advice())
        return super()._trouble(error)


def _known_settings(setup: MspSetup) -> tuple[bool, bool]:
    return bool(setup.arm_ranges), setup.sticks_known


def _has_height(status: msp.MspStatus) -> bool:
    return any(status.has(sensor) for sensor in (Sensor.BAROMETER, Sensor.GPS, Sensor.RANGEFINDER))


def _pace(sticks_hz: float, variant: str) -> Diagnostic:
    detail = f"it takes {sticks_hz:.0f} stick updates per second"
    if sticks_hz >= LEAST_STICKS_HZ:
        return Diagnostic("pace", True, detail)
    advice = "set serial_update_rate_hz = 1000" if variant == BETAFLIGHT else "use a faster port"
    return Diagnostic("pace", False, f"{detail} only: steering lags", advice)
