"""The Tello's logic: executes and answers commands one at a time, within Ryze's limits (SDK 1.3, 2.0).

Pure: the clock is an argument, and replies are passed to a function.

Replies that are not in any guide ("error Motor stop", "error Not joystick", "error No valid marker") were reported by
users. The exact conditions under which real firmware sends them are unverified.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from skyloop.clock import Clock, nanoseconds
from skyloop.messages import AnyAction, EmergencyStop, FlightState, Hover, Land, ResetEmergency, Takeoff, Velocity
from skyloop.messages.geometry import clamped, turned, wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.world import Vec3
from skyloop.vehicles.emulation.emulator import Address
from skyloop.vehicles.emulation.flight import Vehicle
from skyloop.vehicles.tello.emulator import telemetry
from skyloop.vehicles.tello.emulator.telemetry import PadSighting, seen
from skyloop.vehicles.tello.wire import (
    ENTER,
    FULL_CLIMB_M_S,
    FULL_SPEED_M_S,
    FULL_YAW_RATE_RAD_S,
    MAX_STICK,
    SILENCE_S,
    STATE_PORT,
    VIDEO_PORT,
    Sdk,
    decoded,
)

# Commands that take time and are answered when they end; driven by reports -------------------------------------------

OK: Final = "ok"
SPIN_UP_S: Final = 0.8  #: time before a take-off leaves the ground; a recorded flight was airborne after 1.1 s
RISES_WITHIN_S: Final = 0.5  #: simulated time without rising after which take-off was refused for a low battery
TAKEOFF_ANSWER_S: Final = 8.7  #: time from command to reply in the same flight, but the drone hovered long before it
FLIP_S: Final = 1.5  #: duration of a flip (an estimate); the simulated vehicle does not turn over
TURN_RAD_S: Final = 1.0  #: yaw rate of a turn, an estimate
PATIENCE_S: Final = 30.0  #: time after which an unfinished command fails
_NEAR_M: Final = 0.06  # maximum distance at which a move ends …
_SLOW_M_S: Final = 0.12  # … and the maximum speed
_NEAR_RAD: Final = 0.03  # maximum angle at which a turn ends
_FLYING: Final = (FlightState.HOVERING, FlightState.FLYING)

#: The vehicle's next command, and the reply if the running command has ended.
Step = tuple[AnyAction | None, str | None]


class Rising:
    """``takeoff``."""

    def __init__(self, report: Report) -> None:
        self._begun_s = report.truth.time_s
        self._commanded_s: float | None = None

    def step(self, report: Report) -> Step:
        now_s, state = report.truth.time_s, report.truth.state
        elapsed_s = now_s - self._begun_s
        if self._commanded_s is None:
            if elapsed_s < SPIN_UP_S:
                return None, None
            self._commanded_s = now_s
            return Takeoff(), None
        if state in (FlightState.LANDED, FlightState.EMERGENCY):
            # The time is measured from the command, because this step may run late on a busy machine.
            return None, "error" if now_s - self._commanded_s > RISES_WITHIN_S else None
        return None, OK if state in _FLYING and elapsed_s >= TAKEOFF_ANSWER_S else None


class Landing:
    """``land``, and the Tello's automatic landing when it receives no commands."""

    def step(self, report: Report) -> Step:
        if report.truth.state in (FlightState.LANDED, FlightState.EMERGENCY):
            return None, OK
        return (None if report.truth.state is FlightState.LANDING else Land()), None


class Flipping:
    """``flip``; only the duration is simulated."""

    def __init__(self, report: Report) -> None:
        self._until_s = report.truth.time_s + FLIP_S

    def step(self, report: Report) -> Step:
        return None, OK if report.truth.time_s >= self._until_s else None


class Turning:
    """``cw`` and ``ccw``: turns by an angle, positive counter-clockwise, which may exceed a full turn."""

    def __init__(self, report: Report, by_rad: float) -> None:
        self._left_rad = by_rad
        self._yaw_rad = report.truth.yaw_rad

    def step(self, report: Report) -> Step:
        self._left_rad -= wrap_angle(report.truth.yaw_rad - self._yaw_rad)
        self._yaw_rad = report.truth.yaw_rad
        if abs(self._left_rad) < _NEAR_RAD:
            return Hover(), OK
        return Velocity(yaw_rate=clamped(2.5 * self._left_rad, TURN_RAD_S)), None


class Going:
    """Moves, ``go`` and ``curve``: flights through waypoints in world axes [m]."""

    def __init__(self, report: Report, places: Sequence[Vec3], speed_m_s: float) -> None:
        self._places = list(places)
        self._speed_m_s = speed_m_s
        self._until_s = report.truth.time_s + PATIENCE_S

    def step(self, report: Report) -> Step:
        truth = report.truth
        if truth.time_s > self._until_s:
            return Hover(), "error"
        offset = [goal - here for goal, here in zip(self._places[0], truth.position_m, strict=True)]
        distance_m = math.hypot(*offset)
        last = len(self._places) == 1
        if distance_m < (_NEAR_M if last else 0.15) and (not last or math.hypot(*truth.velocity_m_s) < _SLOW_M_S):
            if last:
                return Hover(), OK
            del self._places[0]
            return None, None
        share = min(self._speed_m_s, 1.6 * distance_m) / max(distance_m, 1e-6)
        east, north, up = (part * share for part in offset)
        return Velocity(*turned(east, north, -truth.yaw_rad), up), None


Job = Rising | Landing | Flipping | Turning | Going


# The logic -----------------------------------------------------------------------------------------------------------

OUT_OF_RANGE: Final = "out of range"
Range = tuple[int, int]

_MOVE: Final[tuple[Range, ...]] = ((20, 500),)
_SPEED: Final[Range] = (10, 100)
_PLACE: Final[tuple[Range, ...]] = ((-500, 500),) * 3
_LEAST_CM: Final = 20  # magnitude that at least one coordinate of a target must have

MOVES: Final = {
    "up": (0, 0, 1),
    "down": (0, 0, -1),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
}  #: forward, left, up
#: The first SDK version that has each command, and the ranges of the command's integers.
NUMBERS: Final[dict[str, tuple[Sdk, tuple[Range, ...]]]] = {
    **dict.fromkeys(MOVES, (Sdk.V1_3, _MOVE)),
    "cw": (Sdk.V1_3, ((1, 3600),)),
    "ccw": (Sdk.V1_3, ((1, 3600),)),
    "go": (Sdk.V1_3, (*_PLACE, _SPEED)),
    "curve": (Sdk.V1_3, (*_PLACE, *_PLACE, (10, 60))),
    "speed": (Sdk.V1_3, (_SPEED,)),
    "rc": (Sdk.V1_3, ((-100, 100),) * 4),
    "mdirection": (Sdk.V2_0, ((0, 2),)),
    "port": (Sdk.V3_0, ((1025, 65535), (1025, 65535))),
    "setbitrate": (Sdk.V3_0, ((0, 5),)),
    "downvision": (Sdk.V3_0, ((0, 1),)),
}
_FULL_TURN: Final = 360  # the largest turn since SDK 2.0


def numbers_of(name: str, words: list[str], sdk: Sdk) -> list[int] | str:
    """Return the numbers in a command, or the Tello's reply if it refuses them."""
    _, ranges = NUMBERS[name]
    if len(words) != len(ranges):
        return "error"
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        return "error"
    low_high = [(low, _FULL_TURN) for low, _ in ranges] if name in ("cw", "ccw") and sdk is not Sdk.V1_3 else ranges
    if not all(low <= number <= high for number, (low, high) in zip(numbers, low_high, strict=True)):
        return _refusal(sdk)
    if name in ("go", "curve") and not any(abs(number) >= _LEAST_CM for number in numbers[-4:-1]):
        return _refusal(sdk)
    return numbers


def _refusal(sdk: Sdk) -> str:
    return "error" if sdk is Sdk.V1_3 else OUT_OF_RANGE


USUAL_SPEED_CM_S: Final = 50  #: speed in force until a ``speed`` command changes it
FPS: Final = {"high": 30.0, "middle": 15.0, "low": 5.0}
SIZES: Final = {"high": (960, 720), "low": (640, 480)}
_SINCE: Final = {"stop": Sdk.V2_0, "mon": Sdk.V2_0, "moff": Sdk.V2_0, "sdk?": Sdk.V2_0, "sn?": Sdk.V2_0}
_SDK_NUMBERS: Final = {Sdk.V2_0: "20", Sdk.V3_0: "30"}


class TelloLogic:
    """The logic of one drone. Not thread-safe. Replies are passed to a function, with their recipient's address."""

    def __init__(
        self,
        vehicle: Vehicle,
        answer: Callable[[str, Address], None],
        clock: Clock,
        *,
        sdk: Sdk,
        pads: Mapping[int, tuple[float, float]],
        link_quality: int = 100,
    ) -> None:
        self._vehicle = vehicle
        self._answer = answer
        self._clock = clock
        self._sdk = sdk
        self._pads = pads
        self._link_quality = link_quality
        self._report: Report | None = None
        self._job: tuple[Job, Address | None] | None = None  # the running job, with the recipient of its reply
        self._received_ns = clock()
        self._speed_cm_s = USUAL_SPEED_CM_S
        self._start: tuple[float, float] | None = None  # yaw when switched on, altitude at take-off
        self._motor_s = 0.0
        self._before_s: float | None = None
        self.client: str | None = None  #: the recipient of state and video; None before ``command``
        self.state_port = STATE_PORT
        self.video_port = VIDEO_PORT
        self.streaming = False
        self.looks_down = False
        self.looks_for_pads = False
        self.fps = FPS["high"]
        self.size = SIZES["high"]
        self.bitrate_mbps = 0  #: bitrate; 0 to adapt to the link
        self.unknown = 0  #: number of datagrams that were not commands

    # Receiving -------------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes, sender: Address) -> None:
        """Execute a command and reply to it. Never raises, regardless of content."""
        text = decoded(datagram)
        if not text or (self.client is None and text != ENTER):
            self.unknown += 1
            return
        self._received_ns = self._clock()
        if text == ENTER:
            self.client = sender[0]
        reply = self._obey(text, sender)
        if reply:
            self._answer(reply, sender)

    def supervise(self, report: Report) -> None:
        """Handle the vehicle's newest report and continue the current command. Called regularly."""
        truth = report.truth
        if self._start is None:
            self._start = report.believed.yaw_rad, report.believed.altitude_m
        if self._before_s is not None and truth.state.airborne:
            self._motor_s += truth.time_s - self._before_s
        self._before_s = truth.time_s
        self._report = report
        if truth.state is FlightState.EMERGENCY:
            self._job = None
            self._vehicle.command(ResetEmergency())  # the reset works on the ground: a Tello has no emergency state
        if self._clock() - self._received_ns > nanoseconds(SILENCE_S) and truth.state in _FLYING:
            self._job = Landing(), None
        if self._job is None:
            return
        job, sender = self._job
        action, reply = job.step(report)
        if action is not None:
            self._vehicle.command(action)
        if reply is not None:
            self._job = None
            if sender is not None:
                self._answer(reply, sender)

    # Sending ---------------------------------------------------------------------------------------------------

    def state_string(self) -> bytes | None:
        """Return the current state string; None before the first report."""
        snapshot = self._snapshot()
        return None if snapshot is None else telemetry.state_string(snapshot, self._sdk)

    def _snapshot(self) -> telemetry.TelloSnapshot | None:
        if self._report is None or self._start is None:
            return None
        yaw_rad, altitude_m = self._start
        return telemetry.TelloSnapshot(self._report, yaw_rad, altitude_m, int(self._motor_s), self._pad())

    def _pad(self) -> PadSighting | None:
        if not self.looks_for_pads or self._report is None:
            return None
        return seen(self._pads, self._report.truth)

    # Commands --------------------------------------------------------------------------------------------------

    def _obey(self, text: str, sender: Address) -> str | None:
        """Execute a command. Return the reply; None if there is no reply, or not yet."""
        name, *words = text.split()
        if not self._sdk.knows(NUMBERS[name][0] if name in NUMBERS else _SINCE.get(name, Sdk.V1_3)):
            return f"unknown command: {text}"
        if name in NUMBERS:
            return self._obey_numbers(name, words, sender)
        if name.endswith("?"):
            return self._reply(name)
        if name == "takeoff":
            return self._take_off(sender)
        if name == "land":
            return self._land(sender)
        if name == "emergency":
            self._job = None
            self._vehicle.command(EmergencyStop())
            return OK
        if name == "stop":
            self._job = None
            if self._vehicle.state in _FLYING:
                self._vehicle.command(Hover())
            return OK
        if name == "flip":
            return self._flip(words, sender)
        return self._configure(name, words, text)

    def _obey_numbers(self, name: str, words: list[str], sender: Address) -> str | None:
        pad = None
        if name in ("go", "curve") and words and words[-1].startswith("m"):
            pad = words.pop()
        numbers = numbers_of(name, words, self._sdk)
        if isinstance(numbers, str):
            return None if name == "rc" else numbers
        if name == "rc":
            self._follow(numbers)
            return None
        if name in MOVES or name in ("go", "curve", "cw", "ccw"):
            return self._move(name, numbers, pad, sender)
        if name == "speed":
            self._speed_cm_s = numbers[0]
        elif name == "port":
            self.state_port, self.video_port = numbers
        elif name == "setbitrate":
            self.bitrate_mbps = numbers[0]
        elif name == "downvision":
            self.looks_down = bool(numbers[0])
        return OK  # ``mdirection`` has no effect: pads are seen in any case

    def _configure(self, name: str, words: list[str], text: str) -> str:
        if name in ("streamon", "streamoff"):
            self.streaming = name == "streamon"
        elif name in ("mon", "moff"):
            self.looks_for_pads = name == "mon"
        elif name == "setfps" and self._sdk is Sdk.V3_0 and len(words) == 1 and words[0] in FPS:
            self.fps = FPS[words[0]]
        elif name == "setresolution" and self._sdk is Sdk.V3_0 and len(words) == 1 and words[0] in SIZES:
            self.size = SIZES[words[0]]
        elif name not in (ENTER, "wifi", "ap") and not (name == "keepalive" and self._sdk is Sdk.V3_0):
            return f"unknown command: {text}"
        return OK

    def _reply(self, question: str) -> str:
        own = {
            "speed?": f"{self._speed_cm_s:.1f}\r\n",
            "wifi?": f"{self._link_quality}\r\n",
            "sdk?": _SDK_NUMBERS.get(self._sdk, ""),
            "sn?": "0TQEMULATED001",
        }
        snapshot = self._snapshot()
        if question in own:
            return own[question]
        if snapshot is None:
            return "error"
        try:
            return telemetry.answer(question, snapshot)
        except KeyError:
            return f"unknown command: {question}"

    # Flying ----------------------------------------------------------------------------------------------------

    def _take_off(self, sender: Address) -> str | None:
        if self._report is None or self._vehicle.state is not FlightState.LANDED or self._job is not None:
            return "error"
        self._start = (self._start or (0.0, 0.0))[0], self._report.believed.altitude_m
        self._job = Rising(self._report), sender
        return None

    def _land(self, sender: Address) -> str | None:
        if self._vehicle.state in (FlightState.LANDED, FlightState.EMERGENCY):
            self._job = None  # cancels a take-off that has not left the ground yet
            return "error Motor stop"
        self._job = Landing(), sender
        return None

    def _follow(self, sticks: list[int]) -> None:
        """Handle ``rc``, which gets no reply and has no effect during a manoeuvre."""
        if self._vehicle.state not in _FLYING or not isinstance(self._job[0] if self._job else None, Rising | None):
            return
        right, forward, up, clockwise = (stick / MAX_STICK for stick in sticks)
        if not any(sticks):
            self._vehicle.command(Hover())
            return
        self._vehicle.command(
            Velocity(
                forward=forward * FULL_SPEED_M_S,
                left=-right * FULL_SPEED_M_S,
                up=up * FULL_CLIMB_M_S,
                yaw_rate=-clockwise * FULL_YAW_RATE_RAD_S,
            )
        )

    def _flip(self, words: list[str], sender: Address) -> str | None:
        if len(words) != 1 or words[0] not in ("l", "r", "f", "b"):
            return "error"
        refused = self._not_now()
        if refused or self._report is None:
            return refused or "error"
        self._job = Flipping(self._report), sender
        return None

    def _not_now(self) -> str | None:
        if self._vehicle.state not in _FLYING:
            return "error Motor stop"
        return "error Not joystick" if self._job is not None else None

    def _move(self, name: str, numbers: list[int], pad: str | None, sender: Address) -> str | None:
        refused = self._not_now()
        report = self._report
        if refused or report is None:
            return refused or "error"
        if name in ("cw", "ccw"):
            self._job = Turning(report, math.radians(numbers[0] if name == "ccw" else -numbers[0])), sender
            return None
        speed = self._speed_cm_s
        if name in MOVES:
            offsets = [[part * numbers[0] for part in MOVES[name]]]
        else:
            *places, speed = numbers
            offsets = [places[at : at + 3] for at in range(0, len(places), 3)]
        goals = self._places(offsets, pad)
        if goals is None:
            return "error No valid marker"
        self._job = Going(report, goals, speed / 100), sender
        return None

    def _places(self, offsets_cm: list[list[int]], pad: str | None) -> list[Vec3] | None:
        """Return positions in world axes, given relative to the drone or to a pad; None if the pad is not in view."""
        assert self._report is not None
        truth = self._report.truth
        base, heading = truth.position_m, truth.yaw_rad
        if pad is not None:
            sighting = self._pad()
            if sighting is None or pad != f"m{sighting.number}":
                return None
            east, north = self._pads[sighting.number]
            base, heading = (east, north, 0.0), 0.0
        cos, sin = math.cos(heading), math.sin(heading)
        return [
            (base[0] + (cos * x - sin * y) / 100, base[1] + (sin * x + cos * y) / 100, base[2] + z / 100)
            for x, y, z in offsets_cm
        ]
