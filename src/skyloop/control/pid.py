"""A PID controller for a number and a PI controller for a vector. Pure: the time step is an argument.

Both follow Åström and Hägglund, "Advanced PID Control", ISA 2006: the derivative acts on the measurement and is
filtered (section 3.3); what a limit cuts off is fed back into the integral (back-calculation, section 3.5); new gains
cause no jump of the output, because the integral term is kept rather than the integral (section 3.6). The vector's
integral grows only as far as later limits let its output through (conditional integration, section 3.5).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from skyloop.control.filters import LowPass, gain
from skyloop.control.limiting import Array, clamped, require_positive, shortened, within
from skyloop.errors import UsageError
from skyloop.messages.geometry import wrap_angle


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains for the error, its integral and its derivative, with their time constants.

    Raises:
        UsageError: A number is negative or not finite.
    """

    p: float = 1.0  #: output per unit of error
    i: float = 0.0  #: output per unit of error and second
    d: float = 0.0  #: output per change of the measurement per second
    derivative_filter_s: float = 0.05  #: time constant of the low pass before the derivative
    #: Time constant of the integral term following a limited output; None uses p/i, or none without p.
    tracking_s: float | None = None

    def __post_init__(self) -> None:
        given = {name: value for name, value in asdict(self).items() if value is not None}
        require_positive(given, **given)

    @property
    def tracking_time_s(self) -> float:
        """Effective time constant of back-calculation [s]."""
        if self.tracking_s is not None:
            return self.tracking_s
        return self.p / self.i if self.i > 0.0 else 0.0


class Pid:
    """A PID loop for a number.

    :attr:`gains` can be replaced in flight. With an integral gain the output does not jump, because the integral term
    absorbs the difference; without one the output changes no faster than the rate limit allows.
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
            gains: Initial gains.
            low: Minimum output.
            high: Maximum output.
            rate: Maximum change of the output per second.
            angle: Whether set-point and measurement are angles [rad], whose difference is the shorter way around.

        Raises:
            UsageError: ``low`` is not less than ``high``, or ``rate`` is not greater than 0.
        """
        if not low < high:
            raise UsageError(f"low is {low!r} and must be below high, which is {high!r}")
        if not rate > 0.0:
            raise UsageError(f"rate is {rate!r} and must be above 0")
        self._gains = gains
        self._low, self._high, self._rate = low, high, rate
        self._angle = angle
        self._integral = 0.0  # the integral term, in units of the output
        self._slope: LowPass[float] = LowPass(gains.derivative_filter_s, 0.0)
        self._measured: float | None = None
        self._error = 0.0
        self._unlimited = 0.0
        self._output: float | None = None
        self._dt_s = 0.0

    @property
    def gains(self) -> Gains:
        """The current gains."""
        return self._gains

    @gains.setter
    def gains(self, new: Gains) -> None:
        old = self._gains
        if new.i > 0.0:
            slope = self._slope.value or 0.0
            self._integral += (old.p - new.p) * self._error - (old.d - new.d) * slope
        elif old.i > 0.0:
            self._integral = 0.0  # nothing would ever remove it
        self._slope.time_constant_s = new.derivative_filter_s
        self._gains = new

    @property
    def integral(self) -> float:
        """The integral term, in units of the output."""
        return self._integral

    def step(self, set_point: float, measured: float, dt_s: float, feed_forward: float = 0.0) -> float:
        """Compute the output for a new measurement.

        Args:
            set_point: The wanted value.
            measured: The measured value, in the same unit.
            dt_s: Time since the last measurement [s].
            feed_forward: Value that is added to the output before the limits.

        Returns:
            The output, within ``low`` and ``high`` and the rate limit; unchanged if an argument is not finite.
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
            # Rounding may take the sum one bit beyond the limit.
            limited = min(nearer, limited) if limited >= self._output else max(nearer, limited)
        self.applied(limited)
        return limited

    def applied(self, output: float) -> None:
        """Report the output actually applied, if a limit outside this loop reduced it.

        The integral term follows it (back-calculation). :meth:`step` calls this with its own limited output.

        Args:
            output: The applied output.
        """
        if self._gains.i > 0.0:
            self._integral += gain(self._gains.tracking_time_s, self._dt_s) * (output - self._unlimited)
            self._unlimited = output
        self._output = output

    def reset(self, output: float = 0.0, *, set_point: float = 0.0, measured: float | None = None) -> None:
        """Restart with the integral term that makes ``output`` the next output, so that taking over causes no jump.

        Without an integral gain, the error and the derivative alone determine the next output.

        Args:
            output: The output applied until now.
            set_point: The current set-point.
            measured: The current measured value; None assumes an error of 0.
        """
        self._error = 0.0 if measured is None else self._difference(set_point, measured)
        self._integral = output - self._gains.p * self._error if self._gains.i > 0.0 else 0.0
        self._slope.reset(0.0)
        self._measured, self._output = measured, output

    def _difference(self, to: float, back: float) -> float:
        return wrap_angle(to - back) if self._angle else to - back


class VectorPi:
    """A PI loop for a vector. Its integral grows only as far as the output is applied, and not during pauses.

    Attributes:
        integral: The integral term, (n,), in units of the output.
    """

    def __init__(self, gains: Gains, dimensions: int, *, most: float = math.inf) -> None:
        """Initialise the loop.

        Args:
            gains: The gains; the derivative's and ``tracking_s`` are unused.
            dimensions: Length of the vector.
            most: Maximum magnitude of the integral term.
        """
        self.gains = gains
        self._most = most
        self._before = self.integral = np.zeros(dimensions)

    def step(self, error: Array, dt_s: float) -> Array:
        """Return the output (n,) for an error (n,) that lasted ``dt_s`` [s]; call :meth:`applied` afterwards."""
        self._before = self.integral
        self.integral = shortened(self.integral + self.gains.i * error * dt_s, self._most)
        return self.gains.p * error + self.integral

    def applied(self, asked: Array, applied: Array) -> None:
        """Undo the integral's growth along the axes in which limits cut the output off.

        Args:
            asked: The whole set-point that contains the last output, (n,).
            applied: The same set-point after the limits, (n,).
        """
        wound_up = (applied - asked) * (self.integral - self._before) < 0.0
        self.integral = np.where(wound_up, self._before, self.integral)

    def reset(self) -> None:
        """Restart with the integral at zero, because another client flew or the measurement is too old."""
        self._before = self.integral = np.zeros_like(self.integral)
