"""A PID controller for scalars and a PI controller for vectors. Pure; the time step is an argument.

Both follow Åström and Hägglund, "Advanced PID Control", ISA 2006. The derivative acts on the measurement and is
filtered (section 3.3). The part of the output cut off by limits is fed back into the integral (back-calculation,
section 3.5). New gains don't make the output jump, because the integral term is stored, not the integral (section 3.6).
The vector controller stops integrating along axes with limited output (conditional integration, section 3.5).
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
    """Gains for the error, its integral and its derivative, with the associated time constants.

    Raises:
        UsageError: A number is negative or not finite.
    """

    p: float = 1.0  #: output per unit of error
    i: float = 0.0  #: output per unit of error per second
    d: float = 0.0  #: output per unit of the measurement's rate of change
    derivative_filter_s: float = 0.05  #: time constant of the derivative's low-pass filter
    #: Time constant with which the integral term follows a limited output; None means p/i.
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
    """A PID controller for a scalar.

    :attr:`gains` can be replaced in flight. If the new integral gain is not 0, the output does not jump, because the
    integral term absorbs the difference; otherwise the output changes no faster than the rate limit allows.
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
        """Initialise the controller.

        Args:
            gains: Initial gains.
            low: Minimum output.
            high: Maximum output.
            rate: Maximum change of the output per second.
            angle: Whether set-point and measurement are angles [rad], whose difference is taken the shorter way around.

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
            self._integral = 0.0  # without an integral gain, the term would never change
        self._slope.time_constant_s = new.derivative_filter_s
        self._gains = new

    @property
    def integral(self) -> float:
        """The integral term, in units of the output."""
        return self._integral

    def step(self, set_point: float, measured: float, dt_s: float, feed_forward: float = 0.0) -> float:
        """Compute the output for a new measurement.

        Args:
            set_point: The desired value.
            measured: The measured value, in the same unit.
            dt_s: Time since the last measurement [s].
            feed_forward: Value added to the output before the limits are applied.

        Returns:
            The output, between ``low`` and ``high`` and within the rate limit; unchanged if an argument is not finite.
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
            # Rounding may carry the sum one bit beyond the limit.
            limited = min(nearer, limited) if limited >= self._output else max(nearer, limited)
        self.applied(limited)
        return limited

    def applied(self, output: float) -> None:
        """Report the output that was actually applied, in case a limit outside this controller reduced it.

        The integral follows that output (back-calculation). :meth:`step` calls this with its own limited output.

        Args:
            output: The applied output.
        """
        if self._gains.i > 0.0:
            self._integral += gain(self._gains.tracking_time_s, self._dt_s) * (output - self._unlimited)
            self._unlimited = output
        self._output = output

    def reset(self, output: float = 0.0, *, set_point: float = 0.0, measured: float | None = None) -> None:
        """Restart with an integral term that makes the next output equal to ``output``, to avoid a jump on takeover.

        Without an integral gain, the next output depends only on the error and the derivative.

        Args:
            output: The output applied so far.
            set_point: The current set-point.
            measured: The current measured value; None means an error of 0.
        """
        self._error = 0.0 if measured is None else self._difference(set_point, measured)
        self._integral = output - self._gains.p * self._error if self._gains.i > 0.0 else 0.0
        self._slope.reset(0.0)
        self._measured, self._output = measured, output

    def _difference(self, to: float, back: float) -> float:
        return wrap_angle(to - back) if self._angle else to - back


class VectorPi:
    """A PI controller for vectors. Its integral doesn't grow along axes with limited output or during pauses.

    Attributes:
        integral: The integral term, (n,), in units of the output.
    """

    def __init__(self, gains: Gains, dimensions: int, *, most: float = math.inf) -> None:
        """Initialise the controller.

        Args:
            gains: The gains; the derivative gain and ``tracking_s`` are not used.
            dimensions: Length of the vector.
            most: Maximum magnitude of the integral term.
        """
        self.gains = gains
        self._most = most
        self._before = self.integral = np.zeros(dimensions)

    def step(self, error: Array, dt_s: float) -> Array:
        """Return the output (n,) for an error (n,) over a time step [s]; call :meth:`applied` afterwards."""
        self._before = self.integral
        self.integral = shortened(self.integral + self.gains.i * error * dt_s, self._most)
        return self.gains.p * error + self.integral

    def applied(self, asked: Array, applied: Array) -> None:
        """Undo the integral's growth along axes in which the output was limited.

        Args:
            asked: The complete set-point, which includes the last output, (n,).
            applied: The same set-point after limiting, (n,).
        """
        wound_up = (applied - asked) * (self.integral - self._before) < 0.0
        self.integral = np.where(wound_up, self._before, self.integral)

    def reset(self) -> None:
        """Restart with the integral at zero, because another client flew the vehicle or the measurement is too old."""
        self._before = self.integral = np.zeros_like(self.integral)
