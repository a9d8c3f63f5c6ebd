"""Flights as functions of time: smooth, continuous, and the same as their pieces."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.crazyflie.emulator.trajectories import (
    Flight,
    Sample,
    compressed_pieces,
    move,
    polynomials,
    spiral,
    trajectory,
)

STILL = (0.0, 0.0, 0.0, 0.0)
parts = st.tuples(*[st.floats(-3.0, 3.0)] * 4)


def smooth(flight: Flight) -> None:
    """Check that velocities are the slopes of places."""
    step = 1e-4
    for n in range(1, 20):
        time_s = n / 20 * flight.duration_s
        before, now, after = flight.sample(time_s - step), flight.sample(time_s), flight.sample(time_s + step)
        for a, b, v in zip(before.place, after.place, now.velocity, strict=True):
            assert (b - a) / (2 * step) == pytest.approx(v, abs=0.02 + 0.01 * abs(v))


@given(parts, parts, parts, st.floats(0.5, 10.0))
def test_moves_begin_and_end_as_asked(
    start: tuple[float, ...], end: tuple[float, ...], velocity: tuple[float, ...], duration_s: float
) -> None:
    begin = Sample((start[0], start[1], start[2], start[3]), (velocity[0], velocity[1], velocity[2], 0.0))
    flight = move(begin, (end[0], end[1], end[2], end[3]), duration_s)
    first, last = flight.sample(0.0), flight.sample(duration_s + 1.0)
    assert first.place == pytest.approx(begin.place)
    assert first.velocity == pytest.approx(begin.velocity)
    assert last.place[:3] == pytest.approx(end[:3], abs=1e-6)
    assert abs(math.remainder(last.place[3] - end[3], math.tau)) < 1e-6
    assert abs(last.place[3] - start[3]) <= math.pi + 1e-6
    assert flight.at(duration_s).velocity == pytest.approx(STILL, abs=1e-4)
    smooth(flight)


def test_linear_moves_and_spirals_are_smooth() -> None:
    linear = move(Sample(STILL, STILL), (1.0, 2.0, 3.0, 1.0), 4.0, linear=True)
    assert linear.sample(2.0) == Sample((0.5, 1.0, 1.5, 0.5), (0.25, 0.5, 0.75, 0.25))
    smooth(spiral((1.0, 2.0, 3.0, 0.5), -2.0, (0.5, 1.0), 1.0, 5.0, sideways=True))
    smooth(spiral((1.0, 2.0, 3.0, 0.5), 7.0, (0.5, 0.2), 1.0, 5.0, sideways=False))


def test_polynomials_one_after_another() -> None:
    first = [0.0, 1.0] + [0.0] * 6 + [0.0] * 8 + [1.0] + [0.0] * 7 + [0.0] * 8 + [2.0]
    second = [2.0, 1.0, 0.5] + [0.0] * 5 + [0.0] * 8 + [1.0] + [0.0] * 7 + [0.0] * 8 + [1.0]
    memory = bytes(10) + struct.pack("<66f", *first, *second)
    pieces = polynomials(memory, 10, 2)
    flight = trajectory(pieces, STILL, 2.0, relative=False, relative_yaw=False, backwards=False)
    assert flight.duration_s == 6.0
    assert flight.sample(2.0) == Sample((1.0, 0.0, 1.0, 0.0), (0.5, 0.0, 0.0, 0.0))
    assert flight.sample(6.0).place == (3.5, 0.0, 1.0, 0.0)
    back = trajectory(pieces, (5.0, 5.0, 2.0, math.pi / 2), 1.0, relative=True, relative_yaw=True, backwards=True)
    assert back.sample(0.0).place == pytest.approx((5.0, 5.0, 2.0, math.pi / 2))
    assert back.sample(3.0).place == pytest.approx((5.0, 1.5, 2.0, math.pi / 2))
    smooth(back)
    with pytest.raises(DecodeError, match="beyond"):
        polynomials(memory, 11, 2)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_pieces_that_cannot_be_flown(bad: float) -> None:
    with pytest.raises(DecodeError, match="piece"):
        polynomials(struct.pack("<33f", *[0.0] * 32, bad), 0, 1)
    if not math.isfinite(bad):
        with pytest.raises(DecodeError, match="finite"):
            polynomials(struct.pack("<33f", bad, *[0.0] * 31, 1.0), 0, 1)


def test_compressed_pieces() -> None:
    start = struct.pack("<4h", 1000, 2000, 3000, 286)
    piece = struct.pack("<BH11h", 0b11_00_10_01, 2000, 1500, 1000, 2000, 3000, *[57] * 7)
    (flight,) = compressed_pieces(start + piece + bytes(20), 0, 2)
    assert flight.duration_s == 2.0
    assert flight.sample(0.0).place == pytest.approx((1.0, 2.0, 3.0, math.radians(28.6)))
    assert flight.sample(2.0).place == pytest.approx((1.5, 3.0, 3.0, math.radians(5.7)))
    assert flight.sample(1.0).velocity[0] == pytest.approx(0.25)
    smooth(flight)
    with pytest.raises(DecodeError, match="no pieces"):
        compressed_pieces(bytes(100), 0, 3)
    with pytest.raises(DecodeError, match="beyond"):
        compressed_pieces(start + piece, 0, 2)
