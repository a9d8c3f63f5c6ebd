"""``sim://?autopilot=…``: real firmware flies the simulated drone. Stand-ins for its programs suffice here."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from skyloop.clock import NS_PER_S, monotonic_ns
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError, ParameterError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import EventKind, Feedback, Hover, Land, LinkState, Takeoff
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.vehicles import CRAZYFLIE, IRIS, RACER
from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.firmware.ardupilot import VARIABLE
from skyloop.vehicles.sim.firmware_flight import FirmwareFlight, _InnerSink
from skyloop.vehicles.sim.options import options_of
from skyloop.vehicles.sim.telemetry import truth_at
from tests.vehicles.sim.firmware.rig import program

LONG_S = 60.0
POSE = ExternalPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)
ARDUPILOT = "sim://?autopilot=ardupilot&world=empty&wind=0&noise=0&cameras=bottom&width=64&height=48&parameters=0"


@pytest.fixture(autouse=True)
def standin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "arducopter")))
    monkeypatch.setenv("STANDIN", "mavlink")


@contextmanager
def opened(driver: SimDriver) -> Iterator[RecordingSink]:
    sink = RecordingSink()
    driver.open(sink)
    try:
        yield sink
    finally:
        driver.close()
    assert not sink.problems, sink.problems[:3]


def made(uri: str) -> SimDriver:
    driver = make_driver(uri)
    assert isinstance(driver, SimDriver)
    return driver


def pid_of(driver: SimDriver) -> int:
    assert driver.firmware is not None
    assert driver.firmware.firmware is not None
    return driver.firmware.firmware.program.pid


def happened(sink: RecordingSink, reason: str, times: int = 1) -> bool:
    return [event.data.get("reason") for event in sink.events].count(reason) >= times


# Its address -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("sim://?autopilot=ardupilo", "no autopilot of sim:// named 'ardupilo'; did you mean 'ardupilot'"),
        ("sim://?autopilot=px4&vehicle=ardrone", "firmware needs a vehicle with rotors"),
        ("sim://?autopilot=betaflight&speed=2", "Betaflight uses the computer's clock: speed must be 1, not 2"),
        ("sim://?autopilot=crazyflie&speed=0.5", "Crazyflie uses the computer's clock: speed must be 1, not 0.5"),
        ("sim://?autopilot=px4&native=attitude", "native is an option of the built-in autopilot, but px4 flies"),
        ("sim://?autopilot_folder=/tmp", "give autopilot=… as well"),
        ("sim://?autopilot=ardupilot&takeof_altitude=2", "no option of mavlink:// named 'takeof_altitude'"),
    ],
)
def test_invalid_addresses_are_refused(uri: str, message: str) -> None:
    with pytest.raises((UsageError, UnknownNameError), match=message):
        make_driver(uri)


def test_the_vehicle_suits_the_firmware() -> None:
    for autopilot, vehicle in (("ardupilot", IRIS), ("px4", IRIS), ("betaflight", RACER), ("crazyflie", CRAZYFLIE)):
        options = options_of(parse_uri(f"sim://?autopilot={autopilot}"))
        assert options.parameters == vehicle
        assert options.autopilot == autopilot
    assert options_of(parse_uri("sim://?autopilot=px4&vehicle=crazyflie")).parameters == CRAZYFLIE


def test_its_capabilities_are_those_of_the_firmwares_driver() -> None:
    driver = made(ARDUPILOT)
    capabilities = driver.capabilities()
    assert capabilities.vehicle == "sim"
    assert capabilities.actions == make_driver("mavlink://udpin:127.0.0.1:14550").capabilities().actions
    assert [camera.name for camera in capabilities.cameras] == ["bottom"]
    assert "ArduCopter in the world 'empty'" in capabilities.description
    assert driver.apply(Takeoff()) == Takeoff()  # without a recipient
    assert driver.left_to() == ""


def test_opening_without_the_program_names_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/nowhere")
    with pytest.raises(UsageError, match="SKYLOOP_ARDUCOPTER is '/nowhere', which is not a program"):
        made(ARDUPILOT).open(RecordingSink())


# In the world ----------------------------------------------------------------------------------------------------


@pytest.mark.process
@pytest.mark.daily
def test_firmware_flies_dies_and_returns_while_pictures_continue() -> None:
    driver = made(ARDUPILOT)
    with opened(driver) as sink:
        assert sink.wait(lambda: happened(sink, "firmware_answers"), LONG_S)
        assert sink.wait(lambda: (LinkState.UP, "") in sink.links, LONG_S)
        assert sink.wait(lambda: sink.newest is not None and sink.newest.roll_rad is not None, LONG_S)
        feedback = sink.newest
        assert feedback is not None
        assert feedback.native is not None
        assert feedback.roll_rad == pytest.approx(0.1)  # the firmware's estimate
        assert feedback.native["truth.roll"] == pytest.approx(0.0, abs=1e-3)  # and the truth
        assert {"truth.x", "truth.vx", "truth.yaw", "sim.time_s"} <= set(feedback.native)
        os.kill(pid_of(driver), signal.SIGKILL)
        assert sink.wait(lambda: happened(sink, "firmware_died"), LONG_S)
        seen = sink.frame_counts["bottom"]
        assert sink.wait(lambda: sink.frame_counts["bottom"] > seen + 3, LONG_S)
        assert sink.wait(lambda: happened(sink, "firmware_answers", 2), LONG_S)
    again = next(event for event in sink.events if event.data.get("reason") == "firmware_died")
    assert again.kind is EventKind.VEHICLE_MESSAGE
    assert "was killed by SIGKILL" in again.text


@pytest.mark.process
def test_the_simulated_radio_disconnects_the_firmwares_driver() -> None:
    driver = made(ARDUPILOT)
    names = {parameter.name for parameter in driver.parameters()}
    assert {"sim.wind", "sim.link", "camera.bottom.fps", "limits.altitude"} <= names
    assert "limits.tilt" not in names  # of the built-in autopilot
    with opened(driver) as sink:
        assert sink.wait(lambda: (LinkState.UP, "") in sink.links, LONG_S)
        assert driver.set_parameter("limits.altitude", 7.0) == 7.0
        assert driver.set_parameter("sim.link", False) is False
        assert sink.links[-1][0] is LinkState.LOST
        count = sink.feedback_count
        assert driver.apply(Hover()) == Hover()
        with pytest.raises(DriverError, match="radio is switched off"):
            driver.external_pose(replace(POSE, captured_ns=monotonic_ns()))
        assert driver.set_parameter("sim.link", True) is True
        assert sink.wait(lambda: sink.links[-1] == (LinkState.UP, ""), LONG_S)
        assert sink.wait(lambda: sink.feedback_count > count, LONG_S)
        driver.external_pose(replace(POSE, captured_ns=monotonic_ns()))
        assert driver.failsafe(Land()) in (True, False)  # as the firmware's driver decides
        assert driver.checkup()
        with pytest.raises(ParameterError):
            driver.set_parameter("sim.battery", 7.0)
    with opened(driver) as sink:  # a driver can be opened again
        assert sink.wait(lambda: happened(sink, "firmware_answers"), LONG_S)


@pytest.mark.process
def test_several_fly_in_one_world(tmp_path: Path) -> None:
    uri = parse_uri(f"{ARDUPILOT}&autopilot_folder={tmp_path / 'kept'}")
    host = SimHost(options_of(uri), 2)
    drivers = [SimDriver(uri, host=host, drone=number) for number in range(2)]
    with opened(drivers[0]) as first, opened(drivers[1]) as second:
        for sink in (first, second):
            assert sink.wait(lambda sink=sink: happened(sink, "firmware_answers"), LONG_S)  # type: ignore[misc]
        assert pid_of(drivers[0]) != pid_of(drivers[1])
        assert first.wait(lambda: first.feedback_count > 0, LONG_S)
        assert second.wait(lambda: second.feedback_count > 0, LONG_S)
    for name in ("drone1", "drone2"):  # each has its own settings
        assert (tmp_path / "kept" / name / "skyloop.parm").is_file()


@pytest.mark.process
def test_each_drone_in_a_world_has_the_autopilot_of_its_own_address() -> None:
    flown = parse_uri(ARDUPILOT)
    host = SimHost(options_of(flown), 2)
    built_in = SimDriver(parse_uri("sim://?world=elsewhere&cameras=none"), host=host, drone=1)
    assert built_in.firmware is None
    assert built_in.options.world == "empty", "the world determines the rest"
    with opened(SimDriver(flown, host=host)) as first, opened(built_in) as second:
        assert first.wait(lambda: happened(first, "firmware_answers"), LONG_S)
        built_in.apply(Takeoff())
        assert second.wait(lambda: second.newest is not None and second.newest.state.airborne, LONG_S)


def test_the_built_in_autopilot_accepts_no_poses() -> None:
    with pytest.raises(UnsupportedError):
        made("sim://").external_pose(POSE)


@pytest.mark.parametrize("known", [True, False])
def test_betaflight_receives_its_position_as_from_motion_capture(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    uri = f"sim://?autopilot=betaflight&world=empty&cameras=none&position={int(known)}&rate=60"
    options = options_of(parse_uri(uri))
    flight = FirmwareFlight(options, "")
    told: list[ExternalPose] = []
    monkeypatch.setattr(flight, "_inner", SimpleNamespace(external_pose=told.append))
    simulation = SimHost(SimOptions(world="empty", cameras=())).simulation
    truth = simulation.truth(0)
    flight.report(Report(simulation.feedback(0), truth, (), monotonic_ns()))
    assert [pose.position_m for pose in told] == ([truth.position_m] if known else [])
    assert all(abs(monotonic_ns() - pose.captured_ns) < 60 * NS_PER_S for pose in told)


def test_the_firmwares_feedback_includes_the_truth_once_known() -> None:
    flight = FirmwareFlight(options_of(parse_uri(ARDUPILOT)), "")
    sink = RecordingSink()
    inner = _InnerSink(flight, sink)
    inner.feedback(Feedback(captured_ns=monotonic_ns()))
    assert sink.newest is not None
    assert sink.newest.native is None
    simulation = SimHost(SimOptions(world="empty", cameras=())).simulation
    flight.report(Report(simulation.feedback(0), simulation.truth(0), (), monotonic_ns()))
    inner.feedback(Feedback(captured_ns=monotonic_ns(), native={"mode": "AUTO"}))
    assert sink.newest.native is not None
    assert {"mode", "truth.x"} <= set(sink.newest.native)
    assert not inner.wants("front")
    assert not inner.wants_stream("front")
    with pytest.raises(NotImplementedError):
        inner.frame("front", np.zeros((2, 2, 3), np.uint8), 1, width=2, height=2)
    with pytest.raises(NotImplementedError):
        inner.stream("front", b"", 1, width=2, height=2, key=True)


def test_link_reasons_name_the_firmware_inside() -> None:
    """Its driver once asked users to start the firmware, which this drone starts, at a port unknown to them."""
    flight = FirmwareFlight(options_of(parse_uri("sim://?autopilot=betaflight")), "")
    sink = RecordingSink()
    inner = _InnerSink(flight, sink)
    for state in (LinkState.CONNECTING, LinkState.LOST):
        inner.link(state, "no reply from the flight controller on tcp:127.0.0.1:39999", "skyloop sim --firmware …")
        assert flight.link(state, "")[2] == ""
        assert sink.links[-1] == (LinkState.CONNECTING, "still waking up: Betaflight is being started")
    inner.link(LinkState.UP)
    assert sink.links[-1] == (LinkState.UP, "")
    inner.link(LinkState.LOST, "the connection failed", "skyloop sim --firmware betaflight")
    assert sink.links[-1] == (LinkState.LOST, "the connection failed")
    assert flight.link(LinkState.LOST, "")[2].startswith("Betaflight runs within this drone")


# The truth in feedback -------------------------------------------------------------------------------------------


def test_the_truth_belongs_to_the_time_of_the_feedback() -> None:
    simulation = SimHost(SimOptions(world="empty", cameras=())).simulation
    believed, truth = simulation.feedback(0), simulation.truth(0)
    first = Report(believed, replace(truth, position_m=(0, 0, 0), velocity_m_s=(0, 0, 0), yaw_rad=3.0), (), 1000)
    last = Report(believed, replace(truth, position_m=(1, 2, 3), velocity_m_s=(4, 4, 4), yaw_rad=-3.0), (), 2000)
    between = truth_at((first, last), 1250).truth
    assert between.position_m == (0.25, 0.5, 0.75)
    assert between.velocity_m_s == (1, 1, 1)
    assert between.yaw_rad == pytest.approx(3.0 + 0.25 * (2 * 3.141592653589793 - 6.0))
    assert truth_at((first, last), 500) is first
    assert truth_at((first, last), 2000) is last
    assert truth_at((first, last), 9000) is last
