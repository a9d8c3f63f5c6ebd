"""``sim://``: its options, its cameras, its parameters, and several drones in one world."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import FileFormatError, ParameterError, UnknownNameError, UsageError
from skyloop.messages import (
    Attitude,
    EventKind,
    Feedback,
    FlightState,
    Hover,
    Idle,
    LinkState,
    Takeoff,
    Value,
    Velocity,
)
from skyloop.sim import load_world, options
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.sim.driver import SimDriver

CALM = "wind=0&noise=0&seed=1"


@contextmanager
def opened(driver: Driver | str, *, watch: set[str] | None = None) -> Iterator[tuple[SimDriver, RecordingSink]]:
    made = make_driver(driver) if isinstance(driver, str) else driver
    assert isinstance(made, SimDriver)
    sink = RecordingSink(watch=watch)
    made.open(sink)
    try:
        assert sink.wait(lambda: sink.feedback_count > 0, 5.0)
        yield made, sink
    finally:
        made.close()
    assert not sink.problems, sink.problems[:3]


def number(feedback: Feedback | None, name: str) -> float:
    assert feedback is not None
    assert feedback.native is not None
    value = feedback.native[name]
    assert isinstance(value, float)
    return value


def in_the_air(driver: SimDriver, sink: RecordingSink) -> None:
    assert driver.apply(Takeoff()) == Takeoff()
    assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.HOVERING, 10.0)


# Its address -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("sim://?wrld=room", "did you mean 'world'"),
        ("sim://room", "did you mean sim://[?]world=room"),
        ("sim://?cameras=front,botom", "no simulated camera named 'botom'; did you mean 'bottom'"),
        ("sim://?cameras=front,front", "names a camera twice"),
        ("sim://?speed=0", "option speed"),
        ("sim://?native=atitude", "no action named 'atitude'; did you mean 'attitude'"),
        ("sim://?native=hover", "contains no set-point"),
        ("sim://?native=velocity,takeoff", "takeoff and land go together"),
        ("sim://?quality=ultra", "quality of pictures"),
        ("sim://?vehicle=ardron", "simulated vehicle"),
        ("sim://?battery=2", "option battery"),
        ("sim://?width=3", "option width"),
    ],
)
def test_bad_options_are_refused(uri: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_driver(uri)


@pytest.mark.parametrize("firmware", ["ardupilot", "betaflight", "px4"])
def test_windows_runs_no_firmware(firmware: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.vehicles.sim.options.sys", SimpleNamespace(platform="win32"))
    with pytest.raises(UsageError, match=f"{firmware} does not run on Windows: remove autopilot="):
        make_driver(f"sim://?autopilot={firmware}")


@pytest.mark.parametrize(
    ("world", "error", "message"),
    [
        ("rom", UnknownNameError, "no world named 'rom'; did you mean 'room'"),
        ("/nowhere/at/all.toml", FileFormatError, "nowhere"),
    ],
)
def test_a_missing_world_is_reported_when_opened(world: str, error: type[Exception], message: str) -> None:
    driver = make_driver(f"sim://?world={world}")
    assert driver.capabilities().actions
    assert driver.parameters()
    with pytest.raises(error, match=message):
        driver.open(RecordingSink())


def test_cameras_have_the_requested_size() -> None:
    uri = "sim://?cameras=front&width=640&height=360&fps=15&latency=0.1&noise=2"
    front = make_driver(uri).capabilities().cameras[0]
    assert (front.name, front.width, front.height, front.fps) == ("front", 640, 360, 15)
    assert front.intrinsics is not None
    assert (front.intrinsics.fx, front.intrinsics.cx, front.intrinsics.cy) == (488, 319.5, 179.5)


def test_without_cameras_there_are_none() -> None:
    assert make_driver("sim://?cameras=none").capabilities().cameras == ()


def test_native_actions_can_be_fewer() -> None:
    actions = make_driver("sim://?native=attitude").capabilities().actions
    assert actions == {"attitude", "idle", "emergency_stop", "reset_emergency"}


# Time and pictures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [1, 5])
def test_it_keeps_time(speed: int) -> None:
    with opened(f"sim://?world=empty&cameras=none&speed={speed}") as (_, sink):
        assert sink.wait(lambda: sink.feedback_count >= 20, 5.0)
        first, last = sink.feedbacks[0], sink.feedbacks[-1]
    simulated_s = number(last, "sim.time_s") - number(first, "sim.time_s")
    assert simulated_s == pytest.approx(speed * (last.captured_ns - first.captured_ns) / 1e9, rel=1e-6)


def test_pictures_arrive_after_their_delay_and_at_their_rate() -> None:
    with opened("sim://?width=160&fps=20&latency=0.06&seed=2") as (_, sink):
        assert sink.wait(lambda: min(sink.frame_counts[name] for name in ("front", "bottom")) >= 12, 10.0)
        frames = [frame for frame in sink.frames if frame.camera == "front"][2:]
    late_s = [(frame.arrived_ns - frame.captured_ns) / 1e9 for frame in frames]
    assert min(late_s) >= 0.06
    assert np.median(late_s) < 0.09
    apart_s = np.diff([frame.captured_ns for frame in frames]) / 1e9
    assert np.median(apart_s) == pytest.approx(0.05, abs=0.01)
    assert all(frame.pixels.std() > 5 for frame in frames)
    assert frames[0].intrinsics == make_driver("sim://?width=160").capabilities().cameras[0].intrinsics


def test_nothing_is_rendered_without_viewers() -> None:
    with opened("sim://", watch={"bottom"}) as (_, sink):
        assert sink.wait(lambda: sink.frame_counts["bottom"] >= 3, 10.0)
    assert set(sink.frame_counts) == {"bottom"}


# Reports ---------------------------------------------------------------------------------------------------------


def test_feedback_includes_the_truth() -> None:
    with opened(f"sim://?cameras=none&speed=4&{CALM}") as (driver, sink):
        in_the_air(driver, sink)
        newest = sink.newest
    assert newest is not None
    assert newest.altitude_m == pytest.approx(number(newest, "truth.z"), abs=0.1)
    assert newest.position_m is not None
    assert newest.position_m[0] == number(newest, "truth.x")
    assert 1.5 < math.hypot(number(newest, "truth.target.x"), number(newest, "truth.target.y")) < 2.6
    assert abs(number(newest, "truth.target.yaw")) <= math.pi
    (board,) = load_world("room").targets
    assert number(newest, f"truth.{board.name}.x") == number(newest, "truth.target.x")


def test_without_truth_feedback_contains_only_the_drones_estimates() -> None:
    with opened("sim://?cameras=none&truth=0&position=none") as (_, sink):
        newest = sink.newest
    assert newest is not None
    assert newest.native is not None
    assert set(newest.native) == {"sim.time_s"}
    assert newest.position_m is None
    assert newest.velocity_m_s is not None


@pytest.mark.parametrize("value", ["none", "0"])
def test_a_vehicle_without_reported_velocity_still_flies_by_it(value: str) -> None:
    with opened(f"sim://?world=empty&cameras=none&speed=10&velocity={value}&{CALM}") as (driver, sink):
        in_the_air(driver, sink)
        driver.apply(Velocity(forward=1.0))
        assert sink.wait(lambda: sink.newest is not None and number(sink.newest, "truth.vx") > 0.8, 10.0)
        newest = sink.newest
    assert newest is not None
    assert newest.velocity_m_s is None


def test_a_bump_is_reported_and_a_crash_is_an_emergency() -> None:
    with opened(f"sim://?world=empty&cameras=none&speed=10&{CALM}") as (driver, sink):
        driver.set_parameter("limits.speed", 10.0)
        driver.set_parameter("limits.tilt", 0.6)
        in_the_air(driver, sink)
        driver.apply(Velocity(forward=9.0))
        assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.EMERGENCY, 10.0)
        kinds = {event.kind: event for event in sink.events}
        newest = sink.newest
    bump, crash = kinds[EventKind.COLLISION], kinds[EventKind.EMERGENCY]
    speed = bump.data["speed_m_s"]
    assert isinstance(speed, float)
    assert speed > 0
    assert crash.data["reason"] == crash.text
    assert newest is not None
    assert newest.native is not None
    assert newest.native["emergency_reason"] == crash.text


def test_a_flat_battery_does_not_take_off() -> None:
    with opened("sim://?cameras=none&battery=0.02") as (driver, sink):
        assert sink.wait(lambda: any(event.kind is EventKind.VEHICLE_MESSAGE for event in sink.events), 5.0)
        assert driver.apply(Takeoff()) == Idle()
        assert sink.newest is not None
        assert sink.newest.battery == pytest.approx(0.02, abs=0.002)


# Parameters ------------------------------------------------------------------------------------------------------


def test_without_its_radio_it_neither_receives_nor_sends() -> None:
    with opened(f"sim://?cameras=none&speed=4&{CALM}") as (driver, sink):
        in_the_air(driver, sink)
        driver.apply(Velocity(forward=0.5))
        assert driver.set_parameter("sim.link", False) is False
        assert sink.link_state is LinkState.LOST
        heard = sink.feedback_count
        driver.apply(Velocity(forward=1.0))
        assert driver.host is not None
        assert driver.host.simulation.state(0) is FlightState.HOVERING  # it holds its position without commands
        assert sink.feedback_count <= heard + 1
        driver.set_parameter("sim.link", True)
        assert str(sink.link_state) == LinkState.UP
        assert sink.wait(lambda: sink.feedback_count > heard + 3, 5.0)
        driver.apply(Hover())


def test_an_attitude_only_drone_also_holds_its_position_without_its_radio() -> None:
    with opened(f"sim://?world=empty&cameras=none&native=attitude&speed=4&{CALM}") as (driver, sink):
        with pytest.raises(UsageError, match="sim does not support hover"):
            driver.apply(Hover())
        driver.apply(Attitude(climb=0.5))
        assert sink.wait(lambda: sink.newest is not None and (sink.newest.altitude_m or 0.0) > 0.6, 10.0)
        driver.set_parameter("sim.link", False)
        driver.set_parameter("sim.link", True)
        told = sink.feedback_count
        assert sink.wait(lambda: sink.feedback_count > told + 5, 5.0)  # the old set-point is not resumed
        assert driver.host is not None
        assert driver.host.simulation.state(0) is FlightState.HOVERING


def test_the_battery_can_be_set() -> None:
    with opened("sim://?cameras=none") as (driver, sink):
        assert driver.set_parameter("sim.battery", 0.5) == 0.5
        assert sink.wait(lambda: sink.newest is not None and (sink.newest.battery or 1.0) < 0.51, 5.0)


def test_values_written_before_opening_apply() -> None:
    driver = make_driver("sim://?cameras=front")
    driver.set_parameter("limits.climb", 0.3)
    driver.set_parameter("sim.wind", (0.0, 1.0, 0.0))
    driver.set_parameter("camera.front.fps", 10.0)
    with opened(driver) as (opened_driver, _):
        assert opened_driver.host is not None
        assert opened_driver.host.simulation.limits(0).climb_m_s == 0.3
        assert opened_driver.host.wind.mean_m_s == (0.0, 1.0, 0.0)
        assert opened_driver.capabilities().cameras[0].fps == 10.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("limits.tilt", 9.0, "must be from 0.02 to 0.6"),
        ("limits.tilt", math.nan, "must be from 0.02 to 0.6"),
        ("limits.tilt", "much", "must consist of numbers"),
        ("limits.tilt", True, "must consist of numbers"),
        ("sim.wind", 3.0, "is three numbers"),
        ("sim.wind", (1.0, 2.0), "is three numbers"),
        ("sim.link", 1, "is a bool"),
    ],
)
def test_bad_values_are_refused(name: str, value: Value, message: str) -> None:
    driver = make_driver("sim://")
    with pytest.raises(ParameterError, match=message):
        driver.set_parameter(name, value)


# Several drones --------------------------------------------------------------------------------------------------


def riding(host: SimHost, drone: int) -> SimDriver:
    return SimDriver(VehicleUri("sim"), host=host, drone=drone)


def test_a_slow_computer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(options, "SLOW_NS", 200_000_000)
    host = SimHost(SimOptions(world="empty", cameras=(), speed=4.0, most_lag_s=0.02))
    monkeypatch.setattr(host.simulation, "step", lambda _: time.sleep(0.1))
    with opened(riding(host, 0)) as (_, heard):
        assert heard.wait(lambda: any(event.data.get("reason") == "simulation_slow" for event in heard.events), 10.0)
        text = next(event.text for event in heard.events if event.data.get("reason") == "simulation_slow")
        assert text.startswith("the computer is too slow for speed=4: the simulation runs at ")


def test_several_drones_fly_in_one_world() -> None:
    host = SimHost(SimOptions(cameras=(), speed=4.0, seed=3), drones=3)
    with opened(riding(host, 0)) as (one, heard_one), opened(riding(host, 2)) as (three, heard_three):
        assert one.host is three.host
        in_the_air(three, heard_three)
        assert heard_one.newest is not None
        assert heard_one.newest.state is FlightState.LANDED
        apart = [
            number(heard_one.newest, f"truth.{axis}") - number(heard_three.newest, f"truth.{axis}") for axis in "xy"
        ]
        assert math.hypot(*apart) > 0.5
        three.set_parameter("sim.wind", (0.5, 0.0, 0.0))
        assert next(p.value for p in one.parameters() if p.name == "sim.wind") == (0.5, 0.0, 0.0)
        one.close()
        calls, told = heard_one.calls, heard_three.feedback_count
        assert heard_three.wait(lambda: heard_three.feedback_count > told + 5, 5.0)
        assert heard_one.calls == calls
        with opened(riding(host, 0)) as (_, heard_again):  # and it can return
            assert heard_again.newest is not None


def test_one_drone_has_one_driver() -> None:
    host = SimHost(SimOptions(cameras=()), drones=1)
    with opened(riding(host, 0)) as (_, heard):
        with pytest.raises(UsageError, match="is already taken"):
            riding(host, 0).open(RecordingSink())
        told = heard.feedback_count
        assert heard.wait(lambda: heard.feedback_count > told + 2, 5.0)  # the first one is not disturbed
    with pytest.raises(UsageError, match="numbered from 0 to 0"):
        riding(host, 1).open(RecordingSink())
