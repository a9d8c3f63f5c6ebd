"""Test the contract of :mod:`skyloop.drivers.base`: subclass these tests, name the vehicle, and run pytest.

::

    from skyloop.drivers.suite import DriverSuite

    class TestMyDriver(DriverSuite):
        uri = "mydrone://127.0.0.1?port=5556"

The vehicle at that address must answer and, if it can fly, be on the ground with free space around it: the suite takes
off, moves about a metre along each axis, turns, and lands. **Never run it with a real vehicle unless it is tied down or
in a net.** A vehicle that can't fly receives no commands.

Tests of features that the vehicle lacks are skipped. The module does not import pytest.
"""

from __future__ import annotations

import gc
import math
import re
import statistics
import sys
import threading
import time
import unittest
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import ClassVar, Final

from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import PLAUSIBLE, RecordingSink, another_value, implausible, mismatch, same
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import DriverError, ParameterError, UnknownNameError, UsageError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Attitude,
    EmergencyStop,
    Encoding,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Parameter,
    Position,
    ResetEmergency,
    Takeoff,
    Value,
    Velocity,
)
from skyloop.messages.feedback import WAKING_UP
from skyloop.messages.geometry import wrap_angle

__all__ = ["DriverSuite", "RecordingSink"]

APPLY_S: Final = 0.05  #: maximum median time that a call of ``apply`` may take [s]
NEAR_RAD: Final = 0.3  #: tolerance for the commanded heading [rad]
#: Returns the signed distance that the vehicle moved between two samples; None if the vehicle does not report it.
Measure = Callable[[Feedback, Feedback], float | None]
_PARAMETER_NAME: Final = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)*\Z")


class DriverSuite:
    """Base class for the tests of a driver. Set :attr:`uri` or override :meth:`make`; everything else has a default.

    For a vehicle that is slower or moves less, override the class attributes below. To test link loss, override
    :meth:`vehicle_disappears` and :meth:`vehicle_appears`. To give each test its own fake vehicle, start it in a
    fixture and override :meth:`new_driver`.
    """

    uri: ClassVar[str] = ""  #: address of the vehicle to use

    connect_timeout_s: ClassVar[float] = 5.0  #: time limit for the link to come up [s]; the next values are limits, too
    feedback_timeout_s: ClassVar[float] = 2.0
    frame_timeout_s: ClassVar[float] = 5.0
    takeoff_timeout_s: ClassVar[float] = 15.0
    land_timeout_s: ClassVar[float] = 20.0
    motion_timeout_s: ClassVar[float] = 6.0
    emergency_timeout_s: ClassVar[float] = 3.0
    lost_timeout_s: ClassVar[float] = 5.0
    close_grace_s: ClassVar[float] = 2.0  #: time for joined threads to disappear from the system's tables [s]

    speed: ClassVar[float] = 0.4  #: commanded speed forward, backward, left and right [m/s]
    climb: ClassVar[float] = 0.4  #: commanded speed up and down [m/s]
    tilt: ClassVar[float] = 0.08  #: commanded roll and pitch for a vehicle that doesn't support velocities [rad]
    yaw_rate: ClassVar[float] = 0.6  #: commanded yaw rate [rad/s]
    distance: ClassVar[float] = 0.15  #: minimum movement in each direction within ``motion_timeout_s`` [m]
    turn: ClassVar[float] = 0.2  #: minimum turn of the vehicle [rad]
    near: ClassVar[float] = 0.15  #: maximum distance from a commanded position on arrival [m]
    stand_s: ClassVar[float] = 2.0  #: how long the suite watches a vehicle that must not start its motors [s]
    feedback_age_s: ClassVar[float] = 0.5  #: maximum age of a sample on arrival [s]
    frame_age_s: ClassVar[float] = 1.0  #: maximum age of a frame on arrival [s]
    untouched_parameters: ClassVar[frozenset[str]] = frozenset()  #: names of parameters that the suite must not write

    # To be implemented or overridden by a driver's test ------------------------------------------------------

    def make(self, uri: VehicleUri) -> Driver:
        """Return a new, unopened driver; by default, of the class that the entry point for the URI's scheme names.

        The address may include an option that the driver must refuse.
        """
        return make_driver(uri)

    def vehicle_disappears(self) -> None:
        """Make the vehicle of the open driver disappear: switch off its radio, or stop its emulator."""
        raise unittest.SkipTest("this suite does not know how to make the vehicle disappear")

    def vehicle_appears(self) -> None:
        """Make the vehicle reachable again."""
        raise unittest.SkipTest("this suite does not know how to make the vehicle appear")

    # Helpers -------------------------------------------------------------------------------------------------------

    def new_driver(self) -> Driver:
        """Return a new, unopened driver for :attr:`uri`."""
        return self.make(parse_uri(self.uri))

    @contextmanager
    def opened(self, *, watch: set[str] | None = None, record: bool = False) -> Iterator[tuple[Driver, RecordingSink]]:
        """Open a driver with a checking sink, wait until its link is up, and close the driver at the end.

        ``watch`` and ``record`` are those of :class:`RecordingSink`. Fails if the link is not up within
        :attr:`connect_timeout_s`, or if the driver breaks the contract of :class:`skyloop.drivers.base.Sink`.
        """
        driver, sink = self.new_driver(), RecordingSink(watch=watch, record=record)
        driver.open(sink)
        try:
            up = sink.wait(lambda: sink.link_state is LinkState.UP, self.connect_timeout_s)
            assert up, f"the link was not reported UP within {self.connect_timeout_s} s; reported: {sink.links}"
            yield driver, sink
        finally:
            driver.close()
        assert not sink.problems, "; ".join(sink.problems[:5])

    # Before opening ------------------------------------------------------------------------------------------------

    def test_constructor_does_no_io(self) -> None:
        """The constructor starts no threads and opens no descriptors; close() without open() does nothing."""
        self.new_driver()  # fill the import caches first, because they don't belong to the driver
        before = _resources()
        drivers = [self.new_driver() for _ in range(3)]
        assert _resources() == before, "a constructor started a thread or opened a descriptor"
        for driver in drivers:
            driver.close()  # close() without open() does nothing

    def test_capabilities_before_open(self) -> None:
        """Capabilities are known before open() and are valid."""
        capabilities = self.new_driver().capabilities()
        assert capabilities.vehicle, "capabilities need the vehicle's family name"
        unknown = capabilities.actions - set(ACTION_NAMES.values())
        assert not unknown, f"actions {sorted(unknown)} are not in {sorted(ACTION_NAMES.values())}"
        if not capabilities.actions:
            assert capabilities.why_not, "a vehicle without actions must give a reason in why_not"
        names = [camera.name for camera in capabilities.cameras]
        assert len(names) == len(set(names)), f"two cameras have the same name: {names}"
        for camera in capabilities.cameras:
            assert camera.fps > 0, f"{camera.name}: fps must be positive"
            assert camera.width > 0, f"{camera.name}: width must be positive"
            assert camera.height > 0, f"{camera.name}: height must be positive"
            if camera.rotation is not None:
                _check_rotation(camera.name, camera.rotation)

    def test_unknown_option_is_refused(self) -> None:
        """The constructor refuses an unknown option and names it."""
        good = parse_uri(self.uri)
        options = {name: good.reveal(name) or "" for name in good.options} | {"no_such_option_at_all": "1"}
        try:
            self.make(VehicleUri(good.scheme, good.reveal_place(), options))
        except UsageError as error:
            reported = str(error)
        else:
            raise AssertionError("an unknown option must raise UsageError in the constructor")
        assert "no_such_option_at_all" in reported, f"the error must name the option: {reported}"

    # Life cycle ----------------------------------------------------------------------------------------------------

    def test_close_is_idempotent_and_final(self) -> None:
        """A second close() does nothing, and the sink is not called after the first close()."""
        with self.opened() as (driver, sink):
            sink.wait(lambda: sink.feedback_count > 0, self.feedback_timeout_s)
            driver.close()
            calls = sink.calls
            driver.close()
            time.sleep(0.2)
            assert sink.calls == calls, "the driver called its sink after close()"

    def test_open_twice_is_refused(self) -> None:
        """Opening an open driver raises UsageError."""
        with self.opened() as (driver, _):
            try:
                driver.open(RecordingSink())
            except UsageError:
                return
            raise AssertionError("opening an open driver must raise UsageError")

    def test_can_be_opened_again(self) -> None:
        """After close(), the driver can be opened again with another sink."""
        driver = self.new_driver()
        for _ in range(2):
            sink = RecordingSink()
            driver.open(sink)
            up = sink.wait(lambda s=sink: s.link_state is LinkState.UP, self.connect_timeout_s)  # type: ignore[misc]
            driver.close()
            assert up, f"the link was not reported UP; reported: {sink.links}"

    def test_gives_threads_and_descriptors_back(self) -> None:
        """Opening and closing leaves no threads or descriptors behind."""
        with self.opened() as (_, sink):  # libraries have now created the resources that they keep
            self.wait_for_feedback(sink)
        gc.collect()
        before = _resources()
        for _ in range(3):
            with self.opened() as (_, sink):
                self.wait_for_feedback(sink)
        gc.collect()
        end = time.monotonic() + self.close_grace_s
        while _exceeds(_resources(), before) and time.monotonic() < end:
            time.sleep(0.02)
        assert not _exceeds(_resources(), before), f"threads and descriptors: {before} before, {_resources()} after"

    # Reports -------------------------------------------------------------------------------------------------------

    def test_feedback(self) -> None:
        """Feedback arrives, is recent, has plausible values in SI units, and leaves the proxy's fields alone."""
        with self.opened() as (_, sink):
            arrived = sink.wait(lambda: sink.feedback_count >= 10, self.feedback_timeout_s + 5.0)
            assert arrived, f"{sink.feedback_count} samples of feedback in {self.feedback_timeout_s + 5.0} s"
            samples = list(sink.feedbacks)
            now_ns = time.monotonic_ns()
        for feedback in samples:
            problems = implausible(feedback)
            assert not problems, "; ".join(problems)
            assert FlightState(feedback.state) is feedback.state
            assert (feedback.seq, feedback.published_ns, feedback.lease) == (0, 0, 0), "these fields are the proxy's"
            assert feedback.owner is None, "the owner belongs to the proxy"
        age_s = (now_ns - samples[-1].captured_ns) / 1e9
        assert age_s <= self.feedback_age_s + 1.0, f"the newest feedback is {age_s:.2f} s old"

    def test_frames(self) -> None:
        """Frames arrive, are recent, and match the names and sizes of the announced cameras."""
        cameras = {camera.name: camera for camera in self.new_driver().capabilities().cameras}
        if not cameras:
            raise unittest.SkipTest("the vehicle has no camera")
        with self.opened() as (_, sink):
            some = sink.wait(lambda: sum(sink.frame_counts.values()) >= 5, self.frame_timeout_s)
            assert some, f"got frames of {dict(sink.frame_counts)} within {self.frame_timeout_s} s"
            frames = list(sink.frames)
        ages_s = []
        for frame in frames:
            camera = cameras.get(frame.camera)
            assert camera is not None, f"frames of camera {frame.camera!r}, which is not in capabilities()"
            assert frame.encoding in set(Encoding), f"{frame.encoding!r} is not an encoding"
            assert (frame.width, frame.height) == (camera.width, camera.height), (
                f"{frame.camera}: {frame.width}×{frame.height} arrived, not {camera.width}×{camera.height}"
            )
            ages_s.append((frame.arrived_ns - frame.captured_ns) / 1e9)
        assert statistics.median(ages_s) <= self.frame_age_s, f"frames are {statistics.median(ages_s):.2f} s old"

    def test_pictures_as_they_come(self) -> None:
        """Encoded frames arrive, and match the names and sizes of the announced cameras."""
        cameras = {camera.name: camera for camera in self.new_driver().capabilities().cameras if camera.stream}
        if not cameras:
            raise unittest.SkipTest("the vehicle has no camera with an encoded stream")
        with self.opened(watch=set(), record=True) as (_, sink):
            some = sink.wait(lambda: len(sink.pictures) >= 5, self.frame_timeout_s)
            assert some, f"{len(sink.pictures)} encoded frames arrived within {self.frame_timeout_s} s"
            pictures = list(sink.pictures)
        for picture in pictures:
            camera = cameras.get(picture.camera)
            assert camera is not None, f"encoded frames of camera {picture.camera!r}, which announces no stream"
            assert (picture.width, picture.height) == (camera.width, camera.height), (
                f"{picture.camera}: {picture.width}×{picture.height} arrived, not {camera.width}×{camera.height}"
            )

    def test_link_lost_and_found(self) -> None:
        """When the vehicle disappears, the link is reported as LOST, with a reason; when it returns, as UP."""
        with self.opened() as (_, sink):
            self.wait_for_feedback(sink)
            self.vehicle_disappears()
            try:
                lost = sink.wait(lambda: sink.link_state is LinkState.LOST, self.lost_timeout_s)
                assert lost, f"the link was not reported LOST; reported: {sink.links}"
                assert sink.links[-1][1], "LOST needs a reason"
            finally:
                self.vehicle_appears()
            found = sink.wait(lambda: sink.link_state is LinkState.UP, self.connect_timeout_s)
            assert found, f"the link was not reported UP again; reported: {sink.links}"

    # Commands ------------------------------------------------------------------------------------------------------

    def test_apply_returns_what_was_applied_at_once(self) -> None:
        """``apply`` returns a finite action within :data:`APPLY_S`.

        Runs on the ground with actions that do not take off; another test flies.
        """
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            actions = driver.capabilities().actions
            set_points: list[AnyAction] = [Attitude(climb=-0.1), Velocity(up=-0.1), Position(0.0, 0.0, 0.0)]
            harmless: list[AnyAction] = [Idle(), Land(), Hover(), *set_points]
            announced = [action for action in harmless if action.name in actions]
            if not announced:
                raise unittest.SkipTest("the vehicle supports no actions")
            for action in announced:
                times_s = []
                for _ in range(5):
                    begun = time.perf_counter()
                    applied = driver.apply(action)
                    times_s.append(time.perf_counter() - begun)
                    assert type(applied).__name__ in {type(known).__name__ for known in (*harmless, Takeoff())}
                    assert applied.finite, f"apply({action.name}) returned {applied}"
                # Use the median: on a busy machine, any single call may be delayed.
                middle_s = statistics.median(times_s)
                assert middle_s <= APPLY_S, f"apply({action.name}) took {middle_s * 1e3:.0f} ms"

    def test_a_repeat_keeps_what_is_in_force(self) -> None:
        """On the ground, a repeated action has the same effect as a new one if nobody else commands the vehicle."""
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            assert driver.left_to() == "", f"on the ground it is left to {driver.left_to()!r}"
            announced = [action for action in (Land(), Hover()) if action.name in driver.capabilities().actions]
            if not announced:
                raise unittest.SkipTest("the vehicle supports neither hover nor land")
            for action in announced:
                assert driver.apply(action, new=False) == driver.apply(action), f"a repeated {action.name} differs"
            assert driver.left_to() == ""

    def test_failsafe_never_raises(self) -> None:
        """``failsafe`` returns a bool before ``open``, while open, and after ``close``."""
        driver = self.new_driver()
        assert isinstance(driver.failsafe(Hover()), bool), "failsafe before open() must return a bool"
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            assert isinstance(driver.failsafe(Hover()), bool)
            assert isinstance(driver.failsafe(Land()), bool)
        assert isinstance(driver.failsafe(Land()), bool), "failsafe after close() must return a bool"

    # Parameters ----------------------------------------------------------------------------------------------------

    def test_parameters_are_well_formed(self) -> None:
        """Parameters have unique, dotted, lower-case names, and their values and defaults are within their limits."""
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            parameters = driver.parameters()
        names = [parameter.name for parameter in parameters]
        assert len(names) == len(set(names)), "two parameters have the same name"
        for parameter in parameters:
            assert _PARAMETER_NAME.match(parameter.name), f"{parameter.name!r} is not dotted lower case"
            for what in ("value", "default"):
                value = getattr(parameter, what)
                if value is not None:
                    problem = mismatch(parameter, value)
                    assert not problem, f"{parameter.name}: its {what} {value!r} {problem}"

    def test_parameters_round_trip(self) -> None:
        """A written value takes effect and is listed; the old value is restored afterwards."""
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            end = time.monotonic() + self.feedback_timeout_s
            while not (writable := self._writable(driver)):  # a driver may first have to request the parameters
                if time.monotonic() > end:
                    raise unittest.SkipTest(f"parameters() lists no writable one within {self.feedback_timeout_s} s")
                time.sleep(0.05)
            for parameter in writable:
                try:
                    for value in (another_value(parameter), parameter.value):
                        in_force = driver.set_parameter(parameter.name, value)
                        assert same(in_force, value), f"{parameter.name}: wrote {value!r}, {in_force!r} is in force"
                        reported = next(p.value for p in driver.parameters() if p.name == parameter.name)
                        assert same(reported, in_force), f"{parameter.name}: {in_force!r} in force, {reported!r} listed"
                finally:
                    driver.set_parameter(parameter.name, parameter.value)

    def _writable(self, driver: Driver) -> list[Parameter]:
        return [p for p in driver.parameters() if not p.read_only and p.name not in self.untouched_parameters]

    def test_bad_parameters_are_refused(self) -> None:
        """Writing an unknown or read-only parameter raises ParameterError or UnknownNameError."""
        with self.opened() as (driver, sink):
            self.wait_for_feedback(sink)
            read_only = [parameter for parameter in driver.parameters() if parameter.read_only]
            tries: list[tuple[str, Value]] = [("no.such.parameter", 1.0)]
            for name, value in tries + [(p.name, p.value) for p in read_only]:
                try:
                    driver.set_parameter(name, value)
                except (ParameterError, UnknownNameError):
                    continue
                raise AssertionError(f"writing {name} must raise ParameterError")

    # Flight --------------------------------------------------------------------------------------------------------

    def test_flight(self) -> None:
        """The vehicle takes off, moves in both directions along each axis with the correct signs, and lands.

        If the vehicle supports positions, it also flies to several positions.
        """
        with self.opened(watch=set()) as (driver, sink):
            flight = Flight(self, driver, sink)
            flight.take_off()
            try:
                flight.moves_along_axes()
                if "position" in driver.capabilities().actions:
                    flight.goes_to_places()
                if "hover" in driver.capabilities().actions:
                    driver.apply(Hover())
                    flight.until(
                        lambda f: f.state is FlightState.HOVERING, self.motion_timeout_s, "HOVERING after Hover"
                    )
            finally:
                flight.land()

    def test_a_landing_withdraws_a_takeoff(self) -> None:
        """After a take-off followed immediately by a landing, the vehicle is on the ground and stays there."""
        with self.opened(watch=set()) as (driver, sink):
            if not {"takeoff", "land"} <= driver.capabilities().actions:
                raise unittest.SkipTest("the vehicle has no native take-off and landing")
            flight = Flight(self, driver, sink)
            flight.wake()
            driver.apply(Takeoff())
            driver.apply(Land())
            self._stands(sink, "a take-off that a landing withdrew")

    def test_a_takeoff_is_not_kept_for_a_lost_vehicle(self) -> None:
        """A take-off requested while the link is lost does not start when the link returns."""
        with self.opened(watch=set()) as (driver, sink):
            if "takeoff" not in driver.capabilities().actions:
                raise unittest.SkipTest("the vehicle has no native take-off")
            Flight(self, driver, sink).wake()
            self.vehicle_disappears()
            try:
                lost = sink.wait(lambda: sink.link_state is LinkState.LOST, self.lost_timeout_s)
                assert lost, f"the link was not reported LOST; reported: {sink.links}"
                with suppress(DriverError):  # raising is the best response
                    driver.apply(Takeoff())
            finally:
                self.vehicle_appears()
            found = sink.wait(lambda: sink.link_state is LinkState.UP, self.connect_timeout_s)
            assert found, f"the link was not reported UP again; reported: {sink.links}"
            self._stands(sink, "a take-off from before the link was back", at_once=True)

    def _stands(self, sink: RecordingSink, what: str, *, at_once: bool = False) -> None:
        """Check that the vehicle stays on the ground for ``stand_s``; unless ``at_once``, first let it land."""
        if not at_once:
            time.sleep(1.0)  # time for telemetry to reflect the last command
            sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.LANDED, self.land_timeout_s)
        up = (FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING, FlightState.LANDING)
        flies = sink.wait(lambda: sink.newest is not None and sink.newest.state in up, self.stand_s)
        assert not flies, f"the motors turn after {what}: state {sink.newest and sink.newest.state}"

    def test_emergency_stop_and_reset(self) -> None:
        """On the ground, the driver reports an emergency stop, and only a reset ends it."""
        with self.opened(watch=set()) as (driver, sink):
            actions = driver.capabilities().actions
            if not {"emergency_stop", "reset_emergency"} <= actions:
                raise unittest.SkipTest("the vehicle has no emergency stop with reset")
            flight = Flight(self, driver, sink)
            driver.apply(EmergencyStop())
            flight.until(lambda f: f.state is FlightState.EMERGENCY, self.emergency_timeout_s, "in emergency")
            if "hover" in actions:
                with suppress(DriverError):  # the driver may refuse or ignore this
                    driver.apply(Hover())
                time.sleep(0.2)
                flight.until(lambda f: f.state is FlightState.EMERGENCY, 1.0, "still in emergency after hover")
            driver.apply(ResetEmergency())
            flight.until(lambda f: f.state is FlightState.LANDED, self.emergency_timeout_s, "landed after the reset")

    def wait_for_feedback(self, sink: RecordingSink) -> None:
        """Wait for the first feedback; fail if none arrives within :attr:`feedback_timeout_s`."""
        received = sink.wait(lambda: sink.feedback_count > 0, self.feedback_timeout_s)
        assert received, f"no feedback within {self.feedback_timeout_s} s of the link being up"


def _resources() -> tuple[int, int]:
    """Return how many threads and open descriptors this process has (0 descriptors if /proc does not exist)."""
    descriptors = Path("/proc/self/fd") if sys.platform == "linux" else Path("/dev/fd")
    count = len(list(descriptors.iterdir())) if descriptors.exists() else 0
    return threading.active_count(), count


def _exceeds(now: tuple[int, int], before: tuple[int, int]) -> bool:
    return now[0] > before[0] or now[1] > before[1]


def _check_rotation(name: str, rotation: tuple[float, ...]) -> None:
    rows = [rotation[0:3], rotation[3:6], rotation[6:9]]
    for i in range(3):
        for j in range(3):
            dot = sum(a * b for a, b in zip(rows[i], rows[j], strict=True))
            assert abs(dot - (i == j)) < 1e-6, f"{name}: its rotation is not a rotation matrix"


class Flight:
    """One flight of the suite. It uses the vehicle's own take-off and landing if they exist, and set-points otherwise.

    It uses the speeds, distances and time-outs of the suite. Raises ``AssertionError`` when a time-out passes.
    """

    def __init__(self, suite: DriverSuite, driver: Driver, sink: RecordingSink) -> None:
        """Prepare a flight with an open driver whose link is up; skip the test if the driver supports no set-points."""
        self.suite = suite
        self.driver = driver
        self.sink = sink
        self.actions = driver.capabilities().actions
        if not self.actions & {"velocity", "attitude"}:
            raise unittest.SkipTest("the vehicle supports no set-points")
        suite.wait_for_feedback(sink)

    def until(self, condition: Callable[[Feedback], bool], timeout_s: float, what: str) -> Feedback:
        """Wait until the newest feedback meets a condition, and return it; ``what`` names the condition in errors."""
        sink = self.sink

        def holds() -> bool:
            return sink.newest is not None and condition(sink.newest)

        assert sink.wait(holds, timeout_s), f"not {what} within {timeout_s} s; newest feedback: {_summary(sink.newest)}"
        assert sink.newest is not None
        return sink.newest

    def wake(self) -> None:
        """If the link reports that the vehicle is starting, wait until it has started."""
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
        self.driver.check(Takeoff())  # check this before climbing, as the proxy does
        self.set_point(up=self.suite.climb)
        self.until(lambda f: f.altitude_m is None or f.altitude_m > 0.6, self.suite.takeoff_timeout_s, "0.6 m high")
        self.set_point()

    def land(self) -> None:
        """Land and wait; without a landing command, the vehicle descends until it is landed or below 0.1 m."""
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
        """Apply a velocity [m/s, rad/s] in body axes or, if the vehicle does not support it, a matching attitude.

        For an attitude, whose angle is the suite's ``tilt``, only the signs of ``forward`` and ``left`` matter. The
        command is sent only once, because the driver must keep applying it.
        """
        if "velocity" in self.actions:
            self.driver.apply(Velocity(forward=forward, left=left, up=up, yaw_rate=turn))
            return
        tilt = self.suite.tilt
        pitch, roll = math.copysign(tilt, forward) * bool(forward), -math.copysign(tilt, left) * bool(left)
        self.driver.apply(Attitude(roll=roll, pitch=pitch, climb=up, yaw_rate=turn))

    def moves_along_axes(self) -> None:
        """Move in both directions along each axis to check the signs."""
        suite = self.suite
        for sign in (1.0, -1.0):
            self._goes("up", _height, sign * suite.distance, up=sign * suite.climb)
            self._goes("yaw", _turned, sign * suite.turn, turn=sign * suite.yaw_rate)
            self._goes("forward", partial(_along, axis=0), sign * suite.distance, forward=sign * suite.speed)
            self._goes("left", partial(_along, axis=1), sign * suite.distance, left=sign * suite.speed)

    def goes_to_places(self) -> None:
        """Fly to a position to the side and higher up, turn, and fly back."""
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
                return near and turned  # without a given yaw, the vehicle keeps its heading

            self.until(is_there, suite.motion_timeout_s, f"at {place}")

    def _goes(self, axis: str, measure: Measure, goal: float, **set_point: float) -> None:
        """Send a command, wait until the vehicle has passed the goal, and stop."""
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
        """Wait until a vehicle that reports its speed has slowed down, because it coasts after an attitude."""
        brake = "hover" in self.actions
        if brake:
            self.driver.apply(Hover())
        self.sink.wait(lambda: _speed(self.sink.newest) < 0.25, 2.0 if brake else 0.3)


def _summary(feedback: Feedback | None) -> str:
    """Return the fields that a driver filled in and the age of the feedback, for an error message."""
    if feedback is None:
        return "none"
    age_s = (time.monotonic_ns() - feedback.captured_ns) / 1e9
    values = {name: getattr(feedback, name) for name in (*PLAUSIBLE, "native")}
    known = [f"{name} {value}" for name, value in values.items() if value is not None]
    return ", ".join([f"state {feedback.state.name}", f"{age_s:.2f} s old", *known])


def _height(start: Feedback, now: Feedback) -> float | None:
    if start.altitude_m is not None and now.altitude_m is not None:
        return now.altitude_m - start.altitude_m
    return _speed_sign(now, 2)


def _turned(start: Feedback, now: Feedback) -> float | None:
    if start.yaw_rad is None or now.yaw_rad is None:
        return None
    return wrap_angle(now.yaw_rad - start.yaw_rad)


def _along(start: Feedback, now: Feedback, axis: int) -> float | None:
    """Return the distance [m] along the heading (axis 0) or to its left (1); without a position, return the speed."""
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
