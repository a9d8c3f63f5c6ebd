"""The suite must catch drivers that break the contract: each of these breaks one rule."""

from __future__ import annotations

import importlib.util
import math
import socket
import threading
import time
from pathlib import Path

import msgspec
import pytest

from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import AnyAction, Capabilities, Feedback, Hover, Land, LinkState, Takeoff, Value, Velocity

SOURCE = Path(__file__).parents[1] / "example_driver" / "skyloop_toy.py"


def _toy() -> type[Driver]:
    spec = importlib.util.spec_from_file_location("faulty_toy", SOURCE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: type[Driver] = module.ToyDriver
    return found


Toy = _toy()
KEPT: list[socket.socket] = []  # sockets of the leaking drivers


class Altered(Toy):  # type: ignore[misc, valid-type]
    """A toy whose feedback is altered."""

    def _open(self, sink: Sink) -> None:
        driver = self

        class Between(RecordingSink):
            def feedback(self, feedback: Feedback) -> None:
                sink.feedback(driver.alter(feedback))

            def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
                sink.link(state, reason, remedy)

        super()._open(Between())

    def alter(self, feedback: Feedback) -> Feedback:
        return feedback


class SocketInConstructor(Toy):  # type: ignore[misc, valid-type]
    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        KEPT.append(socket.socket())


class TakesAnyOption(Toy):  # type: ignore[misc, valid-type]
    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(VehicleUri(uri.scheme))


class UnknownAction(Toy):  # type: ignore[misc, valid-type]
    def capabilities(self) -> Capabilities:
        return Capabilities(vehicle="toy", actions=frozenset({"velocity", "loop_the_loop"}))


class NeverUp(Toy):  # type: ignore[misc, valid-type]
    def _open(self, sink: Sink) -> None:
        pass


class Degrees(Altered):
    def alter(self, feedback: Feedback) -> Feedback:
        return msgspec.structs.replace(feedback, yaw_rad=90.0)


class NotANumber(Altered):
    def alter(self, feedback: Feedback) -> Feedback:
        return msgspec.structs.replace(feedback, battery=math.nan)


class FromTheFuture(Altered):
    def alter(self, feedback: Feedback) -> Feedback:
        return msgspec.structs.replace(feedback, captured_ns=feedback.captured_ns + 10**9)


class LeftIsRight(Altered):
    """A world whose y axis points south."""

    def alter(self, feedback: Feedback) -> Feedback:
        assert feedback.position_m is not None
        x, y, z = feedback.position_m
        return msgspec.structs.replace(feedback, position_m=(x, -y, z))


class YawIsClockwise(Altered):
    def alter(self, feedback: Feedback) -> Feedback:
        assert feedback.yaw_rad is not None
        return msgspec.structs.replace(feedback, yaw_rad=-feedback.yaw_rad)


class DownIsUp(Toy):  # type: ignore[misc, valid-type]
    def _apply(self, action: AnyAction) -> AnyAction:
        if isinstance(action, Velocity):
            action = msgspec.structs.replace(action, up=-action.up)
        applied: AnyAction = super()._apply(action)
        return applied


class NeedsRepeats(Toy):  # type: ignore[misc, valid-type]
    """Forgets each command after a moment."""

    def _apply(self, action: AnyAction) -> AnyAction:
        applied: AnyAction = super()._apply(action)
        timer = threading.Timer(0.01, lambda: super(NeedsRepeats, self)._apply(Velocity()))
        timer.daemon = True
        timer.start()
        return applied


class Slow(Toy):  # type: ignore[misc, valid-type]
    def _apply(self, action: AnyAction) -> AnyAction:
        time.sleep(0.06)
        applied: AnyAction = super()._apply(action)
        return applied


class FailsafeRaises(Toy):  # type: ignore[misc, valid-type]
    def failsafe(self, action: Hover | Land) -> bool:
        raise ValueError("nothing works")


class Leaks(Toy):  # type: ignore[misc, valid-type]
    def _open(self, sink: Sink) -> None:
        KEPT.append(socket.socket())
        super()._open(sink)


class TalksAfterClose(Toy):  # type: ignore[misc, valid-type]
    def _close(self) -> None:
        sink: Sink = self.last_sink
        super()._close()
        timer = threading.Timer(0.05, lambda: sink.link(LinkState.UP))
        timer.daemon = True
        timer.start()

    def _open(self, sink: Sink) -> None:
        self.last_sink = sink
        super()._open(sink)


class IgnoresParameters(Toy):  # type: ignore[misc, valid-type]
    def set_parameter(self, name: str, value: Value) -> Value:
        return 1.0


class StartsLater(Toy):  # type: ignore[misc, valid-type]
    """Starts a take-off a moment after the request, whatever happened since."""

    sink: Sink  # sink of the open driver

    def capabilities(self) -> Capabilities:
        return Capabilities(vehicle="toy", actions=frozenset({"velocity", "takeoff", "land"}))

    def _open(self, sink: Sink) -> None:
        StartsLater.sink = sink
        super()._open(sink)

    def _apply(self, action: AnyAction) -> AnyAction:
        if isinstance(action, Takeoff):
            timer = threading.Timer(1.2, lambda: super(StartsLater, self)._apply(Velocity(up=0.5)))
            timer.daemon = True
            timer.start()
        elif isinstance(action, Velocity):
            super()._apply(action)
        return action


FAULTS: list[tuple[type[Driver], str, str]] = [
    (SocketInConstructor, "test_constructor_does_no_io", "opened a descriptor"),
    (TakesAnyOption, "test_unknown_option_is_refused", "must raise UsageError"),
    (UnknownAction, "test_capabilities_before_open", "loop_the_loop"),
    (NeverUp, "test_feedback", "not reported UP"),
    (Degrees, "test_feedback", "yaw_rad is 90, outside"),
    (NotANumber, "test_feedback", "must be finite"),
    (FromTheFuture, "test_feedback", "in the future"),
    (LeftIsRight, "test_flight", "along left"),
    (YawIsClockwise, "test_flight", "along yaw"),
    (DownIsUp, "test_flight", "0.6 m high"),
    (NeedsRepeats, "test_flight", "0.6 m high"),
    (Slow, "test_apply_returns_what_was_applied_at_once", "took 6"),
    (StartsLater, "test_a_landing_withdraws_a_takeoff", "motors turn"),
    (StartsLater, "test_a_takeoff_is_not_kept_for_a_lost_vehicle", "motors turn"),
    (FailsafeRaises, "test_failsafe_never_raises", "nothing works"),
    (Leaks, "test_gives_threads_and_descriptors_back", "threads and descriptors"),
    (TalksAfterClose, "test_close_is_idempotent_and_final", "after close"),
    (IgnoresParameters, "test_parameters_round_trip", "is in force"),
    (IgnoresParameters, "test_bad_parameters_are_refused", "must raise ParameterError"),
]


@pytest.mark.parametrize(("faulty", "test", "message"), FAULTS, ids=[f"{f.__name__}-{t}" for f, t, _ in FAULTS])
def test_a_fault_is_found(faulty: type[Driver], test: str, message: str) -> None:
    class Suite(DriverSuite):
        uri = "toy://?speed=2"
        speed = climb = 1.5
        yaw_rate = 2.0
        connect_timeout_s = close_grace_s = 0.3
        takeoff_timeout_s = land_timeout_s = motion_timeout_s = 0.6

        def make(self, uri: VehicleUri) -> Driver:
            return faulty(uri)

        def vehicle_disappears(self) -> None:
            StartsLater.sink.link(LinkState.LOST, "it is gone")

        def vehicle_appears(self) -> None:
            StartsLater.sink.link(LinkState.UP)

    with pytest.raises((AssertionError, ValueError), match=message):
        getattr(Suite(), test)()
    while KEPT:
        KEPT.pop().close()
