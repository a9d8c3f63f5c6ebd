"""The flight in the driver suite: take-off, both directions along each axis, and landing, checked by feedback."""

from __future__ import annotations

import math
import time
import unittest
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import PLAUSIBLE, RecordingSink
from skyloop.messages import Attitude, Feedback, FlightState, Hover, Land, Position, Takeoff, Velocity
from skyloop.messages.feedback import WAKING_UP
from skyloop.messages.geometry import wrap_angle

if TYPE_CHECKING:
    from skyloop.drivers.suite import DriverSuite

NEAR_RAD = 0.3  #: tolerance for the commanded heading [rad]
#: Returns how far the vehicle moved between two samples, with its sign; None if the vehicle does not report it.
Measure = Callable[[Feedback, Feedback], float | None]


class Flight:
    """One flight in the suite, with the vehicle's own take-off and landing if it has them, otherwise by set-points.

    Speeds, distances and time-outs are the suite's. Whatever does not happen in time raises ``AssertionError``.
    """

    def __init__(self, suite: DriverSuite, driver: Driver, sink: RecordingSink) -> None:
        """Begin with an open driver whose link is up; skip the test if it supports no set-points."""
        self.suite = suite
        self.driver = driver
        self.sink = sink
        self.actions = driver.capabilities().actions
        if not self.actions & {"velocity", "attitude"}:
            raise unittest.SkipTest("the vehicle supports no set-points")
        suite.wait_for_feedback(sink)

    def until(self, condition: Callable[[Feedback], bool], timeout_s: float, what: str) -> Feedback:
        """Wait until the newest feedback meets a condition, and return it; the error says "not ``what`` within"."""
        sink = self.sink

        def holds() -> bool:
            return sink.newest is not None and condition(sink.newest)

        assert sink.wait(holds, timeout_s), f"not {what} within {timeout_s} s; newest feedback: {_summary(sink.newest)}"
        assert sink.newest is not None
        return sink.newest

    def wake(self) -> None:
        """Wait until the vehicle has started up, if its link reports that it is starting."""
        links, timeout_s = self.sink.links, self.suite.takeoff_timeout_s
        assert self.sink.wait(lambda: not links[-1][1].startswith(WAKING_UP), timeout_s), links[-1]

    def take_off(self) -> None:
        """Take off and wait until the vehicle hovers or flies; without a native take-off, climb to 0.6 m."""
        if "takeoff" in self.actions:
            self.wake()
            self.driver.apply(Takeoff())
            settled = (FlightState.HOVERING, FlightState.FLYING)
            self.until(lambda f: f.state in settled, self.suite.takeoff_timeout_s, "hovering after take-off")
            return
        self.driver.check(Takeoff())  # as the proxy does before it climbs
        self.set_point(up=self.suite.climb)
        self.until(lambda f: f.altitude_m is None or f.altitude_m > 0.6, self.suite.takeoff_timeout_s, "0.6 m high")
        self.set_point()

    def land(self) -> None:
        """Land and wait; a vehicle without its own landing descends until it is landed or below 0.1 m."""
        if "land" in self.actions:
            self.driver.apply(Land())
            self.until(lambda f: f.state is FlightState.LANDED, self.suite.land_timeout_s, "landed")
            return
        self.set_point(up=-self.suite.climb)
        low = FlightState.LANDED
        self.until(
            lambda f: f.state is low or (f.altitude_m is not None and f.altitude_m < 0.1),
            self.suite.land_timeout_s,
            "down",
        )

    def set_point(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, turn: float = 0.0) -> None:
        """Apply a velocity [m/s, rad/s] in body axes if the vehicle supports it, otherwise an attitude that goes there.

        Of ``forward`` and ``left``, only the sign counts for an attitude, whose angle is the suite's ``tilt``. It is
        sent only once, because the driver must keep it in force.
        """
        if "velocity" in self.actions:
            self.driver.apply(Velocity(forward=forward, left=left, up=up, yaw_rate=turn))
            return
        tilt = self.suite.tilt
        pitch, roll = math.copysign(tilt, forward) * bool(forward), -math.copysign(tilt, left) * bool(left)
        self.driver.apply(Attitude(roll=roll, pitch=pitch, climb=up, yaw_rate=turn))

    def moves_along_axes(self) -> None:
        """Move in both directions along each axis, which is needed to check the sign."""
        suite = self.suite
        for sign in (1.0, -1.0):
            self._goes("up", _height, sign * suite.distance, up=sign * suite.climb)
            self._goes("yaw", _turned, sign * suite.turn, turn=sign * suite.yaw_rate)
            self._goes("forward", partial(_along, axis=0), sign * suite.distance, forward=sign * suite.speed)
            self._goes("left", partial(_along, axis=1), sign * suite.distance, left=sign * suite.speed)

    def goes_to_places(self) -> None:
        """Fly to a position to the side and above, turn, and fly back."""
        suite, start = self.suite, self.sink.newest
        assert start is not None
        assert start.position_m is not None, "a vehicle that supports positions must report its own"
        x, y, z = start.position_m
        turn = 0.0 if start.yaw_rad is None else start.yaw_rad + suite.turn
        away = Position(x + suite.distance, y - suite.distance, z + suite.distance, turn, speed=suite.speed)
        for place in (away, Position(x, y, z, speed=suite.speed)):
            self.driver.apply(place)

            def is_there(feedback: Feedback, place: Position = place) -> bool:
                near = feedback.position_m is not None and math.dist(feedback.position_m, place.place) <= suite.near
                turned = feedback.yaw_rad is None or abs(wrap_angle(turn - feedback.yaw_rad)) <= NEAR_RAD
                return near and turned  # if no yaw is given, the vehicle keeps its heading

            self.until(is_there, suite.motion_timeout_s, f"at {place}")

    def _goes(self, axis: str, measure: Measure, goal: float, **set_point: float) -> None:
        """Command, wait until the vehicle has passed the goal, then stop."""
        start = self.sink.newest
        assert start is not None
        if measure(start, start) is None:
            return  # the vehicle does not report what is measured for this axis
        self.set_point(**set_point)

        def far_enough(feedback: Feedback) -> bool:
            gone = measure(start, feedback)
            return gone is not None and gone * math.copysign(1.0, goal) >= abs(goal)

        self.until(far_enough, self.suite.motion_timeout_s, f"{goal:+g} along {axis} from {_summary(start)}")
        self.set_point()
        self._settle()

    def _settle(self) -> None:
        """Wait until the vehicle is slow again, if it reports its speed, because after an attitude it coasts."""
        brake = "hover" in self.actions
        if brake:
            self.driver.apply(Hover())
        self.sink.wait(lambda: _speed(self.sink.newest) < 0.25, 2.0 if brake else 0.3)


def _summary(feedback: Feedback | None) -> str:
    """Return the fields that a driver filled in, and their age, for an error message."""
    if feedback is None:
        return "none"
    age_s = (time.monotonic_ns() - feedback.captured_ns) / 1e9
    values = {name: getattr(feedback, name) for name in (*PLAUSIBLE, "native")}
    told = [f"{name} {value}" for name, value in values.items() if value is not None]
    return ", ".join([f"state {feedback.state.name}", f"{age_s:.2f} s old", *told])


def _height(start: Feedback, now: Feedback) -> float | None:
    if start.altitude_m is not None and now.altitude_m is not None:
        return now.altitude_m - start.altitude_m
    return _speed_sign(now, 2)


def _turned(start: Feedback, now: Feedback) -> float | None:
    if start.yaw_rad is None or now.yaw_rad is None:
        return None
    return wrap_angle(now.yaw_rad - start.yaw_rad)


def _along(start: Feedback, now: Feedback, axis: int) -> float | None:
    """Return the distance along the heading (axis 0) or to its left (1) [m]; the speed if the position is unknown."""
    if start.position_m is None or now.position_m is None or start.yaw_rad is None:
        return _speed_sign(now, axis)
    east, north = now.position_m[0] - start.position_m[0], now.position_m[1] - start.position_m[1]
    heading = start.yaw_rad + axis * math.pi / 2
    return east * math.cos(heading) + north * math.sin(heading)


def _speed_sign(now: Feedback, axis: int) -> float | None:
    return None if now.velocity_m_s is None else now.velocity_m_s[axis]


def _speed(feedback: Feedback | None) -> float:
    if feedback is None or feedback.velocity_m_s is None:
        return math.inf
    return math.hypot(*feedback.velocity_m_s)
