"""The checklist before a flight: each bad finding says what, why and what to do."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

import skyloop
from skyloop.client import Level, LinkStatus, PreflightFinding
from skyloop.client.preflight import PreflightState, check_before_flight, inspect
from skyloop.errors import ClosedError, NoAnswerError
from skyloop.messages import CameraInfo, Capabilities, Failsafe, Feedback, FlightState, LinkState, Value
from skyloop.messages.parameter import MAX_CHECKUP_TEXT, Diagnostic, decode_checkup, encode_checkup
from skyloop.vehicles.ardrone.telemetry import diagnose
from skyloop.vehicles.ardrone.wire.navdata import State
from skyloop.vehicles.mavlink.autopilots import ArduCopterProfile, AutopilotProfile, Px4Profile
from skyloop.vehicles.tello.telemetry import TelloHealth
from skyloop.vehicles.tello.wire import parse

GOOD = Feedback(
    captured_ns=1,
    state=FlightState.LANDED,
    battery=0.9,
    roll_rad=0.0,
    pitch_rad=0.01,
    yaw_rad=0.0,
    altitude_m=0.0,
    position_m=(0.0, 0.0, 0.0),
)
PARAMETERS: dict[str, Value] = {
    "battery.land": 0.1,
    "battery.warn": 0.2,
    "safety.box.x_high": 4.0,
    "safety.zones": "cylinder 2 0 0.5 0 3",
    "limits.altitude": 3.0,
}
READY = PreflightState(
    link=LinkStatus(LinkState.UP, LinkState.UP),
    capabilities=Capabilities(
        "test", actions=frozenset({"takeoff", "land"}), cameras=(CameraInfo("front", 32, 24, 30.0),)
    ),
    feedback=GOOD,
    feedback_age_s=0.02,
    video_age_s={"front": 0.05},
    parameters=PARAMETERS,
    free_bytes=50_000_000_000,
)


def lines(state: PreflightState) -> dict[str, PreflightFinding]:
    return {finding.check: finding for finding in check_before_flight(state)}


def fed(**changes: Any) -> PreflightState:
    return replace(READY, feedback=msgspec.structs.replace(GOOD, **changes))


def with_parameters(**changes: Value) -> PreflightState:
    return replace(READY, parameters={**PARAMETERS, **{name.replace("__", "."): v for name, v in changes.items()}})


def test_a_ready_vehicle_has_only_good_findings() -> None:
    found = lines(READY)
    assert {finding.level for finding in found.values()} == {Level.OK}
    assert list(found) == [
        "link", "vehicle", "battery", "position", "compass", "level", "zones", "video front", "control", "clock",
        "storage",
    ]  # fmt: skip
    assert "1 of 6 walls of the safety box, 1 zone, at most 3 m high" in found["zones"].detail


@pytest.mark.parametrize(
    ("state", "check", "level", "words"),
    [
        (replace(READY, link=LinkStatus(LinkState.LOST, LinkState.UP, "gone")), "link", Level.FAIL, "gone"),
        (replace(READY, link=LinkStatus(LinkState.UP, LinkState.CONNECTING)), "link", Level.FAIL, "vehicle"),
        (replace(READY, link=LinkStatus(LinkState.UP, LinkState.DEGRADED)), "link", Level.WARN, "degraded"),
        (replace(READY, capabilities=Capabilities("video")), "vehicle", Level.FAIL, "accepts no commands"),
        (replace(READY, feedback=None), "vehicle", Level.FAIL, "not reported"),
        (fed(state=FlightState.EMERGENCY), "vehicle", Level.FAIL, "emergency stop"),
        (replace(READY, feedback_age_s=3.0), "vehicle", Level.FAIL, "3.0 s old"),
        (fed(others="RTL"), "vehicle", Level.WARN, "another controller"),
        (fed(failsafe=Failsafe.LAND), "failsafe", Level.WARN, "failsafe"),
        (fed(battery=0.05), "battery", Level.FAIL, "5%"),
        (fed(battery=0.15), "battery", Level.WARN, "15%"),
        (with_parameters(battery__return=0.95), "battery", Level.FAIL, "90% left, below 95% (battery.return)"),
        (fed(battery=None), "battery", Level.WARN, "not reported"),
        (fed(position_m=None), "position", Level.WARN, "position"),
        (fed(position_m=None), "zones", Level.FAIL, "walls"),
        (fed(yaw_rad=None), "compass", Level.WARN, "heading"),
        (fed(roll_rad=0.3), "level", Level.WARN, "tilted"),
        (replace(READY, parameters={"limits.altitude": 3.0}), "zones", Level.WARN, "no safety box"),
        (replace(READY, parameters={}), "zones", Level.WARN, "could not be read"),
        (
            replace(READY, video_age_s={"front": None}, video_waited_s=1.5),
            "video front",
            Level.WARN,
            "no picture yet, in 1.5 s",
        ),
        (replace(READY, video_age_s={"front": 4.0}), "video front", Level.WARN, "4.0 s old"),
        (fed(owner="ann", owner_id=7, owner_priority=4, lease=3), "control", Level.WARN, "ann has control"),
        (replace(READY, clock_uncertainty_s=0.2), "clock", Level.WARN, "200 ms"),
        (replace(READY, free_bytes=500_000_000), "storage", Level.WARN, "0.5 GB"),
        (replace(READY, free_bytes=1000), "storage", Level.FAIL, "0.0 GB"),
        (with_parameters(vehicle__checkup="no list"), "driver", Level.WARN, "can't be read"),
    ],
)
def test_bad_findings_have_a_reason(state: PreflightState, check: str, level: Level, words: str) -> None:
    finding = lines(state)[check]
    assert (finding.level, words in finding.detail) == (level, True), finding
    assert finding.why
    assert finding.remedy


def test_the_drivers_findings_are_included() -> None:
    text = encode_checkup(
        [
            Diagnostic("autopilot", True, "ArduCopter 4.6"),
            Diagnostic("loss of this computer", False, "FS_GCS_ENABLE is 0: it hovers until empty", "set it to 7"),
            Diagnostic("arming", False, "it can't be armed: it refuses to take off", "wait for GPS", severe=True),
        ]
    )
    found = lines(with_parameters(vehicle__checkup=text))
    assert found["autopilot"].level is Level.OK
    net = found["loss of this computer"]
    assert (net.level, net.detail, net.why) == (Level.WARN, "FS_GCS_ENABLE is 0", "it hovers until empty")
    assert found["arming"].level is Level.FAIL


def test_a_remedy_is_a_command_for_this_drone() -> None:
    advice = Diagnostic("fence", False, "FENCE_ENABLE is 0: none", "skyloop param NAME mavlink.fence_enable 1; a NAME")
    found = lines(replace(with_parameters(vehicle__checkup=encode_checkup([advice])), name="alpha"))
    assert found["fence"].remedy == "skyloop param alpha mavlink.fence_enable 1; a NAME"


@pytest.mark.parametrize(("chosen", "shown"), [("front", True), ("bottom", False), ("both_in_one", True)])
def test_a_camera_that_is_not_selected_is_not_missed(chosen: str, shown: bool) -> None:
    both = (CameraInfo("front", 32, 24, 30.0), CameraInfo("bottom", 32, 24, 30.0))
    state = with_parameters(camera__active=chosen)
    state = replace(state, capabilities=replace_cameras(state.capabilities, both), video_age_s={"front": None})
    found = lines(state)["video front"]
    assert found.level is (Level.WARN if shown else Level.OK)
    assert ("one camera at a time, now bottom" in found.detail) is not shown


def replace_cameras(capabilities: Capabilities, cameras: tuple[CameraInfo, ...]) -> Capabilities:
    return msgspec.structs.replace(capabilities, cameras=cameras)


@pytest.mark.parametrize("profile", [ArduCopterProfile(), Px4Profile()], ids=["arducopter", "px4"])
def test_each_disabled_safety_net_of_an_autopilot_is_explained(profile: AutopilotProfile) -> None:
    off = {net.name: next(bad for bad in (0.0, 99.0) if not net.good(bad)) for net in profile.SAFETY_NETS}
    diagnostics = profile.safety_diagnostics(off, own_system=255)
    state = replace(with_parameters(vehicle__checkup=encode_checkup(diagnostics)), name="alpha")
    found = [line for line in check_before_flight(state) if line.level is not Level.OK]
    assert [line.detail.split()[0] for line in found] == [net.name for net in profile.SAFETY_NETS]
    assert len({line.check for line in found}) == len(found)
    for line, net in zip(found, profile.SAFETY_NETS, strict=True):
        assert line.level is Level.WARN
        assert line.why
        key, value = line.remedy.removeprefix("skyloop param alpha mavlink.").split()
        assert key.upper() == net.name
        assert net.good(float(value)), "the advised value is good"


def test_an_autopilot_that_watches_another_computer_says_so() -> None:
    found = {one.what: one for one in ArduCopterProfile().safety_diagnostics({"MAV_GCS_SYSID": 42.0}, own_system=255)}
    net = lines(with_parameters(vehicle__checkup=encode_checkup([found["ground station"]])))["ground station"]
    assert (net.level, net.why, net.remedy) == (
        Level.WARN, "it won't notice our loss", "give the address ?own_sysid=42"
    )  # fmt: skip
    assert "ground station" not in {
        one.what for one in ArduCopterProfile().safety_diagnostics({"MAV_GCS_SYSID": 255.0}, own_system=255)
    }


def test_a_hot_tello_says_why_it_may_come_down() -> None:
    watch = TelloHealth()
    assert watch.diagnose() == []
    for celsius, level in ((60, Level.OK), (95, Level.WARN), (88, Level.WARN), (70, Level.OK)):
        watch.changes(parse(f"templ:{celsius - 2};temph:{celsius};bat:50;".encode()))
        found = lines(with_parameters(vehicle__checkup=encode_checkup(watch.diagnose())))["temperature"]
        assert (found.level, f"{celsius} °C" in found.detail) == (level, True)
        assert bool(found.why and found.remedy) is (level is Level.WARN)


def test_a_check_up_that_is_too_long_keeps_the_bad_findings() -> None:
    many = [Diagnostic(f"check {number}", number % 2 == 0, "x" * 200) for number in range(60)]
    text = encode_checkup(many)
    assert len(text) <= MAX_CHECKUP_TEXT
    assert [one.good for one in decode_checkup(text)].count(False) == 30


def test_an_ardrone_reports_what_keeps_it_down() -> None:
    usual = {"control:altitude_max": "3000", "control:outdoor": "FALSE", "control:flight_without_shell": "FALSE"}
    assert all(one.good for one in diagnose(State.FLYING, usual))
    found = {one.what: one for one in diagnose(State.MOTORS_PROBLEM | State.MAGNETOMETER_UNCALIBRATED, {
        **usual, "control:altitude_max": "100000", "control:outdoor": "TRUE"})}  # fmt: skip
    assert found["motors"].severe
    assert not found["compass"].severe
    assert not found["ceiling"].good
    assert not found["indoors"].good
    assert not diagnose(None, {})[0].good


def test_a_drone_checks_itself() -> None:
    with skyloop.connect("sim://?world=empty&cameras=front&width=160", access="observe", timeout_s=60.0) as drone:
        drone.next_feedback(10.0)
        found = {finding.check: finding for finding in drone.preflight(video_s=10.0, folder=Path("recordings"))}
        assert found["link"].level is Level.OK
        assert found["video front"].level is Level.OK
        assert found["zones"].level is Level.WARN
        assert math.isfinite(len(found["storage"].detail))


class Absent:
    """A stand-in for a drone whose link is down, or that was closed."""

    name = "alpha"
    link = LinkStatus(LinkState.LOST, LinkState.LOST)
    capabilities = Capabilities("test", actions=frozenset({"takeoff", "land"}))
    clock_uncertainty_ns = 0
    app_id = 1

    def __init__(self, error: Exception) -> None:
        self._error = error

    @property
    def config(self) -> Any:
        raise self._error


def test_a_link_that_is_down_is_a_finding_rather_than_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreadable(_: Path) -> None:
        raise OSError("not readable")

    monkeypatch.setattr("skyloop.client.preflight.shutil.disk_usage", unreadable)
    absent: Any = Absent(NoAnswerError("no answer to a read of parameters"))
    found = {finding.check: finding for finding in inspect(absent, None, 0.0, tmp_path / "not" / "there")}
    assert found["link"].level is Level.FAIL
    assert "storage" not in found or found["storage"].level is not Level.OK
    closed: Any = Absent(ClosedError("drone alpha is closed"))
    with pytest.raises(ClosedError):
        inspect(closed, None, 0.0, None)
