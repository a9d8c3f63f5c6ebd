"""Low-pass, complementary and median filters for irregularly sampled signals. Pure; the time step is an argument."""

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
    """A first-order low-pass filter for a number or array, exact for signals that are constant between samples.

    Solving ``T·y' + y = x`` with ``x`` constant over a step ``dt`` gives ``y ← y + (1 − exp(−dt/T))·(x − y)``
    (zero-order hold; Åström and Wittenmark, "Computer-Controlled Systems", 1997, section 2.3).

    Attributes:
        time_constant_s: Time constant, which can be changed at any time; with 0, every sample passes unchanged.
        value: The filtered value; None before the first sample, which passes unchanged.
    """

    def __init__(self, time_constant_s: float, value: Signal | None = None) -> None:
        """Initialise the filter.

        Args:
            time_constant_s: Time constant, 0 or more.
            value: Initial value; None to start from the first sample.

        Raises:
            UsageError: The time constant is negative or not finite.
        """
        self.time_constant_s = _time_constant(time_constant_s)
        self.value: Signal | None = value

    @classmethod
    def from_cutoff(cls, frequency_hz: float) -> LowPass[Signal]:
        """Create a low-pass filter from its cutoff frequency (−3 dB): ``T = 1 / (2π·f)``.

        Raises:
            UsageError: The frequency is not greater than 0.
        """
        if not frequency_hz > 0.0:
            raise UsageError(f"frequency_hz is {frequency_hz!r} and must be above 0")
        return cls(1.0 / (2.0 * math.pi * frequency_hz))

    def step(self, sample: Signal, dt_s: float) -> Signal:
        """Update with the next sample.

        Args:
            sample: A number, or an array that always has the same shape.
            dt_s: Time since the last sample.

        Returns:
            The filtered value.
        """
        if self.value is None:
            self.value = sample
        else:
            self.value = self.value + gain(self.time_constant_s, dt_s) * (sample - self.value)
        return self.value

    def reset(self, value: Signal | None = None) -> None:
        """Restart from a value; None to start from the next sample."""
        self.value = value


class Complementary:
    """Fuses an angle's rate, which responds at once but drifts, with measurements that are correct in the long run.

    The rate goes through a high-pass filter and the angle through a low-pass filter with the same time constant, so
    that their gains add up to one (Higgins, "A Comparison of Complementary and Kalman Filtering", IEEE Trans. AES
    11(3), 1975). Angles [rad] are wrapped, so crossing ±π counts as a small step.
    """

    def __init__(self, time_constant_s: float, angle: float | None = None) -> None:
        """Initialise the filter.

        Args:
            time_constant_s: Time constant: below it the rate dominates, above it the measured angle.
            angle: Initial angle; None to start from the first measurement.

        Raises:
            UsageError: The time constant is negative or not finite.
        """
        self._time_constant_s = _time_constant(time_constant_s)
        self.angle = angle  #: the filtered angle in [-π, π); None before the first measurement

    def step(self, rate: float, measured: float | None, dt_s: float) -> float | None:
        """Update with the next sample.

        Args:
            rate: Rate over the last ``dt_s`` [rad/s].
            measured: The measured angle at the end of ``dt_s`` [rad]; None if there is none.
            dt_s: Time since the last sample.

        Returns:
            The filtered angle; None before the first measurement.
        """
        if self.angle is None:
            self.angle = None if measured is None else wrap_angle(measured)
            return self.angle
        angle = self.angle + rate * dt_s
        if measured is not None:
            angle += gain(self._time_constant_s, dt_s) * wrap_angle(measured - angle)
        self.angle = wrap_angle(angle)
        return self.angle


class Median:
    """The median of the last samples of a number, which removes single outliers and keeps edges sharp.

    The result is always one of the samples; for an even number, it is the lower of the middle two.
    """

    def __init__(self, length: int = 5) -> None:
        """Initialise the filter.

        Args:
            length: Number of samples to keep; 1 or more.

        Raises:
            UsageError: The length is not an integer of at least 1.
        """
        if isinstance(length, bool) or not isinstance(length, int) or length < 1:
            raise UsageError(f"length is {length!r} and must be a whole number of at least 1")
        self._samples: deque[float] = deque(maxlen=length)

    def step(self, sample: float) -> float:
        """Add the next sample and return the median of the samples kept."""
        self._samples.append(sample)
        return sorted(self._samples)[(len(self._samples) - 1) // 2]


def gain(time_constant_s: float, dt_s: float) -> float:
    """Return the fraction of a step that a first-order filter covers within ``dt_s``: ``1 − exp(−dt/T)``."""
    if dt_s <= 0.0:
        return 0.0
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0.0 else 1.0


def _time_constant(value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise UsageError(f"time_constant_s is {value!r} and must be a number of seconds, 0 or more")
    return value
