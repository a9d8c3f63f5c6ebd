"""A PID controller of one number, and a PI controller of a vector. Pure: the time step is an argument.

Åström and Hägglund, "Advanced PID Control", ISA 2006: the derivative acts on the measurement and through a filter
(section 3.3), what a limit takes off is fed back into the integral (back-calculation, section 3.5), and new gains do
not make the output jump, because the integral term, not the integral, is kept (section 3.6). The vector's integral
grows only as far as limits after the loop don't take off what it asks for (conditional integration, section 3.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.control.filters import LowPass, gain
from skyloop.control.limiting import clamped, shortened, within
from skyloop.errors import UsageError
from skyloop.messages.geometry import wrap_angle

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the error, its integral and its derivative, with their time constants.

    Raises:
        UsageError: A number is negative or not finite.
    """

    p: float = 1.0  #: output per error
    i: float = 0.0  #: output per error and second
    d: float = 0.0  #: output per change of the measurement a second
    derivative_filter_s: float = 0.05  #: time constant of the low pass before the derivative
    #: Time constant with which the integral term follows what a limit takes off; None: p/i, or at once without p.
    tracking_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("p", "i", "d", "derivative_filter_s", "tracking_s"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")

    @property
    def tracking_time_s(self) -> float:
        """The time constant of back-calculation in force [s]."""
        if self.tracking_s is not None:
            return self.tracking_s
        return self.p / self.i if self.i > 0.0 else 0.0


class Pid:
    """A PID loop of one number.

    :attr:`gains` may be replaced in flight. With an integral gain the output does not jump then, because the integral
    term takes up the difference; without one it changes no faster than the rate limit allows.
    """

    def __init__(
        self,
        gains: Gains,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        rate: float = math.inf,
        angle: bool = False,
    ) -> None:
        """Initialise the loop.

        Args:
            gains: The gains to begin with.
            low: Least output.
            high: Greatest output.
            rate: Greatest change of the output per second.
            angle: Whether set-point and measurement are angles [rad], whose difference is taken the short way round.

        Raises:
            UsageError: ``low`` is not below ``high``, or ``rate`` is not above 0.
        """
        if not low < high:
            raise UsageError(f"low is {low!r} and must be below high, which is {high!r}")
        if not rate > 0.0:
            raise UsageError(f"rate is {rate!r} and must be above 0")
        self._gains = gains
        self._low, self._high, self._rate = low, high, rate
        self._angle = angle
        self._integral = 0.0  # the term, in units of the output
        self._slope: LowPass[float] = LowPass(gains.derivative_filter_s, 0.0)
        self._measured: float | None = None
        self._error = 0.0
        self._unlimited = 0.0
        self._output: float | None = None
        self._dt_s = 0.0

    @property
    def gains(self) -> Gains:
        """The gains in force."""
        return self._gains

    @gains.setter
    def gains(self, new: Gains) -> None:
        old = self._gains
        if new.i > 0.0:
            slope = self._slope.value or 0.0
            self._integral += (old.p - new.p) * self._error - (old.d - new.d) * slope
        elif old.i > 0.0:
            self._integral = 0.0  # nothing would ever take it out again
        self._slope.time_constant_s = new.derivative_filter_s
        self._gains = new

    @property
    def integral(self) -> float:
        """The integral term, in units of the output."""
        return self._integral

    def step(self, set_point: float, measured: float, dt_s: float, feed_forward: float = 0.0) -> float:
        """Compute the output for a new measurement.

        Args:
            set_point: Where the measured value is to be.
            measured: The measured value, in the same unit.
            dt_s: Time since the last measurement [s].
            feed_forward: Is added to the output before the limits.

        Returns:
            The output, within ``low`` and ``high`` and the rate limit; as before where an argument is not finite.
        """
        if not all(map(math.isfinite, (set_point, measured, feed_forward, dt_s))):
            return 0.0 if self._output is None else self._output
        g = self._gains
        error = self._difference(set_point, measured)
        if self._measured is not None and dt_s > 0.0:
            self._slope.step(self._difference(measured, self._measured) / dt_s, dt_s)
            self._integral += g.i * error * dt_s
        self._measured, self._error, self._dt_s = measured, error, dt_s
        self._unlimited = feed_forward + g.p * error + self._integral - g.d * (self._slope.value or 0.0)
        limited = within(self._unlimited, self._low, self._high)
        if self._output is not None and self._rate < math.inf:
            nearer = self._output + clamped(limited - self._output, self._rate * max(0.0, dt_s))
            # The sum is rounded, and may be a last bit beyond the limit that it goes to.
            limited = min(nearer, limited) if limited >= self._output else max(nearer, limited)
        self.applied(limited)
        return limited

    def applied(self, output: float) -> None:
        """Report what was really applied of the last output, where a limit outside of this loop reduced it.

        The integral term follows it (back-calculation). :meth:`step` calls this with its own output.

        Args:
            output: What was applied.
        """
        if self._gains.i > 0.0:
            self._integral += gain(self._gains.tracking_time_s, self._dt_s) * (output - self._unlimited)
            self._unlimited = output
        self._output = output

    def reset(self, output: float = 0.0, *, set_point: float = 0.0, measured: float | None = None) -> None:
        """Restart with the integral term for which ``output`` is the next output, so that taking over is no jump.

        Without an integral gain the next output is what error and derivative give.

        Args:
            output: What was applied until now.
            set_point: The set-point now.
            measured: The measured value now; None counts the error as 0.
        """
        self._error = 0.0 if measured is None else self._difference(set_point, measured)
        self._integral = output - self._gains.p * self._error if self._gains.i > 0.0 else 0.0
        self._slope.reset(0.0)
        self._measured, self._output = measured, output

    def _difference(self, to: float, back: float) -> float:
        return wrap_angle(to - back) if self._angle else to - back


class VectorPi:
    """A PI loop of a vector. Its integral grows only by what is really applied, and not at all in a pause.

    Attributes:
        integral: The integral term, (n,), in units of the output.
    """

    def __init__(self, gains: Gains, dimensions: int, *, most: float = math.inf) -> None:
        """Initialise the loop.

        Args:
            gains: Their derivative and ``tracking_s`` are not used.
            dimensions: Of the vector.
            most: Greatest length of the integral term.
        """
        self.gains = gains
        self._most = most
        self._before = self.integral = np.zeros(dimensions)

    def step(self, error: Array, dt_s: float) -> Array:
        """Return the output (n,) for an error (n,) that lasted for ``dt_s`` [s]; report :meth:`applied` after it."""
        self._before = self.integral
        self.integral = shortened(self.integral + self.gains.i * error * dt_s, self._most)
        return self.gains.p * error + self.integral

    def applied(self, asked: Array, applied: Array) -> None:
        """Take back by how much the integral grew, along the axes in which less was applied than was asked for.

        Args:
            asked: All that was asked for with the last output in it, (n,).
            applied: What limits left of it, (n,).
        """
        wound_up = (applied - asked) * (self.integral - self._before) < 0.0
        self.integral = np.where(wound_up, self._before, self.integral)

    def reset(self) -> None:
        """Restart without an integral, because others flew, or what was measured is too old."""
        self._before = self.integral = np.zeros_like(self.integral)
