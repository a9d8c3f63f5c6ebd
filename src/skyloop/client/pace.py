"""Where the time of a drone comes from, and what waiting means in it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from skyloop.client.slots import Bell
from skyloop.clock import Clock
from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.client.link import Link


class Pace:
    """Real time: waiting is sleeping, and whoever is slow misses something.

    A replay that goes as fast as its application has another one, in which waiting is what makes the time go on.
    """

    #: Listeners and processors are called where samples arrive, so that each gets all of them.
    in_step = False

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        self.clock = clock

    def bell(self) -> Bell:
        """For an application to wait at."""
        return Bell()

    def begin(self, link: Link) -> None:
        """The link is connected, and wants to be attended to from now on."""
        link.attend_for_ever()

    def opened(self) -> None:
        """The drone is connected, its state is known, and it may be commanded if that was asked for."""


class Way(Protocol):
    """How a vehicle's address is reached: by a private proxy, or within this process."""

    pace: Pace

    @property
    def reach(self) -> str | None:
        """What another process connects to for the same vehicle; None: nothing does."""

    def dialer(self, deadline_s: float) -> Dialer:
        """Makes connections; at first waits until somebody serves, at most until then (``time.monotonic``)."""

    def close(self) -> None:
        """End whatever was started. Idempotent."""
