"""The vehicle's state at any recent time, from the samples before and after it. Pure."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

import msgspec

from skyloop.messages import Feedback, Vector

DEPTH = 256  #: samples kept: 8 s at 32 Hz


class FeedbackHistory:
    """The newest samples of feedback, ordered by capture time. One thread adds; any thread may read."""

    def __init__(self, depth: int = DEPTH) -> None:
        self._samples: deque[Feedback] = deque(maxlen=depth)

    def add(self, sample: Feedback) -> None:
        """Add a sample; one captured before the newest (a restarted proxy's) restarts the history."""
        samples = self._samples
        if samples and sample.captured_ns < samples[-1].captured_ns:
            samples.clear()
        samples.append(sample)

    def at(self, captured_ns: int) -> tuple[Feedback | None, float | None, bool]:
        """Return the state at a time on the proxy's clock.

        Args:
            captured_ns: The time.

        Returns:
            The state, its reach [s], and whether there was a sample on both sides. The reach is the time to the farther
            sample used. With samples on one side only the state is the nearest sample unchanged; with none, state and
            reach are None.
        """
        samples = list(self._samples)
        if not samples:
            return None, None, False
        after = bisect_left(samples, captured_ns, key=lambda sample: sample.captured_ns)
        if after < len(samples) and samples[after].captured_ns == captured_ns:
            return samples[after], 0.0, True
        if after in (0, len(samples)):
            nearest = samples[0] if after == 0 else samples[-1]
            return nearest, abs(nearest.captured_ns - captured_ns) / 1e9, False
        a, b = samples[after - 1], samples[after]
        reach_ns = max(captured_ns - a.captured_ns, b.captured_ns - captured_ns)
        return interpolate(a, b, captured_ns), reach_ns / 1e9, True


def interpolate(a: Feedback, b: Feedback, captured_ns: int) -> Feedback:
    """Return the state between two samples, linear in time, angles along the shorter way.

    What only one of them has, and what can't be interpolated (states, names), is taken from the nearer one.

    Args:
        a: The earlier sample.
        b: The later sample.
        captured_ns: A time between them.
    """
    share = (captured_ns - a.captured_ns) / (b.captured_ns - a.captured_ns)
    nearer = a if share < 0.5 else b
    return msgspec.structs.replace(
        nearer,
        captured_ns=captured_ns,
        battery=_number(a.battery, b.battery, share),
        battery_v=_number(a.battery_v, b.battery_v, share),
        roll_rad=_angle(a.roll_rad, b.roll_rad, share),
        pitch_rad=_angle(a.pitch_rad, b.pitch_rad, share),
        yaw_rad=_angle(a.yaw_rad, b.yaw_rad, share),
        altitude_m=_number(a.altitude_m, b.altitude_m, share),
        velocity_m_s=_vector(a.velocity_m_s, b.velocity_m_s, share),
        angular_velocity_rad_s=_vector(a.angular_velocity_rad_s, b.angular_velocity_rad_s, share),
        acceleration_m_s2=_vector(a.acceleration_m_s2, b.acceleration_m_s2, share),
        position_m=_vector(a.position_m, b.position_m, share),
    )


def _number(a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    return a + (b - a) * share


def _angle(a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    turn = math.remainder(b - a, math.tau)  # within [-π, π]: the shorter way
    return math.remainder(a + turn * share, math.tau)


def _vector(a: Vector | None, b: Vector | None, share: float) -> Vector | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    return (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, a[2] + (b[2] - a[2]) * share)
