"""Navdata as feedback: units, axes, signs, times, native telemetry."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.drivers.recording_sink import implausible
from skyloop.messages import Feedback, FlightState
from skyloop.messages.codec import decode as decode_packet
from skyloop.messages.codec import encode as encode_packet
from skyloop.vehicles.ardrone.telemetry import (
    OPTION_TAGS,
    ClimbMeter,
    NavdataClock,
    Reception,
    control_state,
    feedback_of,
    flight_state,
    native_of,
)
from skyloop.vehicles.ardrone.wire.navdata import (
    ControlState,
    Demo,
    Gps,
    Navdata,
    PhysMeasures,
    RawMeasures,
    State,
    Time,
    VisionDetect,
    Wifi,
    decode,
    encode,
)
from tests.support.recordings import recorded
from tests.vehicles.ardrone.scripted import ns


@functools.cache
def navdata() -> Navdata:
    return decode(recorded("ardrone2/navdata-full-landed.bin").read_bytes())


def told(demo: Demo, *others: Any, climb: float | None = 0.0) -> Feedback:
    return feedback_of(decode(encode(0, 1, [demo, *others])), demo, 5, climb, {})


def test_the_recorded_datagram() -> None:
    demo = navdata().get(Demo)
    assert demo is not None
    feedback = feedback_of(navdata(), demo, 5, 0.0, native_of(navdata(), everything=True))
    assert (feedback.state, feedback.battery, feedback.battery_v) == (FlightState.LANDED, 0.5, 11.686)
    assert feedback.roll_rad == pytest.approx(math.radians(0.55))
    assert feedback.pitch_rad == pytest.approx(math.radians(-2.974)), "nose up"
    assert feedback.yaw_rad == pytest.approx(math.radians(-1.933)), "clockwise"
    assert feedback.altitude_m == 0.0
    assert feedback.velocity_m_s == pytest.approx((0.0000585, 0.000882, 0.0), abs=1e-6)
    assert feedback.acceleration_m_s2 == pytest.approx((0.7874, 0.3267, 9.2430), abs=1e-3)
    assert feedback.angular_velocity_rad_s == pytest.approx((-0.00196, -0.0012, -0.00108), abs=1e-5)
    assert not implausible(feedback)
    # The accelerometers agree with the drone's own attitude estimate, which confirms their axes and signs.
    assert feedback.acceleration_m_s2 is not None
    forward, left, up = feedback.acceleration_m_s2
    assert math.degrees(math.atan2(forward, up)) == pytest.approx(4.866, abs=0.1)
    assert math.degrees(math.atan2(left, up)) == pytest.approx(2.024, abs=0.1)


def test_native_telemetry_of_everything_fits_a_packet() -> None:
    native = native_of(navdata(), everything=True)
    assert (native["demo.vx"], native["altitude.raw"], native["wifi.link_quality"]) == (0.0585307739675045, 243, 0)
    assert native["magneto.calibrated"] == 1
    assert len(native) > 200
    packet = encode_packet(Feedback(captured_ns=1, native=native))
    assert len(packet) < 12_000, f"{len(packet)} bytes"
    sample = decode_packet(packet)
    assert isinstance(sample, Feedback)
    assert sample.native == native


def test_native_telemetry_of_the_demo_mode_is_short() -> None:
    navdata = decode(encode(0, 9, [Demo(battery=50), VisionDetect(), Wifi(3)]))
    assert native_of(navdata, everything=False) == {
        **{"state": 0, "sequence": 9, "demo.ctrl_state": 0, "demo.battery": 50, "demo.altitude": 0},
        **{f"demo.{name}": 0.0 for name in ("theta", "phi", "psi", "vx", "vy", "vz")},
        **{"demo.num_frames": 0, "vision_detect.detected": 0, "wifi.link_quality": 3},
    }
    seen = decode(encode(0, 9, [Demo(), VisionDetect(detected=1, xc=(500, 0, 0, 0))]))
    assert native_of(seen, everything=False)["vision_detect.xc"] == (500, 0, 0, 0)


def test_numbers_that_are_not_finite_are_omitted() -> None:
    navdata = decode(encode(0, 9, [Demo(vx=math.nan), Gps(trajectory=(math.inf,) * 10), Wifi(3)]))
    native = native_of(navdata, everything=True)
    assert "demo.vx" not in native
    assert "gps.trajectory" not in native
    assert native["wifi.link_quality"] == 3


def test_every_option_has_a_name() -> None:
    assert {
        "demo": 0,
        "time": 1,
        "raw_measures": 2,
        "vision_optical_flow": 12,
        "wifi": 26,
    }.items() <= OPTION_TAGS.items()
    assert set(OPTION_TAGS.values()) == set(range(28))


@pytest.mark.parametrize(
    ("demo", "field", "value"),
    [
        (Demo(theta=-90_000.0), "pitch_rad", math.pi / 2),
        (Demo(phi=90_000.0), "roll_rad", math.pi / 2),
        (Demo(psi=90_000.0), "yaw_rad", -math.pi / 2),
        (Demo(vx=1000.0, vy=500.0), "velocity_m_s", (1.0, -0.5, 0.0)),
        (Demo(altitude=1234), "altitude_m", 1.234),
        (Demo(battery=100), "battery", 1.0),
        (Demo(battery=101), "battery", None),
        (Demo(theta=math.nan), "pitch_rad", None),
        (Demo(phi=math.inf), "roll_rad", None),
        (Demo(psi=1e30), "yaw_rad", None),
        (Demo(vx=math.nan), "velocity_m_s", None),
    ],
)
def test_units_signs_and_impossible_values(demo: Demo, field: str, value: object) -> None:
    assert getattr(told(demo), field) == (value if value is None else pytest.approx(value))


def test_body_axes_of_the_full_mode() -> None:
    measured = PhysMeasures(accs=(100.0, 200.0, -1000.0), gyros=(90.0, 45.0, -180.0))
    feedback = told(Demo(), measured, RawMeasures(vbat=11_000))
    assert feedback.acceleration_m_s2 == pytest.approx((0.980665, -1.96133, 9.80665))
    assert feedback.angular_velocity_rad_s == pytest.approx((math.pi / 2, -math.pi / 4, math.pi))
    assert feedback.battery_v == 11.0
    assert told(Demo(), RawMeasures()).battery_v is None, "zero volts is not a measurement"


def test_missing_values_are_none() -> None:
    feedback = told(Demo(), climb=None)
    assert feedback.velocity_m_s is None
    assert feedback.acceleration_m_s2 is None
    assert feedback.angular_velocity_rad_s is None
    assert feedback.position_m is None


@pytest.mark.parametrize(
    ("state", "control", "flight"),
    [
        (State(0), ControlState.LANDED, FlightState.LANDED),
        (State(0), ControlState.INIT, FlightState.LANDED),
        (State(0), ControlState.DEFAULT, FlightState.LANDED),
        (State.FLYING, ControlState.DEFAULT, FlightState.FLYING),
        (State.FLYING, ControlState.TAKING_OFF, FlightState.TAKING_OFF),
        (State.FLYING, ControlState.FLYING, FlightState.FLYING),
        (State.FLYING, ControlState.HOVERING, FlightState.HOVERING),
        (State.FLYING, ControlState.GOING_TO_FIX, FlightState.FLYING),
        (State.FLYING, ControlState.LOOPING, FlightState.FLYING),
        (State.FLYING, ControlState.LANDING, FlightState.LANDING),
        (State.FLYING, None, FlightState.FLYING),
        (State(0), None, FlightState.LANDED),
        (State.EMERGENCY | State.FLYING, ControlState.FLYING, FlightState.EMERGENCY),
    ],
)
def test_flight_states(state: State, control: ControlState | None, flight: FlightState) -> None:
    assert flight_state(state, control) is flight


def test_an_unknown_control_state() -> None:
    assert control_state(Demo(ctrl_state=99 << 16)) is None
    assert control_state(Demo(ctrl_state=(4 << 16) | 7)) is ControlState.HOVERING


# Times -----------------------------------------------------------------------------------------------------------


def stamped(stamp_s: float, sequence: int = 1) -> Navdata:
    whole = int(stamp_s)
    return decode(encode(0, sequence, [Time(whole % 2048 << 21 | round((stamp_s - whole) * 1e6))]))


def test_without_the_drones_time_the_arrival_is_used() -> None:
    clock = NavdataClock()
    assert clock.captured_ns(decode(encode(0, 1)), 500) == 500
    assert clock.captured_ns(decode(encode(0, 2)), 400) == 500, "never backwards"


def test_the_drones_time_reveals_delays() -> None:
    clock = NavdataClock()
    base = 1000.0
    for at, delay in enumerate((0.0, 0.004, 0.05, 0.0, 0.02)):
        sent_s = at * 0.005
        arrived_ns = ns(base + sent_s + delay)
        assert clock.captured_ns(stamped(30.0 + sent_s), arrived_ns) == pytest.approx(ns(base + sent_s), abs=2000)


def test_the_drones_time_wraps() -> None:
    clock = NavdataClock()
    for at in range(4):
        arrived_ns = ns(1000.0 + at)
        assert clock.captured_ns(stamped(2046.0 + at), arrived_ns) == pytest.approx(arrived_ns, abs=2000)


@given(st.lists(st.tuples(st.floats(0, 5000), st.floats(0, 0.2)), max_size=30))
def test_times_never_run_backwards_or_ahead(samples: list[tuple[float, float]]) -> None:
    clock, now_ns, before_ns = NavdataClock(), NS_PER_S, 0
    for stamp_s, step_s in samples:
        now_ns += ns(step_s)
        captured_ns = clock.captured_ns(stamped(stamp_s), now_ns)
        assert before_ns <= captured_ns <= now_ns
        before_ns = captured_ns


def test_climb_is_the_slope_of_the_altitude() -> None:
    meter = ClimbMeter()
    assert meter.climb(0.0, 0) is None
    for step in range(1, 20):
        assert meter.climb(0.5 * step * 0.067, ns(step * 0.067)) == pytest.approx(0.5)
    for step in range(20, 40):
        climb = meter.climb(0.5 * 19 * 0.067, ns(step * 0.067))
    assert climb == 0.0
    assert meter.climb(3.0, ns(60.0)) is None, "unknown after a gap"
    assert meter.climb(3.0, ns(60.0)) is None, "nor from two samples with the same time"


# Order and damage ------------------------------------------------------------------------------------------------


def receive(reception: Reception, sequence: int, at_s: float) -> bool:
    return reception.receive(encode(0, sequence), ns(at_s)) is not None


def test_gaps_are_counted_and_late_datagrams_dropped() -> None:
    reception = Reception()
    taken = [receive(reception, sequence, 10 + at * 0.005) for at, sequence in enumerate((1, 2, 5, 3, 4, 5, 6))]
    assert taken == [True, True, True, False, False, False, True]
    assert (reception.counts["missed"], reception.counts["late"], reception.counts["received"]) == (2, 3, 4)
    assert reception.counts["restarts"] == 0


def test_a_new_count_after_silence_is_a_restart() -> None:
    reception = Reception()
    assert receive(reception, 5000, 10.0)
    assert not receive(reception, 1, 10.1)
    assert receive(reception, 2, 10.3)
    assert reception.counts["restarts"] == 1
    assert receive(reception, 3, 10.31)


def test_a_new_count_is_accepted_even_without_silence() -> None:
    reception = Reception()
    assert receive(reception, 5000, 10.0)
    assert [receive(reception, sequence, 10.0 + sequence * 0.005) for sequence in range(1, 7)] == [False] * 4 + [
        True
    ] * 2


def test_damage_and_unknown_options_are_counted() -> None:
    reception = Reception()
    assert reception.receive(b"nonsense", 1) is None
    with_gap = encode(0, 1, [Wifi(1)]).replace(b"\x1a\x00\x08\x00", b"\x63\x00\x08\x00")
    total = sum(with_gap[:-8]).to_bytes(4, "little")
    assert reception.receive(with_gap[:-4] + total, 2) is not None
    assert (reception.counts["damaged"], reception.counts["unknown"]) == (1, 1)
    assert reception.telemetry()["navdata.unknown"] == 1


def test_decoding_does_not_modify_a_datagram() -> None:
    demo = navdata().get(Demo)
    assert demo is not None
    before = replace(navdata())
    native_of(navdata(), everything=True)
    assert before == navdata()
