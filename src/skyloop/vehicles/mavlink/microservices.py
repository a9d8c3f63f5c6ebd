"""MAVLink's microservices: vehicle selection, commands, message intervals, time, external poses. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.clock import LiveClock, nanoseconds, seconds
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.vehicle_session import PacketOrder, RestartWatch, VehicleEvent
from skyloop.drivers.vehicle_session import message as event_of
from skyloop.messages import Severity
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.vehicles.mavlink.options import Peer, PoseMessage
from skyloop.vehicles.mavlink.telemetry import MavlinkTelemetry
from skyloop.vehicles.mavlink.wire.axes import angles_of, swap, to_wire, yaw_between
from skyloop.vehicles.mavlink.wire.codec import MavAutopilot, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

MOVED_NS: Final = nanoseconds(0.3)  #: time without data after which the vehicle may have moved to another port
MOST_OTHERS: Final = 16  #: maximum number of other vehicles reported: a hostile sender can invent any number of them
_NO_AUTOPILOT: Final = m.MAV_AUTOPILOT_INVALID
_GROUND_STATION: Final = m.MAV_TYPE_GCS
#: MAV_TYPE of multirotors and helicopters.
_MULTIROTORS: Final = frozenset({2, 3, 4, 13, 14, 15, 29, 35})


@dataclass(frozen=True, slots=True)
class VehicleIdentity:
    """Identifies a vehicle whose heartbeats are received."""

    system: int
    component: int
    peer: Peer


class VehicleSelector:
    """Selects one vehicle among all whose heartbeats are received.

    Without a system id, the first system found is selected and kept from then on.
    """

    def __init__(self, system: int | None, peer: tuple[str, int] | None, component: int = 1) -> None:
        self.system = system
        self._component = component
        self.chosen: VehicleIdentity | None = None
        self._wanted_peer = peer
        self._reported: set[VehicleIdentity] = set()
        self._elsewhere: set[VehicleIdentity] = set()  # heard from since the chosen vehicle, which may have moved there
        self._others: set[VehicleIdentity] = set()  # other vehicles with the same id, heard from at the same time
        self._received_ns = 0  # when the chosen vehicle was last heard from

    def on_message(self, message: Message, peer: Peer, now_ns: int) -> list[VehicleEvent]:
        """Handle a message; return events about other vehicles, or about the chosen vehicle's move to another port."""
        found = VehicleIdentity(message.get_srcSystem(), message.get_srcComponent(), peer)
        if self.chosen == found:
            self._received_ns = now_ns
            self._others |= self._elsewhere
            self._elsewhere.clear()
            return []
        if self._may_have_moved(found):
            self._elsewhere.add(found)
            if now_ns - self._received_ns >= MOVED_NS:
                self.chosen, self._received_ns = found, now_ns
                self._elsewhere.clear()
                text = f"the vehicle now sends from UDP port {found.peer[1] if found.peer else 0}"
                return [event_of(text, "moved")]
        if message.get_type() != "HEARTBEAT" or not _is_vehicle(message):
            return []
        suits = self.system in (None, found.system) and self._wanted_peer in (None, peer)
        if self.chosen is None and suits and found.component == self._component:
            self.chosen, self.system, self._received_ns = found, found.system, now_ns
            return []
        return self._report_other(found)

    def _may_have_moved(self, found: VehicleIdentity) -> bool:
        """Return whether this may be the chosen vehicle on a new port, for example one assigned by its host."""
        chosen = self.chosen
        if chosen is None or chosen.peer is None or found.peer is None or self._wanted_peer is not None:
            return False
        same = (found.system, found.component, found.peer[0]) == (chosen.system, chosen.component, chosen.peer[0])
        return same and found not in self._others and len(self._others | self._elsewhere) < MOST_OTHERS

    def is_chosen(self, message: Message, peer: Peer) -> bool:
        """Return whether a message was sent by the chosen vehicle."""
        chosen = self.chosen
        return (
            chosen is not None
            and message.get_srcSystem() == chosen.system
            and message.get_srcComponent() == chosen.component
            and peer == chosen.peer
        )

    def forget(self) -> None:
        """Forget the chosen vehicle, because the same system may come back from another peer."""
        self.chosen = None
        self._others.clear()
        self._elsewhere.clear()

    def _report_other(self, found: VehicleIdentity) -> list[VehicleEvent]:
        """Report another vehicle or component, once."""
        if found in self._reported or len(self._reported) >= MOST_OTHERS:
            return []
        self._reported.add(found)
        if found.component != self._component:
            text = (
                f"an autopilot answers as component {found.component} of system {found.system}, not as component "
                f"{self._component}: ignored; ?component={found.component} chooses it"
            )
            return [event_of(text, "component", Severity.WARNING, system=found.system, component=found.component)]
        where = f" at {found.peer[0]}:{found.peer[1]}" if found.peer is not None else ""
        text = f"another vehicle answers, system {found.system}{where}: ignored"
        if self.chosen is not None and found.system == self.chosen.system:
            text += "; ?peer=HOST:PORT distinguishes two with one id"
        else:
            text += f"; ?sysid={found.system} chooses it"
        return [event_of(text, "another", Severity.WARNING, system=found.system)]


def _is_vehicle(heartbeat: Message) -> bool:
    return bool(
        heartbeat.get_srcSystem() != 0 and heartbeat.autopilot != _NO_AUTOPILOT and heartbeat.type != _GROUND_STATION
    )


def unsupported_reason(heartbeat: Message) -> str:
    """Return why Skyloop can't fly this vehicle; empty if it can."""
    if heartbeat.autopilot not in tuple(MavAutopilot):
        return f"its MAV_AUTOPILOT is {heartbeat.autopilot}; only ArduCopter and PX4 are supported"
    if heartbeat.type not in _MULTIROTORS:
        return f"its MAV_TYPE is {heartbeat.type}, not a multirotor or helicopter"
    return ""


# MAV_RESULT.
ACCEPTED: Final = 0
IN_PROGRESS: Final = 5
_RESULTS: Final = ("accepted", "temporarily rejected", "denied", "unsupported", "failed", "in progress", "cancelled")


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """A MAVLink command: its ``MAV_CMD`` number and up to seven arguments."""

    number: int
    arguments: tuple[float, ...] = ()


def result_name(result: int) -> str:
    """Return a ``MAV_RESULT`` as words."""
    return _RESULTS[result] if 0 <= result < len(_RESULTS) else f"result {result}"


class MavlinkCommandSender:
    """Sends commands and stores their results.

    Level-triggered: to achieve an effect, a caller keeps calling :meth:`request` until the effect is visible.
    """

    def __init__(self, target: tuple[int, int] = (1, 1)) -> None:
        self.target = target  #: target system and component
        self._out: list[Message] = []
        self._sent: dict[VehicleCommand, tuple[int, int]] = {}  # time of the last request, number of requests
        self._answers: dict[int, tuple[int, int]] = {}  # result of each command, and when it arrived

    def request(self, command: VehicleCommand, now_ns: int, pace_s: float = 0.5) -> None:
        """Send a command, unless it was sent within ``pace_s``."""
        last_ns, times = self._sent.get(command, (None, 0))
        if last_ns is not None and now_ns - last_ns < nanoseconds(pace_s):
            return
        if last_ns is None or now_ns - last_ns > 4 * nanoseconds(pace_s):
            times = 0  # a new request: the confirmation field counts only repeats
        self._sent[command] = now_ns, times + 1
        arguments = (*command.arguments, *[0.0] * (7 - len(command.arguments)))
        self._out.append(m.MAVLink_command_long_message(*self.target, command.number, min(times, 255), *arguments))

    def on_ack(self, message: Message, now_ns: int) -> None:
        """Handle a ``COMMAND_ACK`` addressed to us."""
        if message.result != IN_PROGRESS:
            self._answers[message.command] = message.result, now_ns

    def result(self, command: int, since_ns: int) -> int | None:
        """Return the newest result of a command if it arrived since ``since_ns``."""
        found = self._answers.get(command)
        return found[0] if found is not None and found[1] >= since_ns else None

    def reset(self) -> None:
        """Discard everything because the link was lost."""
        self._out.clear()
        self._sent.clear()
        self._answers.clear()

    def pop_messages(self) -> list[Message]:
        """Return the messages to send now."""
        out, self._out = self._out, []
        return out


AT_ONCE: Final = 4  #: maximum number of requests per tick, to leave room for other messages on a slow link
RETRY_S: Final = 3.0  #: time after which a message that is missing or too slow is requested again
ENOUGH: Final = 0.5  #: fraction of the requested rate that is good enough
PATIENT_RETRY_S: Final = 20.0  #: retry interval after :data:`TRIES`, in case the vehicle does not have the message
TRIES: Final = 4  #: number of requests at the shorter interval
CHECK_NS: Final = nanoseconds(0.2)  #: time between checks of the rates once everything has been requested


class MessageIntervals:
    """Requests messages at the rates that feedback needs, repeating the requests while messages are missing."""

    def __init__(self, rates: Mapping[str, float]) -> None:
        self._rates = dict(rates)
        self._asked: dict[str, tuple[int, int, int]] = {}  # start of counting, count at that time, number of requests
        self._check_ns = 0

    def request_missing(self, telemetry: MavlinkTelemetry, commands: MavlinkCommandSender, now_ns: int) -> None:
        """Request up to :data:`AT_ONCE` messages that are missing or too slow."""
        if now_ns < self._check_ns:
            return
        left = AT_ONCE
        for name, rate_hz in self._rates.items():
            if not left:
                return
            since_ns, before, times = self._asked.get(name, (None, 0, 0))
            count = telemetry.counts[name]
            if since_ns is not None:
                since_s = seconds(now_ns - since_ns)
                if since_s < max(RETRY_S if times < TRIES else PATIENT_RETRY_S, 3.0 / rate_hz):
                    continue
                if count - before >= ENOUGH * rate_hz * since_s:
                    self._asked[name] = now_ns, count, times
                    continue
            self._asked[name] = now_ns, count, times + 1
            number = getattr(m, f"MAVLINK_MSG_ID_{name}")
            commands.request(VehicleCommand(m.MAV_CMD_SET_MESSAGE_INTERVAL, (number, 1e6 / rate_hz)), now_ns, 0.0)
            left -= 1
        self._check_ns = now_ns + CHECK_NS


ASK_NS: Final = nanoseconds(1.0)  #: time between TIMESYNC requests
HURRY_NS: Final = nanoseconds(0.1)  #: time between the first few requests
FIRST: Final = 5  #: number of requests at the shorter interval
KEEP_NS: Final = nanoseconds(10.0)  #: how long a clock sample is used
PLAUSIBLE_NS: Final = nanoseconds(1.0)  #: age on arrival above which a stamp is assumed to be from another clock
BEHIND_MS: Final = 1000  #: backward jump of a stamp above which the vehicle may have rebooted
_WRAP: Final = 1 << 32  #: stamps in ms wrap around at this value, after 49 days


class VehicleClock:
    """Converts a vehicle's stamps to this host's clock, using ``TIMESYNC`` if plausible or else the smallest delay."""

    def __init__(self) -> None:
        self.round_trip_s: float | None = None  #: round trip of the best recent reply
        self._samples: deque[tuple[int, int, int]] = deque()  # time, round trip, and the vehicle's clock minus ours
        self._offset_ns: int | None = None  # the vehicle's clock minus ours in the best sample
        self._asked_ns = 0
        self._asked = 0
        self._live = LiveClock()
        self._watches: dict[str, RestartWatch] = {}  # keyed by message name
        self._captured_ns = 0

    def poll(self, now_ns: int) -> list[Message]:
        """Return the ``TIMESYNC`` request, stamped by our clock, if one is due."""
        if now_ns - self._asked_ns < (HURRY_NS if self._asked < FIRST else ASK_NS):
            return []
        self._asked_ns, self._asked = now_ns, self._asked + 1
        return [m.MAVLink_timesync_message(0, now_ns)]

    def on_timesync(self, message: Message, now_ns: int) -> list[Message]:
        """Handle a ``TIMESYNC``; return the reply if it is a request."""
        if message.tc1 == 0:
            return [m.MAVLink_timesync_message(now_ns, message.ts1)]
        round_trip_ns = now_ns - message.ts1
        if 0 <= round_trip_ns <= PLAUSIBLE_NS and self._asked:
            self._samples.append((now_ns, round_trip_ns, message.tc1 - (message.ts1 + round_trip_ns // 2)))
            while now_ns - self._samples[0][0] > KEEP_NS:
                self._samples.popleft()
            _, best_ns, self._offset_ns = min(self._samples, key=lambda each: each[1])
            self.round_trip_s = seconds(best_ns)
        return []

    def on_stamp(self, kind: str, boot_ms: int, now_ns: int) -> PacketOrder:
        """Classify a message by its stamp as new, older than others of its kind, or sent after a reboot."""
        return self._watches.setdefault(kind, RestartWatch(BEHIND_MS, _WRAP)).update(boot_ms, now_ns)

    def captured_ns(self, boot_ms: int, now_ns: int) -> int:
        """Return the capture time of the stamped state, limited to between the previous capture time and arrival."""
        live_ns = self._live.captured_ns(boot_ms / 1000.0, now_ns)
        if self._offset_ns is not None:
            synced_ns = boot_ms * 1_000_000 - self._offset_ns
            # Stamps are truncated to milliseconds, so they may be up to 1 ms too early.
            if 0 <= now_ns - synced_ns <= PLAUSIBLE_NS:
                live_ns = synced_ns
        self._captured_ns = max(self._captured_ns, min(now_ns, live_ns))
        return self._captured_ns

    def now(self, now_ns: int) -> int:
        """Return the capture time of a state that has no stamp."""
        self._captured_ns = max(self._captured_ns, now_ns)
        return self._captured_ns


_NAN: Final = math.nan


def pose_message(pose: ExternalPose, kind: PoseMessage) -> Message:
    """Convert an external pose to a message.

    The message has north, east, down [m], and the angles [rad] of a body with forward, right and down axes. The
    message's time is in microseconds on our own clock, to which ``TIMESYNC`` relates the vehicle's clock.
    """
    position = swap(*pose.position_m)
    roll, pitch, yaw = angles_of(pose.quaternion)
    angles = roll, 0.0 - pitch, yaw_between(yaw)
    covariance = _covariance(pose)
    if kind is PoseMessage.VISION:
        return m.MAVLink_vision_position_estimate_message(pose.captured_ns // 1000, *position, *angles, covariance, 0)
    q = to_wire(quaternion_from_euler(*angles))
    time_us, frames = pose.captured_ns // 1000, (m.MAV_FRAME_LOCAL_NED, m.MAV_FRAME_BODY_FRD)
    rest = [_NAN] * 21, 0, m.MAV_ESTIMATOR_TYPE_MOCAP, 100  # unknown covariance of the velocities
    return m.MAVLink_odometry_message(time_us, *frames, *position, q, *[_NAN] * 6, covariance, *rest)


def _covariance(pose: ExternalPose) -> list[float]:
    """Return the upper right triangle for x, y, z, roll, pitch, yaw; NaN if the standard deviations are unknown."""
    if pose.position_std_m is None or pose.attitude_std_rad is None:
        return [_NAN] * 21
    variances = [pose.position_std_m**2] * 3 + [pose.attitude_std_rad**2] * 3
    return [variances[row] if row == column else 0.0 for row in range(6) for column in range(row, 6)]
