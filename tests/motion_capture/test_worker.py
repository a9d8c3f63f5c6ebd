"""The process that listens to a system, and its replacement when it dies, without a system."""

from __future__ import annotations

import io
import itertools
import math
import sys
import threading
import types
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from skyloop.clock import monotonic_ns
from skyloop.errors import LinkError, MissingExtraError, UsageError
from skyloop.messages import FlightState
from skyloop.motion_capture import MotionCapture, TrackState, parse_system
from skyloop.motion_capture.capture import TrackEvent
from skyloop.motion_capture.source import MISSING, ChildSource, RawFrame, main, read
from skyloop.transport.testing import wait_until

SYSTEM = parse_system("vicon://192.0.2.1")


class Turn:
    x, y, z, w = 0.0, 0.0, 0.6, 0.8


class Body:
    position = (1.0, 2.0, 3.0)
    rotation = Turn()


def package(frames: int, error: Exception) -> types.ModuleType:
    """Stand in for the ``motioncapture`` package: yield ``frames`` frames, then fail."""

    class System:
        def __init__(self) -> None:
            self.left = frames

        def waitForNextFrame(self) -> None:  # noqa: N802  as the package names it
            self.left -= 1
            if self.left < 0:
                raise error

        rigidBodies = {"alpha_body": Body()}  # noqa: N815, RUF012

    made: list[tuple[str, dict[str, str]]] = []

    def connect(kind: str, settings: dict[str, str]) -> System:
        made.append((kind, settings))
        return System()

    module = types.ModuleType("motioncapture")
    module.connect = connect  # type: ignore[attr-defined]
    module.made = made  # type: ignore[attr-defined]
    return module


@pytest.mark.parametrize(("error", "code"), [(RuntimeError("gone"), 1), (BrokenPipeError(), 0)])
def test_frames_are_written_until_it_fails(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: Exception, code: int
) -> None:
    module: Any = package(2, error)
    monkeypatch.setitem(sys.modules, "motioncapture", module)
    written: list[bytes] = []
    monkeypatch.setattr("skyloop.motion_capture.source.open_output", lambda: Collect(written))
    assert main("vicon", msgspec.json.encode(SYSTEM.configuration).decode()) == code
    assert module.made == [("vicon", {"hostname": "192.0.2.1"})]
    stream = io.BytesIO(b"".join(written))
    first = read(stream)
    assert first is not None
    assert first.bodies == {"alpha_body": ((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))}
    assert read(stream) is not None
    assert read(stream) is None
    assert ("gone" in capfd.readouterr().err) is (code == 1)


class Collect(io.BytesIO):
    def __init__(self, written: list[bytes]) -> None:
        super().__init__()
        self._written = written

    def write(self, data: Any) -> int:
        self._written.append(bytes(data))
        return len(data)


def test_without_the_package_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "motioncapture", None)
    assert main("vicon", "{}") == MISSING


def source(code: str, taken: list[RawFrame], told: list[str]) -> ChildSource:
    """A source whose child runs this code."""
    return ChildSource(SYSTEM, taken.append, told.append, command=(sys.executable, "-c", code))


def test_a_missing_package_names_what_to_install() -> None:
    with pytest.raises(MissingExtraError, match="skyloop install mocap"):
        source("raise SystemExit(3)", [], []).start(20.0)


def test_a_childs_error_is_reported() -> None:
    told: list[str] = []
    failing = source("import sys; sys.exit('no such host')", [], told)
    with pytest.raises(LinkError, match="no frame within"):
        failing.start(1.0)
    assert failing.pid is not None
    assert any("no such host" in text for text in told)


def test_the_child_reports_only_why_it_ends() -> None:
    told: list[str] = []
    with pytest.raises((LinkError, MissingExtraError)):
        ChildSource(parse_system("qualisys://127.0.0.1"), lambda _: None, told.append).start(5.0)
    assert not any("Warning" in text for text in told)


def test_the_same_problem_is_reported_once() -> None:
    told: list[str] = []
    makers: list[tuple[Callable[[RawFrame], None], Callable[[str], None]]] = []

    def make(_system: Any, _names: Any, take: Any, trouble: Any) -> Any:
        makers.append((take, trouble))
        return types.SimpleNamespace(close=lambda: None)

    capture = MotionCapture(SYSTEM, {"alpha": "alpha_body"}, make)
    capture.on_event(lambda event: told.append(event.text), inline=True)
    take, trouble = makers[0]
    for text in ("refused", "refused", "no route", "refused"):
        trouble(text)
    take(RawFrame(1, {}))
    trouble("refused")
    assert told == ["refused", "no route", "refused", "refused"]


def opened(address: str) -> tuple[MotionCapture, Callable[[RawFrame], None]]:
    """Open a capture whose system is the test."""
    sources: list[Callable[[RawFrame], None]] = []

    def make(_system: Any, _names: Any, take: Any, _trouble: Any) -> Any:
        sources.append(take)
        return types.SimpleNamespace(start=lambda timeout_s: None, close=lambda: None)

    return MotionCapture(parse_system(address), {"alpha": "body"}, make)._open(), sources[0]


def test_poses_later_than_the_loss_timeout_are_accepted() -> None:
    """With latency=0.3 each pose was lost on arrival."""
    capture, take = opened("vicon://nowhere?latency=0.3")
    with capture:
        take(RawFrame(monotonic_ns(), {"body": ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))}))
        pose = capture.pose("alpha")
        assert pose is not None
        assert monotonic_ns() - pose.captured_ns >= 300_000_000
        wait_until(lambda: capture.pose("alpha") is None, "it is lost once none comes any more")


def test_its_own_callback_can_close_it() -> None:
    capture, take = opened("vicon://nowhere")
    closed = threading.Event()

    def on_event(event: TrackEvent) -> None:
        if event.state is TrackState.LOST:  # on the watching thread
            capture.close()
            closed.set()

    capture.on_event(on_event, inline=True)
    take(RawFrame(monotonic_ns(), {"body": ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))}))
    assert closed.wait(20.0)
    capture._watch.join(20.0)
    assert not capture._watch.is_alive()
    assert capture.state("alpha") is TrackState.ENDED


def test_a_child_that_sends_nonsense_is_replaced() -> None:
    told: list[str] = []
    taken: list[RawFrame] = []
    good = "from skyloop.motion_capture.source import *; write(sys.stdout.buffer, RawFrame(1, {}));"
    failing = source(good + "sys.stdout.buffer.write(b'\\xff' * 9); sys.stdout.flush()", taken, told)
    failing.start(20.0)
    wait_until(lambda: len(taken) >= 2, "a second child was started")
    failing.close()
    failing.close()
    assert any("bytes" in text for text in told)


def test_a_refused_recalibration_keeps_the_calibration_in_force() -> None:
    """The drone was touched meanwhile: its attitude must not stay wrong by 90 degrees."""
    turned = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))  # the body's axes, relative to the drone's
    sources: list[Callable[[RawFrame], None]] = []

    class Source:
        def start(self, timeout_s: float) -> None: ...
        def close(self) -> None: ...

    def make(_system: object, _names: object, take: Callable[[RawFrame], None], _trouble: object) -> Source:
        sources.append(take)
        return Source()

    standing = SimpleNamespace(state=FlightState.LANDED, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0)
    drone: Any = SimpleNamespace(name="alpha", feedback=lambda: standing)
    capture = MotionCapture(parse_system("vicon://nowhere"), {"alpha": "body"}, make)._open()

    def calibrate(spread_m: float) -> None:
        ended = threading.Event()

        def see() -> None:
            for number in itertools.count():
                place = ((number % 2) * spread_m + number % 3 * 1e-6, 0.0, 0.0)
                sources[0](RawFrame(monotonic_ns(), {"body": (place, turned)}))
                if ended.wait(0.005):
                    return

        thread = threading.Thread(target=see)
        thread.start()
        try:
            capture.calibrate(drone, seconds=0.3)
        finally:
            ended.set()
            thread.join()

    with capture:
        calibrate(0.0)
        with pytest.raises(UsageError, match="keep the drone still"):
            calibrate(0.1)
        sources[0](RawFrame(monotonic_ns(), {"body": ((0.5, 0.0, 0.0), turned)}))
        pose = capture.pose("alpha")
        assert pose is not None
        assert pose.yaw_rad == pytest.approx(0.0, abs=1e-6)
