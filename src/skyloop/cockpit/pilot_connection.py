"""A page's own pilot connection to a drone."""

from __future__ import annotations

from typing import Self

from skyloop.client import AuthorityStatus, Drone
from skyloop.client.actions import OUTDONE, OVERRULED
from skyloop.clock import monotonic_ns
from skyloop.errors import LinkError
from skyloop.extend import Known, commands, let_go, open_unasked
from skyloop.messages import AnyAction, FlightState, Idle, LinkState, Outcome
from skyloop.transport.base import Dialer


class PilotConnection(Drone):
    """A pilot's connection that asks for the authority when ``request`` is called, and not when it is opened.

    Without the authority it can stop the motors in an emergency, and nothing else.
    """

    _newest: tuple[AnyAction, int] = Idle(), 0  # what :meth:`command` sent last, and its number

    @classmethod
    def open(cls, dial: Dialer, app: str, timeout_s: float) -> Self:
        """Connect, without the authority.

        Args:
            dial: Makes a connection to the proxy each time one is needed.
            app: The name under which it connects.
            timeout_s: Time for the proxy to answer [s].

        Raises:
            SkyloopError: It can't be opened.
        """
        return open_unasked(cls, dial, app=app, timeout_s=timeout_s, on_exit="hover")

    def set_flown_by_person(self) -> None:
        """Hold nothing on its own, only while the page is known to be there, as a person flies by it."""
        commands(self).flown_by_person()

    def present_until(self, until_ns: int) -> None:
        """Count the page as present until then, on this process's monotonic clock; afterwards this pilot is silent."""
        commands(self).present_until(until_ns)

    @property
    def is_silent(self) -> bool:
        """Whether the page was not known to be there for too long."""
        return not commands(self).is_present(monotonic_ns())

    @property
    def is_linked(self) -> bool:
        """Whether there is a connection to the proxy now."""
        return self.link.application in (LinkState.UP, LinkState.DEGRADED)

    def acquire(self, priority: int, *, ask: bool = False) -> AuthorityStatus:
        """Ask for the authority now.

        Args:
            priority: 0 is the highest, 31 the lowest.
            ask: Whether the holder is asked first; this then waits in the queue instead of failing.

        Raises:
            AuthorityError: Another application has it; the message names which.
        """
        return self.request_authority(priority, takeover="ask" if ask else "now", stay=ask)

    def answer_takeover(self, lease: int, app_id: int, grant: bool, reason: str) -> None:
        """Answer who asks for the authority, and wait until the proxy has the answer.

        Args:
            lease: The lease under which this connection holds the authority.
            app_id: Who asked.
            grant: Whether to hand it over.
            reason: Why not, for a person.

        Raises:
            RefusedError: The authority is not held any more.
            LinkError: The proxy does not answer.
        """
        commands(self).answer(lease, app_id, grant, reason, wait=True)

    @property
    def proxy_now_ns(self) -> int:
        """The time on the proxy's clock, as estimated."""
        return monotonic_ns() + self.clock_offset_ns

    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point; see :meth:`Drone.command`."""
        sent = super().command(action)
        self._newest = action, commands(self).intent
        return sent

    def has_ended(self, action: AnyAction) -> bool:
        """Whether a failsafe, a lost link or a lost lease ended this action, and it could be sent again now."""
        newest, intent = self._newest
        outcome = commands(self).outcome(intent) if newest is action else None
        return outcome is not None and outcome.fate in OVERRULED and commands(self).may_ask

    @property
    def intent(self) -> int:
        """Number of the newest command."""
        return commands(self).intent

    def refusal(self, first: int) -> Outcome | None:
        """What the proxy refused, or ended, of the commands from this number on; None but for :meth:`has_ended`."""
        told = commands(self).told
        if told is None or told.reason is None or told.intent < first or told.fate in (*OUTDONE, *OVERRULED):
            return None
        return told

    @property
    def is_told(self) -> bool:
        """Whether the proxy tells what becomes of the newest command: it has arrived there."""
        newest, (_, intent) = Known(self).newest, self._newest
        outcome = None if newest is None else newest.outcome
        return outcome is not None and outcome.app_id == self.app_id and outcome.intent >= intent

    def let_go(self, reason: str, *, land: bool = False) -> bool:
        """Hover, or land, because the cockpit finds that it has to; see :func:`skyloop.extend.let_go`."""
        return let_go(self, reason, land=land)

    @property
    def is_flying(self) -> bool:
        """Whether the vehicle is under way, as far as is known."""
        try:
            return self.feedback().state is FlightState.FLYING
        except LinkError:
            return False
