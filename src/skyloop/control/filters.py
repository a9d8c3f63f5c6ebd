"""Filters of signals that come at uneven times: low pass, complementary, median. Pure: the time step is an argument."""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages.geometry import wrap_angle

Signal = TypeVar("Signal", float, NDArray[np.float64])


class LowPass(Generic[Signal]):
    """First-order low pass of a number or an array, exact for a signal that is held between two samples.

    From ``T·y' + y = x`` with ``x`` constant over a step ``dt``: ``y ← y + (1 − exp(−dt/T))·(x − y)`` (zero-order
    hold; Åström and Wittenmark, "Computer-Controlled Systems", 1997, section 2.3). ``time_constant_s`` 0 passes all.
    """

    def __init__(self, time_constant_s: float, value: Signal | None = None) -> None:
        self.time_constant_s = _time_constant(time_constant_s)
        self.value: Signal | None = value  #: None before the first sample, which is taken as it is

    @classmethod
    def from_cutoff(cls, frequency_hz: float) -> LowPass[Signal]:
        """By the frequency at which a sine loses 3 dB: ``T = 1 / (2π·f)``."""
        if not frequency_hz > 0.0:
            raise UsageError(f"frequency_hz is {frequency_hz!r} and must be above 0")
        return cls(1.0 / (2.0 * math.pi * frequency_hz))

    def step(self, sample: Signal, dt_s: float) -> Signal:
        """Take the next sample, ``dt_s`` after the last, and return the filtered value."""
        if self.value is None:
            self.value = sample
        else:
            self.value = self.value + gain(self.time_constant_s, dt_s) * (sample - self.value)
        return self.value

    def reset(self, value: Signal | None = None) -> None:
        """Begin anew, from a value or from the next sample."""
        self.value = value


class Complementary:
    """An angle from its rate, right at once but drifting, and from a measurement, right in the long run.

    The rate passes a high pass and the angle a low pass with the same time constant, which add up to one (Higgins, "A
    Comparison of Complementary and Kalman Filtering", IEEE Trans. AES 11(3), 1975). Angles [rad] are wrapped, so that
    a turn through ±π is a small one.
    """

    def __init__(self, time_constant_s: float, angle: float | None = None) -> None:
        """``time_constant_s``: up to about how long the rate is believed more than the angle."""
        self._time_constant_s = _time_constant(time_constant_s)
        self.angle = angle  #: within [-π, π); None before the first measurement

    def step(self, rate: float, measured: float | None, dt_s: float) -> float | None:
        """Take the rate [rad/s] over the last ``dt_s`` and the angle measured at its end, None where there is none."""
        if self.angle is None:
            self.angle = None if measured is None else wrap_angle(measured)
            return self.angle
        angle = self.angle + rate * dt_s
        if measured is not None:
            angle += gain(self._time_constant_s, dt_s) * wrap_angle(measured - angle)
        self.angle = wrap_angle(angle)
        return self.angle


class Median:
    """The median of the last ``length`` samples of a number: takes out single wild ones, and keeps edges sharp.

    Of an even number of samples it is the lower one of the two in the middle, so that it is always a sample.
    """

    def __init__(self, length: int = 5) -> None:
        if isinstance(length, bool) or not isinstance(length, int) or length < 1:
            raise UsageError(f"length is {length!r} and must be a whole number of at least 1")
        self._samples: deque[float] = deque(maxlen=length)

    def step(self, sample: float) -> float:
        """Take the next sample and return the median of those kept."""
        self._samples.append(sample)
        return sorted(self._samples)[(len(self._samples) - 1) // 2]


def gain(time_constant_s: float, dt_s: float) -> float:
    """The share of the difference that a first-order filter takes up within ``dt_s``: ``1 − exp(−dt/T)``."""
    if dt_s <= 0.0:
        return 0.0
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0.0 else 1.0


def _time_constant(value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise UsageError(f"time_constant_s is {value!r} and must be a number of seconds, 0 or more")
    return value
