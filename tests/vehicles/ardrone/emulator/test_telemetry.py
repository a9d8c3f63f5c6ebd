"""The emulated drone's navdata: units, axes and signs of its options."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from skyloop.messages import FlightState
from skyloop.vehicles.ardrone.emulator import MOST, Listeners
from skyloop.vehicles.ardrone.emulator.flight import ProgressCommand
from skyloop.vehicles.ardrone.emulator.telemetry import ArdroneSnapshot, options_of, tags_of
from skyloop.vehicles.ardrone.emulator.video import DroneClock
from skyloop.vehicles.ardrone.wire import navdata as o
from skyloop.vehicles.ardrone.wire.navdata import ControlState, Navdata, decode, encode
from skyloop.vehicles.emulation.video import VideoStatus
from tests.vehicles.ardrone.emulator.rig import RESTING

EVERY = list(range(28))
MOVING = replace(
    RESTING,
    battery=0.504,
    battery_v=11.1,
    roll_rad=0.1,
    pitch_rad=0.2,
    yaw_rad=0.5,
    altitude_m=1.234,
    velocity_m_s=(1.0, 0.25, -0.5),
    angular_velocity_rad_s=(0.1, 0.2, 0.3),
    acceleration_m_s2=(0.980665, 1.96133, 9.80665),
)


def told(snapshot: ArdroneSnapshot, tags: list[int] = EVERY) -> Navdata:
    """Return the options after encoding and decoding."""
    return decode(encode(0, 1, options_of(snapshot, tags)))


def of_moving() -> Navdata:
    return told(ArdroneSnapshot(MOVING, FlightState.FLYING, time=77, thrust=0.95, link_quality=90))


def test_the_demo_option() -> None:
    demo = of_moving().get(o.Demo)
    assert demo is not None
    assert demo.ctrl_state == ControlState.FLYING << 16
    assert demo.battery == 50
    assert demo.theta == pytest.approx(-math.degrees(0.2) * 1000)  # nose down
    assert demo.phi == pytest.approx(math.degrees(0.1) * 1000)
    assert demo.psi == pytest.approx(-math.degrees(0.5) * 1000)
    assert demo.altitude == 1234
    assert (demo.vx, demo.vy, demo.vz) == (1000.0, -250.0, 0.0)


@pytest.mark.parametrize(
    ("state", "shown"),
    [
        (FlightState.LANDED, 0x20000),
        (FlightState.TAKING_OFF, 0x60000),
        (FlightState.HOVERING, 0x40000),
        (FlightState.FLYING, 0x30000),
        (FlightState.LANDING, 0x80000),
        (FlightState.EMERGENCY, 0),
    ],
)
def test_the_control_state(state: FlightState, shown: int) -> None:
    demo = told(ArdroneSnapshot(RESTING, state, time=0)).get(o.Demo)
    assert demo is not None
    assert demo.ctrl_state == shown


def test_a_flip_shows_in_the_air() -> None:
    for state, shown in ((FlightState.HOVERING, ControlState.LOOPING), (FlightState.LANDED, ControlState.LANDED)):
        demo = told(ArdroneSnapshot(RESTING, state, time=0, flipping=True)).get(o.Demo)
        assert demo is not None
        assert demo.ctrl_state >> 16 == shown


def test_the_inertial_options_have_x_forward_y_right_z_down() -> None:
    physical, angles = of_moving().get(o.PhysMeasures), of_moving().get(o.EulerAngles)
    assert physical is not None
    assert angles is not None
    assert physical.accs == pytest.approx((100.0, -200.0, -1000.0))
    assert physical.gyros == pytest.approx((math.degrees(0.1), -math.degrees(0.2), -math.degrees(0.3)))
    assert angles.theta > 0, "forward thrust: the nose is up"


def test_other_values_from_the_simulation() -> None:
    navdata = of_moving()
    raw, altitude, pressure = navdata.get(o.RawMeasures), navdata.get(o.Altitude), navdata.get(o.KalmanPressure)
    magneto, pwm, wifi = navdata.get(o.Magneto), navdata.get(o.Pwm), navdata.get(o.Wifi)
    assert raw is not None
    assert raw.vbat == 11_100
    assert altitude is not None
    assert (altitude.vision, altitude.vz) == (1234, -500.0)
    assert pressure is not None
    assert pressure.est_z == pytest.approx(1234.0)
    assert magneto is not None
    assert magneto.heading_fusion == pytest.approx(90.0 - math.degrees(0.5))
    assert pwm is not None
    assert pwm.motors == (128,) * 4
    assert wifi == o.Wifi(90)
    assert navdata.get(o.Time) == o.Time(77)
    assert navdata.get(o.Gps) == o.Gps()


def test_a_flat_trim_shifts_level() -> None:
    navdata = told(ArdroneSnapshot(MOVING, FlightState.LANDED, time=0, trim_rad=(0.1, 0.2)))
    demo, trims = navdata.get(o.Demo), navdata.get(o.Trims)
    assert demo is not None
    assert (demo.theta, demo.phi) == pytest.approx((0.0, 0.0), abs=0.01)
    assert trims == pytest.approx((0.0, -0.2, 0.1))


def test_all_options_have_the_sizes_of_a_real_drone() -> None:
    navdata = of_moving()
    assert len(navdata.options) == 28
    assert navdata.unknown == ()


def test_values_out_of_a_fields_range_are_clamped() -> None:
    wild = replace(
        MOVING, altitude_m=-3.0, battery_v=1e9, angular_velocity_rad_s=(1e6,) * 3, acceleration_m_s2=(-1e6,) * 3
    )
    progress = ProgressCommand(1, 1e30, -1e30, 1e30, 0.0)
    video = VideoStatus(1 << 40, 1 << 40, 1)
    assert (
        len(told(ArdroneSnapshot(wild, FlightState.FLYING, time=0, thrust=9.0, progress=progress, video=video)).options)
        == 28
    )


@pytest.mark.parametrize(
    ("mask", "demo", "version", "tags"),
    [
        (0x10001, True, 2, [0, 16]),
        (0x10001, False, 2, EVERY),  # never configured: all of them
        (0x10001, False, 1, list(range(20))),
        (1 << 27, True, 2, [0, 16, 27]),
        (1 << 27 | 1, False, 2, [0, 27]),
        (0, False, 2, []),
        (~0, True, 1, list(range(20))),
    ],
)
def test_which_options_are_sent(mask: int, demo: bool, version: int, tags: list[int]) -> None:
    assert tags_of(mask, demo=demo, version=version) == tags


def test_the_drones_clock() -> None:
    clock = DroneClock(booted_ns=5_000_000_000)
    assert clock.navdata_time(8_250_000_000) == 3 << 21 | 250_000
    assert clock.milliseconds(8_250_000_000) == 3250
    assert clock.navdata_time(5_000_000_000 + 2049 * 10**9) == 1 << 21, "wraps after 2048 s"


def test_each_listener_has_its_own_sequence() -> None:
    listeners = Listeners()
    first, second = ("127.0.0.1", 1), ("127.0.0.1", 2)
    assert listeners.refresh(first)
    assert listeners.next_sequences() == [(first, 1)]
    assert listeners.refresh(second)
    assert not listeners.refresh(first)
    assert dict(listeners.next_sequences()) == {first: 2, second: 1}


def test_an_excess_listener_replaces_the_one_with_the_oldest_request() -> None:
    listeners = Listeners()
    for port in range(MOST):
        listeners.refresh(("127.0.0.1", port))
    listeners.refresh(("127.0.0.1", 0))
    listeners.refresh(("127.0.0.1", 99))
    assert {port for (_, port), _ in listeners.next_sequences()} == {0, 99, *range(2, MOST)}
