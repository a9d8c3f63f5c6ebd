"""The emergency stop of all drivers: when it is sent, confirmed by the vehicle, abandoned or reset. Pure.

A driver knows how to tell that the motors are off, and which bytes stop them; this module decides everything else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.vehicle_session import VehicleEvent, message
from skyloop.errors import DriverError
from skyloop.messages import Severity

PACE_NS: Final = nanoseconds(0.1)  #: interval between two repeats
GIVE_UP_NS: Final = nanoseconds(10.0)  #: a stop not confirmed by the vehicle this long after the press is abandoned
AGAIN_NS: Final = nanoseconds(0.3)  #: after a pause this long, a request counts as a new press rather than a repeat
SETTLE_NS: Final = nanoseconds(0.5)  #: reports received sooner than this after the press may predate it


class MotorStop:
    """One emergency stop, from the press until it is reset or abandoned.

    While it is :attr:`active`, the driver sends and obeys nothing else. The stop is sent at once, whether or not data
    arrive from the vehicle, and again every 0.1 s until the vehicle confirms it; until then, the vehicle's own state is
    reported. If the vehicle has not confirmed it 10 s after the press, the stop ends: it must not be sent minutes
    later, and the vehicle must be free to land. Not thread-safe.
    """

    def __init__(self, give_up: Callable[[VehicleEvent], None]) -> None:
        self._give_up = give_up
        self._begun_ns: int | None = None  # time of the first press
        self._pressed_ns = 0  # time of the newest press that was not a repeat
        self._heard_ns = 0  # time of the newest press, including repeats
        self._sent_ns: int | None = None
        self._shown = self._was_shown = False

    @property
    def active(self) -> bool:
        """Whether it has been pressed, and neither reset nor abandoned since."""
        return self._begun_ns is not None

    @property
    def shown(self) -> bool:
        """Whether it is active and the vehicle last reported its motors off, so that the state is ``EMERGENCY``."""
        return self.active and self._shown

    def press(self, now_ns: int) -> None:
        """Stop the motors, or keep stopping them. Each press restarts the time limit."""
        if self._begun_ns is None:
            self._begun_ns, self._sent_ns, self._shown, self._was_shown = now_ns, None, False, False
            self._pressed_ns = now_ns
        elif now_ns - self._heard_ns >= AGAIN_NS:
            self._pressed_ns = now_ns
        self._heard_ns = now_ns

    def settled(self, seen_ns: int) -> bool:
        """Return whether a report received at ``seen_ns`` was certainly sent after the press."""
        return self._begun_ns is not None and seen_ns - self._begun_ns >= SETTLE_NS

    def step(self, shown: bool | None, now_ns: int) -> bool:
        """Advance an active stop; return whether to send it now. Call it at each tick, even without telemetry.

        Args:
            shown: Whether the vehicle reports that its motors are off; None if there is no new information.
            now_ns: The present time.
        """
        if self._begun_ns is None:
            return False
        if shown is not None:
            self._shown = shown
            self._was_shown |= shown
        if self._shown:
            return False
        if now_ns - self._pressed_ns >= GIVE_UP_NS:
            self._end_unshown()
            return False
        if self._sent_ns is not None and now_ns - self._sent_ns < PACE_NS:
            return False
        self._sent_ns = now_ns
        return True

    def reset(self) -> None:
        """Let the motors run again. Does nothing if no stop is active.

        Raises:
            DriverError: The vehicle has not confirmed the stop, which is still being sent.
        """
        if self.active and not self.shown:
            raise DriverError("the motors still run, or are still armed: the stop has not shown yet")
        self._begun_ns = None

    def _end_unshown(self) -> None:
        self._begun_ns = None
        if self._was_shown:
            text = "the emergency stop is over: someone else reset the vehicle or started its motors again"
        else:
            text = (
                f"the emergency stop has ended: the vehicle has not shown it for {seconds(GIVE_UP_NS):g} s, and may "
                "fly: land it, or stop it again"
            )
        self._give_up(message(text, "stop_given_up", Severity.ERROR))
