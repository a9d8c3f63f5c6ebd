"""Where the time of a drone comes from, and what waiting means in it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from skyloop.client.mailbox import Notifier
from skyloop.clock import Clock

if TYPE_CHECKING:
    from skyloop.client.connection import ConnectionSupervisor


class Scheduler:
    """Real time: waiting is sleeping, and a slow application misses samples.

    A replay that is stepped by its application has another one, in which waiting advances the time.
    """

    #: Whether callbacks are always called on the receiving thread, so that each gets all samples.
    in_step = False

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        self.clock = clock

    def notifier(self) -> Notifier:
        """Return a notifier for an application to wait for."""
        return Notifier()

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        """Attend to the connection from now on; called with the first session."""
        supervisor.attend_for_ever()

    def opened(self) -> None:
        """Called when the drone is connected, its state is known, and it may be commanded if that was asked for."""
