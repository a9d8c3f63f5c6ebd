"""Whose flight this is: who began it, and who steers. Pure: the time is an argument.

The proxy steers only for an application's own, new intent, or to end a flight that it began itself. What others arm,
fly, switch or land is observed, reported, and left alone. The rules in words are in ``docs/proxy.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.messages import FlightState

#: A take-off that was asked for so long ago and does not show is none of ours any more: drivers give one up sooner.
CLAIM_NS: Final = nanoseconds(15.0)
#: A flight is over when the vehicle stood for so long: one that bounces, or reports so for a moment, still flies.
STANDING_NS: Final = nanoseconds(1.0)

_GROUNDED: Final = (FlightState.LANDED, FlightState.EMERGENCY)


class Whose(Enum):
    """Who began the flight, or steers since."""

    NOBODYS = auto()  #: the vehicle does not fly, as far as is known
    OURS = auto()  #: an application of this proxy does, or this proxy ends what one began
    OTHERS = auto()  #: somebody else does: a remote control, a ground station, another program


@dataclass(frozen=True, slots=True)
class Changed:
    """The flight is somebody else's now. ``why``: to be published, empty where it is already."""

    whose: Whose
    why: str = ""


class Ownership:
    """Whose the flight of one vehicle is. ``shared``: somebody else may fly it besides; else it is never others'."""

    def __init__(self, *, shared: bool = True) -> None:
        self._shared = shared
        self.whose = Whose.NOBODYS
        self.left_to = ""  #: what others made of it, in the driver's word
        self._began_before = False  # an earlier run of this proxy began what flies now
        self._claimed_ns: int | None = None  # when a take-off was asked for last
        self._grounded_ns: int | None = None  # since when it stands

    @property
    def ours(self) -> bool:
        """Whether the proxy may hold, land or stop the vehicle by itself."""
        return self.whose is Whose.OURS

    @property
    def others(self) -> str:
        """Why the vehicle is left alone, for a person; empty where it is not somebody else's."""
        if self.whose is not Whose.OTHERS:
            return ""
        if self.left_to:
            return f"the vehicle is in {self.left_to}, which was not chosen here"
        return "the vehicle is flown by others"

    def began_before(self) -> None:
        """Take a vehicle that is found in the air now to be on a flight that an earlier run of this proxy began."""
        self._began_before = True

    def claim(self, now_ns: int) -> None:
        """Note that a take-off is asked for: the flight that comes of it is ours."""
        self._claimed_ns = now_ns
        if self.whose is Whose.NOBODYS:
            self.whose = Whose.OURS

    def take(self) -> None:
        """Note that an application's new intent was carried out: whatever flies is ours from here on."""
        self.whose, self.left_to = Whose.OURS, ""

    def observe(self, state: FlightState, airborne: bool, left_to: str, now_ns: int) -> Changed | None:
        """Observe the vehicle. ``left_to``: what others chose since we steered last, as the driver observes it."""
        before = self.whose
        if state in _GROUNDED:
            self._stands(now_ns)
        else:
            self._grounded_ns = None
            if airborne:
                self._claimed_ns = None  # the take-off shows
            if left_to:
                self.whose, self.left_to = Whose.OTHERS, left_to
            elif airborne and self.whose is Whose.NOBODYS:
                self.whose = Whose.OURS if self._began_before or not self._shared else Whose.OTHERS
            if airborne:
                self._began_before = False
        return None if self.whose is before else Changed(self.whose, self._words(before))

    def _stands(self, now_ns: int) -> None:
        if self._grounded_ns is None:
            self._grounded_ns = now_ns
        standing = now_ns - self._grounded_ns >= STANDING_NS
        if standing:
            self._began_before = False
        claimed = self._claimed_ns is not None and now_ns - self._claimed_ns < CLAIM_NS
        if not claimed and (standing or not self.ours):
            self.whose, self.left_to, self._claimed_ns = Whose.NOBODYS, "", None

    def _words(self, before: Whose) -> str:
        if before is not Whose.NOBODYS or self.left_to or not self._shared:
            return ""  # the driver reported who took it, or the flight is over, or it can't be anybody else's
        if self.whose is Whose.OURS:
            return "the vehicle is on a flight that this proxy began before it was restarted"
        return "the vehicle is flown by others: it is left alone until an application takes off, hovers or lands it"
