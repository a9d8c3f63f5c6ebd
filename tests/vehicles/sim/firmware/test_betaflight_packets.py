"""The packets between Betaflight's program and a simulator: round trips, and other input."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.sim.firmware.betaflight import (
    BetaflightState,
    decode_motors,
    decode_state,
    encode_motors,
    encode_state,
)

number = st.floats(allow_nan=False, allow_infinity=False)
vector = st.tuples(number, number, number)
single = st.floats(0, 1, width=32)


@given(
    st.builds(
        BetaflightState,
        time_s=number,
        gyro_rad_s=vector,
        acceleration_m_s2=vector,
        quaternion=st.tuples(number, number, number, number),
        velocity_m_s=vector,
        place=vector,
        pressure_pa=number,
    )
)
def test_states_survive_a_round_trip(state: BetaflightState) -> None:
    data = encode_state(state)
    assert len(data) == 144
    assert decode_state(data) == state


def test_a_state_has_betaflights_layout() -> None:
    state = BetaflightState(1.0, (2, 3, 4), (5, 6, 7), (8, 9, 10, 11), (12, 13, 14), (15, 16, 17), 18.0)
    assert struct.unpack("<18d", encode_state(state)) == tuple(range(1, 19))


@given(st.tuples(single, single, single, single))
def test_motors_survive_a_round_trip(motors: tuple[float, float, float, float]) -> None:
    assert decode_motors(encode_motors(motors)) == motors


@given(st.binary(max_size=160))
@example(struct.pack("<4f", 0, 0, 0, math.nan))
@example(struct.pack("<18d", *[math.inf] * 18))
def test_any_input_is_a_packet_or_refused(data: bytes) -> None:
    for decode, size in ((decode_motors, 16), (decode_state, 144)):
        try:
            decode(data)
        except DecodeError:
            continue
        assert len(data) == size


def test_refusals_give_the_reason() -> None:
    with pytest.raises(DecodeError, match="a Betaflight motor packet has 16 bytes, got 3"):
        decode_motors(b"abc")
    with pytest.raises(DecodeError, match="not finite"):
        decode_motors(struct.pack("<4f", 0, 0, math.nan, 0))
