"""Fly a square and follow a marker with real firmware in the simulated world, and compare with the truth.

``SKYLOOP_ARDUCOPTER=… python -m benchmarks.autopilots ardupilot`` prints the figures of ``docs/autopilots.md``.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlencode

import msgspec

import skyloop
from skyloop.cli.demo import MARKER_ID
from skyloop.control.follow import FollowMarker
from skyloop.errors import NoAnswerError, RefusedError
from skyloop.messages import Feedback, FlightState
from skyloop.messages.geometry import wrap_angle

KINDS: Final = ("ardupilot", "betaflight", "px4")
READY_S: Final = 120.0
TAKEOFF_S: Final = 40.0
SIDE_M: Final = 1.6
_H: Final = SIDE_M / 2
SQUARE: Final = ((_H, _H), (-_H, _H), (-_H, -_H), (_H, -_H))
HEIGHT_M: Final = 1.5
MINUTE_S: Final = 60.0
FOLLOW_S: Final = 30.0


class Spread(msgspec.Struct, frozen=True):
    """Errors: their root mean square, and the largest."""

    rms: float
    most: float

    @staticmethod
    def of(errors: list[float]) -> Spread:
        """Return the spread of these errors."""
        return Spread(math.sqrt(sum(e * e for e in errors) / len(errors)), max(map(abs, errors)))


class AgreementRow(msgspec.Struct, frozen=True):
    """The firmware's own state compared with the truth during a time in the air."""

    seconds: float
    samples: int
    roll_deg: Spread
    pitch_deg: Spread
    yaw_deg: Spread
    position_m: Spread | None  #: distance; None if no position was reported
    position_wander_m: Spread | None  #: the same without its mean, the GPS error during the flight


class FlightRow(msgspec.Struct, frozen=True):
    """One run. Times from connecting [s]."""

    autopilot: str
    ready_s: float  #: time until it took off
    corners: int  #: number of corners reached
    agreement: AgreementRow
    marker_frames: int
    marker_in_view: float | None
    collisions: int


@dataclass
class Agreement:
    """Compares each sample with the simultaneous truth. ``angles``: roll, pitch, yaw [rad]."""

    angles: list[tuple[float, float, float]] = field(default_factory=list)
    errors_m: list[tuple[float, ...]] = field(default_factory=list)
    begun_ns: int = 0
    ended_ns: int = 0

    def look(self, feedback: Feedback) -> None:
        """Record a sample."""
        native = feedback.native or {}
        true = [native.get(f"truth.{name}") for name in ("roll", "pitch", "yaw", "x", "y", "z")]
        said = (feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad)
        if None in said or None in true:
            return
        roll, pitch, yaw = (wrap_angle(float(a or 0.0) - float(str(b))) for a, b in zip(said, true, strict=False))
        self.angles.append((roll, pitch, yaw))
        if feedback.position_m is not None:
            self.errors_m.append(tuple(a - float(str(b)) for a, b in zip(feedback.position_m, true[3:], strict=True)))
        self.begun_ns = self.begun_ns or feedback.captured_ns
        self.ended_ns = feedback.captured_ns

    def row(self) -> AgreementRow:
        """Return the figures."""
        degrees = [[math.degrees(one) for one in column] for column in zip(*self.angles, strict=True)]
        means = [sum(column) / len(self.errors_m) for column in zip(*self.errors_m, strict=True)]
        return AgreementRow(
            seconds=(self.ended_ns - self.begun_ns) / 1e9,
            samples=len(self.angles),
            roll_deg=Spread.of(degrees[0]),
            pitch_deg=Spread.of(degrees[1]),
            yaw_deg=Spread.of(degrees[2]),
            position_m=Spread.of([math.hypot(*error) for error in self.errors_m]) if means else None,
            position_wander_m=Spread.of([math.dist(error, means) for error in self.errors_m]) if means else None,
        )


def address(autopilot: str, **options: str) -> str:
    """Return the address of a drone flown by this firmware."""
    return "sim://?" + urlencode({"autopilot": autopilot, **options}, safe="/,")


@contextmanager
def compared(drone: skyloop.Drone) -> Iterator[Agreement]:
    """Compare the drone's state with the truth during the block."""
    agreement = Agreement()
    listener = drone.on_feedback(agreement.look, inline=True)
    try:
        yield agreement
    finally:
        listener.cancel()


def take_off(drone: skyloop.Drone, ready_s: float = READY_S) -> float:
    """Take off as soon as the firmware can be armed.

    Returns:
        The time until then [s].

    Raises:
        SkyloopError: The firmware could not be armed, or did not take off.
    """
    begun_s = time.monotonic()
    while True:
        try:
            drone.takeoff(timeout_s=TAKEOFF_S)
        except (NoAnswerError, RefusedError):
            if time.monotonic() - begun_s > ready_s or drone.feedback().state.airborne:
                raise
            time.sleep(1.0)
        else:
            return time.monotonic() - begun_s


def wait_ready(drone: skyloop.Drone, ready_s: float = READY_S) -> None:
    """Wait until an autopilot is connected and, if it reports that (MAVLink), can be armed."""
    until_s = time.monotonic() + ready_s
    while time.monotonic() < until_s:
        feedback = drone.feedback()
        native = feedback.native or {}
        heard = feedback.state is not FlightState.UNKNOWN
        if native.get("mavlink.ready", heard and not any(name.startswith("mavlink.") for name in native)):
            return
        time.sleep(0.2)


def fly_square(drone: skyloop.Drone, seconds: float, least_corners: int = 0) -> int:
    """Fly the square repeatedly, for this time and at least this many corners; return the corners reached."""
    until_s, corners = time.monotonic() + seconds, 0
    while time.monotonic() < until_s or corners < least_corners:
        x, y = SQUARE[corners % len(SQUARE)]
        try:
            drone.go_to(x=x, y=y, z=HEIGHT_M, speed=0.8, timeout_s=30.0, tolerance_m=0.3)
        except RefusedError:  # the computer was busy and the drone hovered meanwhile: fly on
            time.sleep(0.5)
        else:
            corners += 1
    return corners


def follow(drone: skyloop.Drone, seconds: float) -> FollowMarker:
    """Follow the demo's marker with the demo's controller."""
    follower = FollowMarker(drone, MARKER_ID)
    follower.run(seconds=seconds)
    return follower


def fly(autopilot: str, square_s: float, follow_s: float, say: Callable[[str], object], **options: str) -> FlightRow:
    """Fly everything in one flight.

    Raises:
        SkyloopError: The firmware could not be started, did not take off, or did not reach a corner.
    """
    begun_s = time.monotonic()
    with skyloop.connect(address(autopilot, **options), timeout_s=30.0) as drone:
        drone.on_event(lambda event: say(f"{time.monotonic() - begun_s:6.1f} s  {event.text[:160]}"))
        wait_ready(drone)
        say(f"ready after {time.monotonic() - begun_s:.1f} s")
        take_off(drone)
        ready_s = time.monotonic() - begun_s
        say(f"in the air after {ready_s:.1f} s")
        with compared(drone) as agreement:
            corners = fly_square(drone, square_s)
        say(f"{corners} corners")
        follower = follow(drone, follow_s) if follow_s else None
        row = FlightRow(
            autopilot=autopilot,
            ready_s=ready_s,
            corners=corners,
            agreement=agreement.row(),
            marker_frames=0 if follower is None else follower.score.frames,
            marker_in_view=None if follower is None else follower.score.share_in_view,
            collisions=sum(event.kind == "collision" for event in drone.recent_events()),
        )
        with suppress(RefusedError, NoAnswerError):  # the failsafe lands it
            drone.land(timeout_s=60.0)
        return row


def main() -> None:
    """Fly, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("autopilot", choices=KINDS)
    parser.add_argument("--square", type=float, default=MINUTE_S, metavar="S", help="flying the square [60]")
    parser.add_argument("--follow", type=float, default=FOLLOW_S, metavar="S", help="following the marker [30]")
    parser.add_argument("--option", action="append", default=[], metavar="KEY=VALUE", help="further options of sim://")
    given = parser.parse_args()
    options = dict(option.split("=", 1) for option in given.option)
    row = fly(given.autopilot, given.square, given.follow, lambda text: print(text, flush=True), **options)
    print(msgspec.json.format(msgspec.json.encode(row)).decode())


if __name__ == "__main__":
    main()
