"""A page's hands on a drone: a pilot's connection of its own."""

from __future__ import annotations

from typing import Any

from skyloop.client import AuthorityStatus, Drone
from skyloop.client.pilot import ANSWER_S
from skyloop.clock import monotonic_ns
from skyloop.errors import LinkError, RefusedError
from skyloop.messages import AnswerTakeover, FlightState, Refused


class Hands(Drone):
    """A pilot's connection that asks for the authority when it is told to, and not when it is opened.

    Without the authority it can stop the motors in an emergency, and nothing else.
    """

    _armed = False

    def request_authority(self, priority: int | None = None, **options: Any) -> AuthorityStatus:
        """Nothing until :meth:`take` was called."""
        return super().request_authority(priority, **options) if self._armed else self.authority

    def take(self, priority: int, *, ask: bool = False) -> AuthorityStatus:
        """Ask for the authority, now. Raises :class:`AuthorityError` naming who has it.

        ``ask``: the holder is asked first, and this waits in line instead of failing.
        """
        self._armed = True
        return self.request_authority(priority, takeover="ask" if ask else "now", stay=ask)

    def answer(self, lease: int, app_id: int, grant: bool, reason: str) -> None:
        """Answer who asks for the authority that is held under this lease, and wait until the proxy has it.

        Raises :class:`RefusedError` if it is not held any more, and :class:`LinkError`.
        """
        reply = self._link.call(lambda: AnswerTakeover(lease, app_id, grant, reason), ANSWER_S)
        if isinstance(reply, Refused):
            raise RefusedError(reply.message, code=reply.code.value)

    @property
    def proxy_ns(self) -> int:
        """The time on the proxy's clock, as estimated."""
        return monotonic_ns() + self.clock_offset_ns

    @property
    def flies(self) -> bool:
        """Whether the vehicle is under way, as far as is known."""
        try:
            return self.feedback().state is FlightState.FLYING
        except LinkError:
            return False
