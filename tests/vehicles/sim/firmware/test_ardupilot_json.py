"""ArduPilot's JSON interface: round trips of output packets, other input, and lines that are JSON."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.sim.firmware.ardupilot import (
    MAX_PACKET,
    ServoPacket,
    SimulatedState,
    decode_servos,
    encode_servos,
    encode_state,
)

pulses = st.integers(0, 65535)
number = st.floats(-1e6, 1e6)
vector = st.tuples(number, number, number)
packets = st.builds(
    ServoPacket,
    st.integers(0, 65535),
    st.integers(0, 2**32 - 1),
    st.one_of(*(st.lists(pulses, min_size=n, max_size=n).map(tuple) for n in (16, 32))),
)


def test_a_packet_from_arducopter() -> None:
    data = bytes.fromhex("1a48 9001 07000000") + bytes.fromhex("e803 dc05 d007 4c04") + bytes(24)
    assert decode_servos(data) == ServoPacket(400, 7, (1000, 1500, 2000, 1100, *[0] * 12))


@given(packets)
def test_packets_survive_a_round_trip(packet: ServoPacket) -> None:
    data = encode_servos(packet)
    assert len(data) <= MAX_PACKET
    assert decode_servos(data) == packet


@given(st.binary(max_size=2 * MAX_PACKET))
@example(b"")
@example(b"\x1a\x48" + bytes(38))
@example(b"\x81\x73" + bytes(38))  # 32 outputs are announced, 16 present
def test_any_input_is_a_packet_or_refused(data: bytes) -> None:
    try:
        packet = decode_servos(data)
    except DecodeError:
        return
    assert encode_servos(packet) == data


@pytest.mark.parametrize(
    ("data", "words"), [(b"\x1a", "too few"), (bytes(40), "magic number is 0"), (b"\x1aH" + bytes(40), "42 bytes")]
)
def test_refusals_give_the_reason(data: bytes, words: str) -> None:
    with pytest.raises(DecodeError, match=words):
        decode_servos(data)


@given(
    st.builds(
        SimulatedState,
        time_s=st.floats(0, 1e6),
        gyro_rad_s=vector,
        acceleration_m_s2=vector,
        position_m=vector,
        quaternion=st.tuples(number, number, number, number),
        velocity_m_s=vector,
        range_m=st.none() | st.floats(0, 100),
        battery_v=st.none() | st.floats(0, 60),
        battery_a=st.none() | st.floats(-100, 100),
    )
)
def test_states_are_json_lines_of_the_known_fields(state: SimulatedState) -> None:
    data = encode_state(state)
    assert data[:1] == data[-1:] == b"\n"
    assert b"\n" not in data[1:-1]
    fields = json.loads(data)
    assert fields["timestamp"] == pytest.approx(state.time_s, abs=1e-6)
    for name, sent in (
        ("position", state.position_m),
        ("quaternion", state.quaternion),
        ("velocity", state.velocity_m_s),
    ):
        assert fields[name] == pytest.approx(sent, rel=1e-7, abs=1e-9)
    assert fields["imu"]["gyro"] == pytest.approx(state.gyro_rad_s, rel=1e-7, abs=1e-9)
    assert fields["imu"]["accel_body"] == pytest.approx(state.acceleration_m_s2, rel=1e-7, abs=1e-9)
    assert fields["no_time_sync"] == 1
    assert ("rng_1" in fields) == (state.range_m is not None)
    assert ("battery" in fields) == (state.battery_v is not None)


def test_arrays_have_the_form_that_arducopter_scans() -> None:
    state = SimulatedState(1.5, (1, 2, 3), (0.5, 0, -9.80665), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0))
    assert re.search(rb'"accel_body":\[0\.5, 0, -9\.80665\]', encode_state(state))
