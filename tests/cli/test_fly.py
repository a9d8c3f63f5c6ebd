"""Flying a controller from a file: the drone lands even if the controller fails."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.fly import make, what_failed
from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from tests.support.commands import Run
from tests.support.processes import Process
from tests.support.recordings import recorded
from tests.support.scripted_proxy import flown, scripted

GOOD = """
import skyloop

class Good(skyloop.Controller):
    def on_feedback(self, feedback):
        self.drone.velocity(forward=0.2)
"""
RAISING = """
import skyloop

class Raising(skyloop.Controller):
    def on_feedback(self, feedback):
        self.drone.velocity(forward=0.2)
        self.helper(feedback.altitude_m)

    def helper(self, altitude):
        return altitude / 0
"""
LOOKING = """
import skyloop
from tests.support.recordings import recorded

class Looking(skyloop.Controller):
    frames = 0

    def on_frame(self, frame):
        assert frame.ndim == 3
        self.frames += 1
        if self.frames == 5:
            self.stop()
"""
Write = Callable[[str], str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def writer(text: str) -> str:
        path = tmp_path / "mine.py"
        path.write_text(text)
        return str(path)

    return writer


def landed(name: str = "alpha") -> bool:
    with skyloop.connect(name, access="observe") as drone:
        feedback = drone.feedback()
        return feedback.state is skyloop.FlightState.LANDED and feedback.owner is None


@pytest.mark.daily
@pytest.mark.process
def test_a_controller_flies_and_lands(run: Run, alpha: Process, write: Write) -> None:
    ended = run("fly", write(GOOD), "--drone", "alpha", "--seconds", "0.4")
    assert ended.code == 0, ended.err
    said = ended.err.splitlines()
    assert said[0] == "taking off with alpha"
    assert said[-1] == "landing"
    assert "feedback samples" in said[1]
    assert landed()


@pytest.mark.process
def test_a_controller_that_raises_is_landed_and_its_traceback_shown(run: Run, alpha: Process, write: Write) -> None:
    path = write(RAISING)
    ended = run("fly", path, "--drone", "alpha", "--seconds", "20")
    assert ended.code == 1
    assert f'File "{path}", line 7, in on_feedback' in ended.err
    assert f'File "{path}", line 10, in helper' in ended.err
    assert "ZeroDivisionError" in ended.err
    assert "skyloop/control" not in ended.err, "only the user's own lines"
    assert ended.err.splitlines()[-2:] == ["the controller failed", "landing"]
    assert landed()


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_lands(start: Callable[..., Process], alpha: Process, write: Write, number: signal.Signals) -> None:
    process = start("fly", write(GOOD), "--drone", "alpha")
    process.until("taking off")
    with skyloop.connect("alpha", access="observe") as drone:
        drone.wait("flying", timeout_s=30.0)
        process.signal(number)
        process.until("landing")
        assert process.wait() == 0
        assert drone.wait("landed", timeout_s=30.0)
    assert "Traceback" not in process.text


@pytest.mark.process
def test_ctrl_c_while_landing_leaves_it_to_the_proxy(
    start: Callable[..., Process], alpha: Process, write: Write
) -> None:
    with skyloop.connect("alpha", access="observe") as drone:
        process = start("fly", write(GOOD), "--drone", "alpha")
        drone.wait("flying", timeout_s=30.0)
        process.signal(signal.SIGINT)
        process.until("landing")
        process.signal(signal.SIGINT)
        assert process.wait() in (130, 0)  # 0: it had landed before the signal came
        drone.wait("landed", timeout_s=30.0)


@pytest.mark.process
def test_without_takeoff_the_controller_is_left_to_do_it(run: Run, alpha: Process, write: Write) -> None:
    path = write(GOOD.replace("self.drone.velocity(forward=0.2)", "assert feedback.state == 'landed'; self.stop()"))
    ended = run("fly", path, "--drone", "alpha", "--no-takeoff")
    assert ended.code == 0, ended.err
    assert "taking off" not in ended.err
    assert "landing" not in ended.err


@pytest.mark.process
def test_a_takeover_keeps_the_drone(start: Callable[..., Process], alpha: Process, write: Write) -> None:
    process = start(
        "fly", write(GOOD + "    def on_authority(self, status):\n        self.stop()\n"), "--drone", "alpha"
    )
    with skyloop.connect("alpha", access="observe") as drone:
        drone.wait("flying", timeout_s=30.0)
    with skyloop.connect("alpha", authority=skyloop.Authority(priority=1), name="other") as other:
        process.until("other took over: leaving the drone to it")
        assert process.wait() == 0
        assert "landing" not in process.text
        other.land()


@pytest.mark.process
def test_a_second_pilot_is_refused(run: Run, alpha: Process, write: Write) -> None:
    with skyloop.connect("alpha", name="the pilot"):
        ended = run("fly", write(GOOD), "--drone", "alpha", "--seconds", "1")
        assert ended.code == 1
        assert ended.err.startswith("skyloop: the pilot holds the authority over alpha: wait in the queue with --wait")
        assert len(ended.err.splitlines()) == 1
        assert run("fly", write(GOOD), "--drone", "alpha", "--wait", "0.05", "--seconds", "1").code == 1
        higher = run("fly", write(GOOD), "--drone", "alpha", "--priority", "3", "--seconds", "0.1")
        assert higher.code == 0, higher.err


@pytest.mark.process
def test_a_controller_of_frames_needs_a_camera(run: Run, alpha: Process, write: Write) -> None:
    ended = run("fly", write(LOOKING), "--drone", "alpha", "--no-takeoff")
    assert ended.code == 1
    assert ended.err.startswith("skyloop: this vehicle has no camera")
    assert "Traceback" not in ended.err


@pytest.mark.process
def test_a_recording_suffices_for_a_controller_that_only_watches(run: Run, write: Write) -> None:
    video = f"video://{recorded('ardrone2/video-8s.pave')}"
    ended = run("fly", write(LOOKING), "--drone", video, "--seconds", "20")
    assert ended.code == 0, ended.err
    assert "5 frames" in ended.err
    assert "taking off" not in ended.err
    flying = run("fly", write(GOOD), "--drone", video, "--seconds", "20")
    assert flying.code == 1
    assert "velocity is not possible" in flying.err
    assert "line 6, in on_feedback" in flying.err


@pytest.mark.process
@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("alfa", "no proxy named 'alfa'; did you mean 'alpha'?"),
        ("simm://", "no vehicle driver named 'simm'; did you mean 'sim'?"),
        ("sim://?sed=3", "no option of sim:// named 'sed'; did you mean 'seed'"),
        ("sim://?world=rom", "no world named 'rom'; did you mean 'room'?"),
        ("video://none.mp4", "none.mp4"),
    ],
)
def test_a_wrong_target_is_reported_in_one_line(
    run: Run, alpha: Process, write: Write, address: str, said: str
) -> None:
    ended = run("fly", write(GOOD), "--drone", address)
    assert ended.code == 2, ended.err
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_wrong_file_is_reported_before_connecting(run: Run, write: Write) -> None:
    assert run("fly", "none.py", "--drone", "nobody").err.startswith("skyloop: there is no file none.py")
    assert run("fly", write("x = 1"), "--drone", "nobody").code == 2
    assert "choose one with --class" in run("fly", write(GOOD + GOOD.replace("Good", "Better"))).err
    assert "did you mean 'Good'" in run("fly", write(GOOD), "--class", "Goof").err


class Stranger:
    """A stand-in for a drone: a controller only stores it."""


def test_a_controller_that_wants_more_than_a_drone_is_refused() -> None:
    class Wanting(skyloop.Controller):
        def __init__(self, drone: skyloop.Drone, gain: float) -> None:
            super().__init__(drone)

    with pytest.raises(UsageError, match=r"Wanting\(drone\).*'gain'.*default values"):
        make(Wanting, Stranger())  # type: ignore[arg-type]


def test_a_controller_that_forgets_its_base_is_refused() -> None:
    class Forgetful(skyloop.Controller):
        def __init__(self, drone: skyloop.Drone) -> None:
            pass

    with pytest.raises(UsageError, match=r"must begin with super\(\).__init__\(drone\)"):
        make(Forgetful, Stranger())  # type: ignore[arg-type]


def test_errors_outside_the_users_code_are_shown_in_one_line_or_in_full() -> None:
    with pytest.raises(UsageError) as refused:
        parse_uri("nonsense")
    refused.value.__traceback__ = refused.tb.tb_next
    assert what_failed(refused.value) == f"skyloop: {refused.value}"
    with pytest.raises(AttributeError) as broken:
        parse_uri(3)  # type: ignore[arg-type]
    broken.value.__traceback__ = broken.tb.tb_next
    assert "skyloop/drivers/uri.py" in what_failed(broken.value)


def test_chained_errors_are_both_shown_without_skyloops_lines() -> None:
    try:
        try:
            parse_uri("nonsense")
        except UsageError as error:
            raise RuntimeError("so it went") from error
    except RuntimeError as error:
        text = what_failed(error)
    assert "is not a vehicle's address" in text
    assert "RuntimeError: so it went" in text
    assert "skyloop/drivers" not in text


def test_errors_begin_with_the_line_in_the_users_code() -> None:
    """The user's line comes first, not a line of the library they called, or of the loop that called them."""

    def on_frame() -> object:
        return json.loads("{")

    try:
        on_frame()
    except ValueError as error:
        first, second, *rest = what_failed(error).splitlines()
    assert first.startswith("test_fly.py, line ")
    assert first.endswith('in on_frame: return json.loads("{")')
    assert second.startswith("  json.decoder.JSONDecodeError: Expecting property name")
    assert "Traceback (most recent call last):" in rest


def test_a_misspelt_callback_is_reported_before_the_take_off(capsys: pytest.CaptureFixture[str]) -> None:
    class Mine(skyloop.Controller):
        def onframe(self, frame: skyloop.Frame) -> None: ...

    with scripted() as proxy, flown(proxy) as drone:
        make(Mine, drone)
    assert capsys.readouterr().err == "note: Mine.onframe is never called: did you mean on_frame?\n"
