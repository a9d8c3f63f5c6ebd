"""Fly the vehicle of ``--drone`` twice through everything that a driver must get right."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.messages import Failsafe, FlightState
from skyloop.messages.geometry import wrap_angle
from tests.hardware.rig import (
    LANDING_S,
    READY_S,
    TAKEOFF_S,
    Rig,
    holds,
    place,
    ready,
    runtime_folder,
    speed,
    until,
)

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

CLIMBS_M = 5.0  #: maximum height above the take-off
PX4_HOLD = ("mavlink.com_obl_rc_act", 5)  #: makes a PX4 without a remote control hold when set-points stop


@pytest.fixture(scope="module")
def rig(address: str) -> Iterator[Rig]:
    with pytest.MonkeyPatch.context() as patch, runtime_folder() as folder:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        made = Rig(address)
        made.start()
        yield made
        made.end()


def test_it_gets_ready(rig: Rig) -> None:
    """It reports attitude, position and battery, and that it can be armed."""
    with rig.connect() as drone:
        until(drone, ready, READY_S, "ready to be armed")
        newest = until(
            drone, lambda f: f.position_m is not None and f.velocity_m_s is not None, 30.0, "knows its place"
        )
        assert newest.state is FlightState.LANDED
        assert None not in (
            newest.roll_rad,
            newest.pitch_rad,
            newest.yaw_rad,
            newest.altitude_m,
            newest.angular_velocity_rad_s,
        )
        assert abs(newest.roll_rad or 0.0) < 0.3
        assert abs(newest.pitch_rad or 0.0) < 0.3


@pytest.mark.parametrize("flight", [1, 2])
def test_a_flight(rig: Rig, flight: int) -> None:
    """Take-off, velocity, attitude, hover, a silent pilot, a killed proxy, landing; then everything again."""
    drone = rig.connect()
    try:
        take_off(drone)
        flies_north(drone)
        flies_by_its_body(drone)
        flies_by_attitude(drone)
        hovers(drone)
        before = hold_without_set_points(drone)
        until(
            drone,
            lambda f: (f.velocity_m_s or (0.0,))[0] > 0.5,
            15.0,
            "flying forward before the pilot goes silent",
            lambda: drone.velocity(forward=1.0),
        )
    finally:
        drone.close()  # to the proxy, an application that is gone is a silent pilot
    stops_when_nobody_commands(rig)
    drone = rig.connect()
    try:
        until(drone, lambda f: f.state.airborne, 5.0, "still in the air")
        until(
            drone,
            lambda f: (f.velocity_m_s or (0.0,))[0] > 0.5,
            15.0,
            "flying forward before the proxy is killed",
            lambda: drone.velocity(forward=1.0),
        )
        rig.kill()
    finally:
        drone.close()
    time.sleep(6.0)  # until the autopilot misses the set-points and could stop, which it does not report
    rig.start()
    drone = rig.connect()
    try:
        newest = until(drone, lambda f: f.velocity_m_s is not None, 20.0, "its speed is told again")
        assert speed(newest) < 0.5, "without the proxy it must not fly on"
        holds(drone, 2.0, 1.0, "after the proxy is back nothing old is flown")
        land(drone)
        if before is not None:
            drone.config[PX4_HOLD[0]] = before
    finally:
        drone.close()


def take_off(drone: skyloop.Drone) -> None:
    until(drone, ready, READY_S, "ready to be armed")
    ground = drone.feedback().altitude_m or 0.0
    height = float(str(drone.config["limits.takeoff_altitude"]))
    if float(str(drone.config["limits.altitude"])) < height + CLIMBS_M:
        drone.config["limits.altitude"] = height + CLIMBS_M
    drone.takeoff(timeout_s=TAKEOFF_S)
    newest = until(drone, lambda f: (f.altitude_m or 0.0) - ground > 0.7 * height, 10.0, "at its height")
    assert (newest.altitude_m or 0.0) - ground < height + 2.5  # a PX4 rises at least to MIS_TAKEOFF_ALT
    assert newest.state in (FlightState.HOVERING, FlightState.FLYING)


def flies_north(drone: skyloop.Drone) -> None:
    """Fly north by velocity, whatever the heading."""
    begun = place(drone.feedback())
    deadline = time.monotonic() + 20.0
    while place(drone.feedback())[1] - begun[1] < 2.0:
        yaw = drone.feedback().yaw_rad
        assert yaw is not None
        drone.velocity(forward=math.sin(yaw), left=math.cos(yaw))
        assert time.monotonic() < deadline, f"not 2 m north of {begun}: {drone.feedback()}"
        time.sleep(0.05)
    assert abs(place(drone.feedback())[0] - begun[0]) < 1.0, "it went astray"
    until(drone, lambda f: speed(f) < 0.4, 10.0, "stopped", drone.hover)


def flies_by_its_body(drone: skyloop.Drone) -> None:
    """Fly forward, which turns with the heading."""
    yaw = drone.feedback().yaw_rad
    assert yaw is not None
    until(
        drone,
        lambda f: f.yaw_rad is not None and wrap_angle(f.yaw_rad - yaw) > 0.5,
        15.0,
        "turned to the left",
        lambda: drone.velocity(yaw_rate=0.5),
    )
    until(drone, lambda f: f.state is FlightState.HOVERING and speed(f) < 0.4, 10.0, "stopped", drone.hover)
    for forward, left in ((0.7, 0.0), (0.0, 0.7), (-0.7, -0.7)):
        goes(drone, forward, left)


def goes(drone: skyloop.Drone, forward: float, left: float) -> None:
    """Fly a metre in this direction."""
    begun = drone.feedback()
    assert begun.yaw_rad is not None
    east, north, _ = place(begun)
    way = begun.yaw_rad + math.atan2(left, forward)

    def gone(feedback: skyloop.Feedback) -> float:
        here = place(feedback)
        return (here[0] - east) * math.cos(way) + (here[1] - north) * math.sin(way)

    def say() -> None:
        drone.velocity(forward=forward, left=left)

    until(drone, lambda f: gone(f) > 1.0, 15.0, f"1 m along ({forward}, {left})", say)
    until(drone, lambda f: speed(f) < 0.4, 10.0, "stopped", drone.hover)


def flies_by_attitude(drone: skyloop.Drone) -> None:
    """Tilt, climb and descend by attitude, holding the altitude between these."""
    low = drone.feedback().altitude_m or 0.0
    until(
        drone,
        lambda f: (f.altitude_m or 0.0) > low + 0.8,
        15.0,
        "0.8 m higher by attitude with climb rate",
        lambda: drone.attitude(climb=0.5),
    )
    until(
        drone,
        lambda f: (f.velocity_m_s or (0.0,))[0] > 0.3,
        15.0,
        "forward by its pitch",
        lambda: drone.attitude(pitch=0.1),
    )
    until(
        drone,
        lambda f: (f.velocity_m_s or (0.0, 0.0))[1] > 0.2,
        15.0,
        "to the left by its roll",
        lambda: drone.attitude(roll=-0.1),
    )
    until(drone, lambda f: speed(f) < 0.4, 15.0, "stopped", drone.hover)
    high = drone.feedback().altitude_m or 0.0
    until(
        drone,
        lambda f: (f.altitude_m or 0.0) < high - 0.5,
        15.0,
        "lower by attitude with climb rate",
        lambda: drone.attitude(climb=-0.4),
    )
    heights = [fly_level(drone, 1.0), fly_level(drone, 1.5)]
    assert abs(heights[1] - heights[0]) < 0.5, "a climb rate of zero holds the altitude"
    until(drone, lambda f: speed(f) < 0.4, 15.0, "stopped", drone.hover)


def fly_level(drone: skyloop.Drone, seconds: float) -> float:
    """Fly level by attitude; return the altitude at the end."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        drone.attitude()
        time.sleep(0.05)
    return drone.feedback().altitude_m or 0.0


def hovers(drone: skyloop.Drone) -> None:
    until(drone, lambda f: f.state is FlightState.HOVERING, 10.0, "hovering", drone.hover)
    holds(drone, 1.5, 1.5, "coming to rest", drone.hover)
    holds(drone, 3.0, 0.7, "hovering", drone.hover)


def hold_without_set_points(drone: skyloop.Drone) -> int | None:
    """Make a PX4 hold its position instead of descending when set-points stop; return the previous setting."""
    if not any(name.startswith("mavlink.") for name in drone.feedback().native or {}):
        return None
    name, wanted = PX4_HOLD
    deadline = time.monotonic() + 90.0
    while not any(known.startswith("mavlink.") for known in drone.config):
        assert time.monotonic() < deadline, "its parameters were not read"
        time.sleep(0.5)
    if name not in drone.config:
        return None
    before = int(str(drone.config[name]))
    drone.config[name] = wanted
    assert drone.config[name] == wanted
    return before


def stops_when_nobody_commands(rig: Rig) -> None:
    """Check that the ladder makes it hover in the autopilot's own mode, as observers see before it would land."""
    with skyloop.connect("hardware", access="observe", timeout_s=10.0) as observer:
        until(observer, lambda f: f.failsafe is not Failsafe.NONE, 5.0, "the failsafe is taken")
        until(observer, lambda f: f.state in (FlightState.HOVERING, FlightState.LANDING), 5.0, "it stopped flying")
        until(observer, lambda f: speed(f) < 0.5, 5.0, "it stands still")


def land(drone: skyloop.Drone) -> None:
    if drone.feedback().state.airborne:
        drone.land(timeout_s=LANDING_S)
    until(drone, lambda f: f.state is FlightState.LANDED, LANDING_S, "landed")
    until(drone, lambda f: not (f.native or {}).get("mavlink.armed"), 20.0, "disarmed")
