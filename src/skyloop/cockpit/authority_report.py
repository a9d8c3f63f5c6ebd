"""What a page is told of the authority: who has it, and how the page lost the control that it had."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import LinkError
from skyloop.messages import LinkState

if TYPE_CHECKING:
    from skyloop.cockpit.pilot_connection import PilotConnection
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.takeover import QueuePosition

GIVEN_S: Final = 2.0  #: control that was handed over is gone within this; later it is lost like any other

Json = dict[str, Any]


class AuthorityReport:
    """Compares the authority with what the page was sent last. On the event loop.

    Args:
        station: The drone.
        app: The name under which the page flies.
        gone_s: Its control runs out after so long without a sign of life from the cockpit at the page [s].
    """

    def __init__(self, station: Station, app: str, gone_s: float) -> None:
        self._station = station
        self._app = app
        self._gone_s = gone_s
        #: As the page was sent it last: state, holder, its priority, position in the queue, how control was lost, who
        #: waits.
        self._sent: tuple[str, str | None, int | None, QueuePosition | None, str | None, list[str]] | None = None
        self._was_mine = False
        self._given, self._given_ns = False, 0  # to who asked for it, and when
        self._loss: str | None = None  # how the control that this page had was lost; None: it was not

    def released(self) -> None:
        """Count the control as given back on purpose: it was not lost."""
        self._was_mine, self._loss = False, None

    def handed_over(self, *, given: bool = True) -> None:
        """Count the control that goes now as given to who asked for it: it is not lost; or no longer so."""
        self._given, self._given_ns = given, monotonic_ns()

    def update(self, pilot: PilotConnection | None, place: QueuePosition | None) -> Json | None:
        """Return the message for the page; None if nothing has changed.

        Args:
            pilot: The page's own connection, if it has one.
            place: Its position in the queue, while it waits.
        """
        drone = self._station.drone
        state = "none" if pilot is None else pilot.authority.state
        try:
            feedback = self._station.feedback()
            holder, priority = self._station.view.holder(feedback), feedback.owner_priority
        except LinkError:
            holder, priority = None, None
        mine = state == "held"
        lost = drone.link.application in (LinkState.LOST, LinkState.CLOSED)
        if lost or (holder == self._app and not mine):  # from before
            holder = None
        if holder is None:
            priority = None
        if mine and pilot is not None:  # known here first
            holder, priority = self._app, pilot.authority.priority
        if mine or (self._was_mine and pilot is not None):
            self._loss = None if mine or pilot is None else _end_of_control(pilot)
        if mine != self._was_mine and (mine or monotonic_ns() - self._given_ns > nanoseconds(GIVEN_S)):
            self._given = False  # it was given at another time, or whoever asked did not take it
        self._was_mine = mine
        why = None if self._loss is None else self._why(self._loss, holder, lost)
        waiting = sorted(session.app for session in self._station.sessions if session.waits)
        if (state, holder, priority, place, why, waiting) == self._sent:
            return None
        self._sent = state, holder, priority, place, why, waiting
        line = None if place is None else place.to_json(monotonic_ns())
        return {
            "type": "authority",
            "state": state,
            "holder": holder,
            "priority": priority,
            "mine": mine,
            "why": why,
            "given": self._given and not mine and self._loss not in ("link", "silent"),
            "app": self._app,
            "line": line,
            "waiting": waiting,
        }

    def outranks(self, priority: int) -> bool:
        """Return whether a priority is higher than that of who has control, as far as is known."""
        try:
            held = self._station.feedback().owner_priority
        except LinkError:
            return True
        return held is None or priority < held

    def busy(self, priority: int) -> str:
        """Return why control can't be taken with a priority, in words."""
        try:
            feedback = self._station.feedback()
        except LinkError:
            return "another application has control"
        held = "" if feedback.owner_priority is None else f" with priority {feedback.owner_priority}"
        return (
            f"{feedback.owner or 'another application'} has control{held}, and {priority} is no higher: "
            "a lower number is a higher priority"
        )

    def _why(self, ended: str, holder: str | None, lost: bool) -> str:
        """Return what became of the control that this page had, in words that are true now."""
        name = self._station.found.name
        now = f"{holder} has control" if holder else "nobody has control"
        if ended == "link" and lost:
            return f"the link to the proxy of {name} is down: nobody has control, and what {name} does is not known"
        if ended == "link":
            return f"the link to the proxy of {name} was lost: {now}, and what {name} flew meanwhile is not known"
        if ended == "silent":
            return f"the cockpit received nothing from this page for {self._gone_s:g} s, so its control ran out: {now}"
        return f"{now} now"


def _end_of_control(pilot: PilotConnection) -> str:
    """Return how a page lost the control that it had: ``taken``, ``link``, ``silent`` or ``over``."""
    if pilot.authority.state != "none":
        return "taken"
    if not pilot.is_linked:
        return "link"
    return "silent" if pilot.is_silent else "over"
