"""The emergency stop of every driver: when it is sent, when it counts as shown, when it is given up or reset. Pure.

A driver says what shows that the motors are off, and which bytes stop them; all else is decided here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.vehicle_session import VehicleEvent, message
from skyloop.errors import DriverError
from skyloop.messages import Severity

PACE_NS: Final = nanoseconds(0.1)  #: between two repeats
GIVE_UP_NS: Final = nanoseconds(10.0)  #: a stop that is not shown so long after the press is over
AGAIN_NS: Final = nanoseconds(0.3)  #: after such a pause it is pressed again; before, the library repeats a press
SETTLE_NS: Final = nanoseconds(0.5)  #: what the vehicle reports until then may be from before the stop


class MotorStop:
    """One emergency stop, from the press until it is reset or given up.

    While it is :attr:`active` the driver sends and obeys nothing else. It is sent at once, whether or not the vehicle
    is heard, and again every 0.1 s until the vehicle shows it; until then the vehicle is reported as what it does. A
    stop that the vehicle has not shown 10 s after the press is over: it is not sent minutes later, and the vehicle may
    be landed. Not thread-safe.
    """

    def __init__(self, give_up: Callable[[VehicleEvent], None]) -> None:
        self._give_up = give_up
        self._begun_ns: int | None = None  # the first press
        self._pressed_ns = 0  # the newest that was no repeat
        self._heard_ns = 0  # the newest, repeats included
        self._sent_ns: int | None = None
        self._shown = self._was_shown = False

    @property
    def active(self) -> bool:
        """Whether it was pressed, and neither reset nor given up since."""
        return self._begun_ns is not None

    @property
    def shown(self) -> bool:
        """Whether it is active, and the vehicle showed its motors off when last heard: report ``EMERGENCY``."""
        return self.active and self._shown

    def press(self, now_ns: int) -> None:
        """Stop the motors, now or on. A further press begins the time anew."""
        if self._begun_ns is None:
            self._begun_ns, self._sent_ns, self._shown, self._was_shown = now_ns, None, False, False
            self._pressed_ns = now_ns
        elif now_ns - self._heard_ns >= AGAIN_NS:
            self._pressed_ns = now_ns
        self._heard_ns = now_ns

    def settled(self, seen_ns: int) -> bool:
        """Return whether what was seen at ``seen_ns`` is surely from after the press."""
        return self._begun_ns is not None and seen_ns - self._begun_ns >= SETTLE_NS

    def step(self, shown: bool | None, now_ns: int) -> bool:
        """Go on with an active stop; return whether to send it now. Call it at each tick, heard or not.

        Args:
            shown: Whether the vehicle shows that its motors are off; None: nothing new is known.
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
        """Let the motors run again. Nothing happens without an active stop.

        Raises:
            DriverError: The vehicle has not shown the stop: it is still being sent.
        """
        if self.active and not self.shown:
            raise DriverError("the motors still run, or are still armed: the stop has not shown yet")
        self._begun_ns = None

    def _end_unshown(self) -> None:
        self._begun_ns = None
        if self._was_shown:
            text = "the emergency stop is over: the vehicle was reset, or its motors were started again, not from here"
        else:
            text = (
                f"the emergency stop is given up: the vehicle has not shown it for {seconds(GIVE_UP_NS):g} s, and may "
                "fly: land it, or stop it again"
            )
        self._give_up(message(text, "stop_given_up", Severity.ERROR))
