"""Flights of the high-level commander as functions of time: smooth moves, spirals, and uploaded polynomials. Pure.

Places are x, y, z of the vehicle's estimate [m] and yaw [rad].
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from skyloop.errors import DecodeError
from skyloop.messages.geometry import turned, wrap_angle

Place = tuple[float, float, float, float]  #: x, y, z, yaw


@dataclass(frozen=True, slots=True)
class Sample:
    """Where a flight is at one time, and how fast: velocities in m/s and rad/s."""

    place: Place
    velocity: Place


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight. ``at`` is called with times from 0 to ``duration_s``; afterwards the vehicle hovers at its end."""

    duration_s: float
    at: Callable[[float], Sample]

    def sample(self, time_s: float) -> Sample:
        if time_s >= self.duration_s:
            return Sample(self.at(self.duration_s).place, (0.0, 0.0, 0.0, 0.0))
        return self.at(max(0.0, time_s))


Polynomial = Sequence[float]  # coefficients, the constant first

#: From 0 to 1 without velocity, acceleration and jerk at both ends.
_STEP: Final = (0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0)
#: From 0 to 0 with velocity 1 at the start, and as above otherwise.
_SLOWING: Final = (0.0, 1.0, 0.0, 0.0, -20.0, 45.0, -36.0, 10.0)


def _value(polynomial: Polynomial, x: float) -> float:
    total = 0.0
    for coefficient in reversed(polynomial):
        total = total * x + coefficient
    return total


def _slope(polynomial: Polynomial) -> Polynomial:
    return [power * coefficient for power, coefficient in enumerate(polynomial)][1:]


_STEP_SLOPE, _SLOWING_SLOPE = _slope(_STEP), _slope(_SLOWING)


def move(start: Sample, end: Place, duration_s: float, *, linear: bool = False) -> Flight:
    """Fly from a place and velocity to a place, smoothly, or at constant speed; turn the shorter way."""
    duration_s = max(duration_s, 0.01)
    x, y, z, yaw = end
    end = (x, y, z, start.place[3] + wrap_angle(yaw - start.place[3]))

    def at(time_s: float) -> Sample:
        share = time_s / duration_s
        done, rate, drift, drift_rate = share, 1.0, 0.0, 0.0
        if not linear:
            done, rate = _value(_STEP, share), _value(_STEP_SLOPE, share)
            drift, drift_rate = _value(_SLOWING, share), _value(_SLOWING_SLOPE, share)
        rows = [
            (a + (b - a) * done + v * duration_s * drift, (b - a) / duration_s * rate + v * drift_rate)
            for a, b, v in zip(start.place, end, start.velocity, strict=True)
        ]
        return _sample(rows)

    return Flight(duration_s, at)


def spiral(
    start: Place, angle: float, radii: tuple[float, float], ascent: float, duration_s: float, *, sideways: bool
) -> Flight:
    """Fly around a centre by an angle, positive counter-clockwise, while the distance from it changes.

    The centre is ahead if the vehicle flies sideways, facing it, and otherwise on the side that it turns to.
    """
    x, y, z, yaw = start
    side = 0.0 if sideways else math.copysign(math.pi / 2, angle)
    cx, cy = x + radii[0] * math.cos(yaw + side), y + radii[0] * math.sin(yaw + side)

    def place(time_s: float) -> Place:
        share = time_s / duration_s
        radius = radii[0] + (radii[1] - radii[0]) * share
        toward = yaw + side + angle * share
        return cx - radius * math.cos(toward), cy - radius * math.sin(toward), z + ascent * share, yaw + angle * share

    return Flight(duration_s, lambda time_s: _numeric(place, time_s, duration_s))


def trajectory(
    pieces: Sequence[Flight], start: Place, time_scale: float, *, relative: bool, relative_yaw: bool, backwards: bool
) -> Flight:
    """Fly pieces one after another, each longer by ``time_scale``; if ``relative``, from the place where it starts."""
    total = sum(piece.duration_s for piece in pieces)

    def raw(time_s: float) -> Sample:
        left = total - time_s if backwards else time_s
        for piece in pieces[:-1]:
            if left <= piece.duration_s:
                return piece.at(left)
            left -= piece.duration_s
        return pieces[-1].at(min(left, pieces[-1].duration_s))

    x0, y0, z0, _ = raw(0.0).place if relative else (0.0, 0.0, 0.0, 0.0)
    turn = wrap_angle(start[3] - raw(0.0).place[3]) if relative_yaw else 0.0
    base = start if relative else (0.0, 0.0, 0.0, 0.0)

    def at(time_s: float) -> Sample:
        sample = raw(time_s / time_scale)
        x, y, z, yaw = sample.place
        x, y = turned(x - x0, y - y0, turn)
        vx, vy, vz, rate = (part / time_scale * (-1 if backwards else 1) for part in sample.velocity)
        vx, vy = turned(vx, vy, turn)
        heading = yaw + turn
        return Sample((base[0] + x, base[1] + y, base[2] + z - z0, heading), (vx, vy, vz, rate))

    return Flight(total * time_scale, at)


# Uploaded pieces -----------------------------------------------------------------------------------------------------

_PIECE: Final = struct.Struct("<33f")  # eight coefficients each for x, y, z and yaw, then the duration
_START: Final = struct.Struct("<4h")  # x, y, z [mm] and yaw [0.1 degrees]
_HEAD: Final = struct.Struct("<BH")  # two bits for each of x, y, z, yaw, then the duration [ms]
_POINTS: Final = (0, 1, 3, 7)  # control points after the first, by those bits
_YAW_UNIT_RAD: Final = math.radians(0.1)


def polynomials(memory: bytes, offset: int, count: int) -> list[Flight]:
    """Read pieces. Raises :class:`DecodeError` if the memory is too short, or a duration is not positive and finite."""
    found = []
    for at in range(offset, offset + count * _PIECE.size, _PIECE.size):
        try:
            *numbers, duration_s = _PIECE.unpack_from(memory, at)
        except struct.error:
            raise DecodeError("the trajectory reaches beyond the memory") from None
        if not all(map(math.isfinite, numbers)):
            raise DecodeError("a coefficient of the trajectory is not finite")
        found.append(_piece([numbers[n : n + 8] for n in range(0, 32, 8)], duration_s))
    return found


def _piece(axes: Sequence[Polynomial], duration_s: float) -> Flight:
    if not (math.isfinite(duration_s) and duration_s > 0):
        raise DecodeError(f"a piece of the trajectory lasts {duration_s} s")
    slopes = [_slope(axis) for axis in axes]

    def at(time_s: float) -> Sample:
        return _sample([(_value(a, time_s), _value(s, time_s)) for a, s in zip(axes, slopes, strict=True)])

    return Flight(duration_s, at)


def compressed_pieces(memory: bytes, offset: int, count: int) -> list[Flight]:
    """Read pieces given by Bézier curves, whose first control points are the ends of the piece before.

    A duration of 0 ends them early: clients count the start as a piece. Raises :class:`DecodeError` if there is none,
    or the memory is too short.
    """
    found: list[Flight] = []
    try:
        at = offset + _START.size
        ends = list(_START.unpack_from(memory, offset))
        for _ in range(count):
            kinds, duration_ms = _HEAD.unpack_from(memory, at)
            at += _HEAD.size
            if duration_ms == 0:
                break
            curves = []
            for axis in range(4):
                more = _POINTS[kinds >> 2 * axis & 3]
                points = [ends[axis], *struct.unpack_from(f"<{more}h", memory, at)]
                at += 2 * more
                ends[axis] = points[-1]
                unit = _YAW_UNIT_RAD if axis == 3 else 0.001
                curves.append([unit * point for point in points])
            found.append(_curve(curves, duration_ms / 1000))
    except struct.error:
        raise DecodeError("the trajectory reaches beyond the memory") from None
    if not found:
        raise DecodeError("the trajectory has no pieces")
    return found


def _curve(curves: Sequence[Sequence[float]], duration_s: float) -> Flight:
    slopes = [[(len(c) - 1) * (b - a) for a, b in pairwise(c)] or [0.0] for c in curves]

    def at(time_s: float) -> Sample:
        share = time_s / duration_s
        return _sample(
            [(_bezier(c, share), _bezier(s, share) / duration_s) for c, s in zip(curves, slopes, strict=True)]
        )

    return Flight(duration_s, at)


def _bezier(points: Sequence[float], share: float) -> float:
    row = list(points)
    while len(row) > 1:
        row = [a + (b - a) * share for a, b in pairwise(row)]
    return row[0]


def _sample(rows: Sequence[tuple[float, float]]) -> Sample:
    (x, vx), (y, vy), (z, vz), (yaw, rate) = rows
    return Sample((x, y, z, yaw), (vx, vy, vz, rate))


def _numeric(place: Callable[[float], Place], time_s: float, duration_s: float) -> Sample:
    step_s = 1e-3 * duration_s
    before, after = place(max(0.0, time_s - step_s)), place(min(duration_s, time_s + step_s))
    over_s = min(duration_s, time_s + step_s) - max(0.0, time_s - step_s)
    return _sample([(here, (b - a) / over_s) for here, a, b in zip(place(time_s), before, after, strict=True)])
