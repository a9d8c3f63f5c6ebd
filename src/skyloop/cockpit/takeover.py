"""The authority as a page sees it: its holder, its loss, requests for it, and the page's place in the queue.

:class:`TakeoverQuestions` and :class:`QueueTracker` are pure and take the time as an argument; :class:`TakeoverDialog`
connects them to one page, and :class:`AuthorityReport` reports changes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from skyloop.client import AuthorityStatus
from skyloop.client.authority import TakeoverQuery, takeover_query
from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.errors import LinkError, RefusedError
from skyloop.messages import Event, EventKind, LinkState

if TYPE_CHECKING:
    from skyloop.cockpit.commands import Answer
    from skyloop.cockpit.station import PilotConnection, Station


Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class TakeoverQuestion:
    """Another application's request for the authority that this page holds."""

    query: TakeoverQuery
    until_ns: int  #: time at which the question expires, on the proxy's clock
    declined: bool = False  #: whether this page refused; a higher priority still gets authority on expiry

    def to_json(self, now_ns: int) -> Json:
        """Return the question as JSON values; ``now_ns`` is on the proxy's clock."""
        return {
            "id": self.query.by_id,
            "by": self.query.request.by,
            "priority": self.query.request.priority,
            "for_s": self.query.request.for_s,
            "left_s": max(0.0, seconds(self.until_ns - now_ns)),
            "declined": self.declined,
        }


class TakeoverQuestions:
    """A page's open questions, keyed by the number of the asking application. Times are on the proxy's clock.

    Methods that may change the questions return whether anything changed.
    """

    def __init__(self) -> None:
        self._open: dict[int, TakeoverQuestion] = {}

    def find(self, by_id: int) -> TakeoverQuestion | None:
        """Return an application's question, or None if the application asks nothing."""
        return self._open.get(by_id)

    def on_event(self, event: Event, app_id: int) -> bool:
        """Handle an event received by the application with this number."""
        if event.kind is EventKind.AUTHORITY_WITHDRAWN and event.data.get("app_id") == app_id:
            by_id = event.data.get("by_id")
            return isinstance(by_id, int) and self._open.pop(by_id, None) is not None
        query = takeover_query(event, app_id)
        if query is None:
            return False
        self._open[query.by_id] = TakeoverQuestion(query, event.at_ns + nanoseconds(query.request.within_s))
        return True

    def decline(self, by_id: int) -> bool:
        """Record that the page keeps control."""
        question = self._open.get(by_id)
        if question is None:
            return False
        self._open[by_id] = replace(question, declined=True)
        return True

    def update(self, lease: int, now_ns: int) -> bool:
        """Drop questions that have expired or concern another lease."""
        left = {by_id: one for by_id, one in self._open.items() if one.query.lease == lease and now_ns < one.until_ns}
        changed, self._open = len(left) != len(self._open), left
        return changed

    def to_json(self, now_ns: int) -> Json:
        """Return the message for the page; the application that would get authority next comes first."""
        ordered = sorted(self._open.values(), key=lambda one: (one.query.request.priority, one.until_ns))
        return {"type": "asked", "questions": [one.to_json(now_ns) for one in ordered]}


@dataclass(frozen=True, slots=True)
class QueuePosition:
    """A page's position in the queue for authority."""

    position: int | None  #: 1 if the page is next; None if unknown
    until_ns: int | None  #: time at which its turn is expected; None if unknown
    asked: bool  #: whether the person in control was asked first
    declined: str | None  #: holder's reason for keeping control, which may be empty; None if it did not decline

    def to_json(self, now_ns: int) -> Json:
        """Return the position as JSON values; ``now_ns`` is on the monotonic clock."""
        wait_s = None if self.until_ns is None else max(0.0, seconds(self.until_ns - now_ns))
        return {"position": self.position, "wait_s": wait_s, "asked": self.asked, "declined": self.declined}


class QueueTracker:
    """Tracks a page's position in the queue and the response to its question."""

    def __init__(self) -> None:
        self._asked = False
        self._declined: str | None = None
        self._known: tuple[int, float | None] | None = None  # position and time from the newest status
        self._until_ns: int | None = None

    def request(self, *, ask: bool) -> None:
        """Start over, because the page has requested authority."""
        self._asked, self._declined, self._known = ask, None, None

    def on_event(self, event: Event, app_id: int) -> None:
        if event.kind is EventKind.AUTHORITY_DECLINED and event.data.get("app_id") == app_id:
            self._declined = str(event.data.get("reason", ""))

    def update(self, status: AuthorityStatus, now_ns: int) -> QueuePosition | None:
        """Return the page's position in the queue, or None if the page is not waiting.

        The time at which its turn is expected is fixed until the status changes.
        """
        if status.state == "held":  # a pilot that was overruled regains authority later without asking
            self.request(ask=False)
        if status.state not in ("queued", "preempted"):
            return None
        known = status.position, status.expected_wait_s
        if known != self._known:
            self._known = known
            wait_s = status.expected_wait_s
            self._until_ns = None if wait_s is None else now_ns + nanoseconds(wait_s)
        return QueuePosition(status.position or None, self._until_ns, self._asked, self._declined)


class TakeoverDialog:
    """Handles both sides of a takeover on behalf of one page. Used on the event loop."""

    def __init__(self, send: Callable[[Json], None]) -> None:
        self._send = send
        self._questions = TakeoverQuestions()
        self._queue = QueueTracker()

    def request(self, *, ask: bool) -> None:
        self._queue.request(ask=ask)

    def on_event(self, event: Event, pilot: PilotConnection) -> None:
        """Handle an event from the page's own connection."""
        self._queue.on_event(event, pilot.app_id)
        if self._questions.on_event(event, pilot.app_id):
            self._send(self._questions.to_json(pilot.proxy_now_ns))

    def update(self, pilot: PilotConnection | None) -> QueuePosition | None:
        """Send the open questions if they have changed; return the page's position in the queue."""
        lease, now_ns = (0, 0) if pilot is None else (pilot.authority.lease, pilot.proxy_now_ns)
        if self._questions.update(lease, now_ns):
            self._send(self._questions.to_json(now_ns))
        return None if pilot is None else self._queue.update(pilot.authority, monotonic_ns())

    async def answer(self, command: Answer, pilot: PilotConnection) -> None:
        """Send the page's answer to the proxy. Raise ``RefusedError`` if the question is no longer open."""
        question = self._questions.find(command.id)
        if question is None:
            raise RefusedError("the request for control is no longer open")
        lease = question.query.lease
        await asyncio.to_thread(pilot.answer_takeover, lease, command.id, command.grant, command.reason)
        if not command.grant and self._questions.decline(command.id):
            self._send(self._questions.to_json(pilot.proxy_now_ns))


GIVEN_S: Final = 2.0  #: a handover takes effect within this time; any later loss of control is an ordinary loss


class AuthorityReport:
    """Compares the current authority with the last message sent to the page. Used on the event loop.

    ``gone_s``: the page's control expires once the page has received nothing from the cockpit for this long [s].
    """

    def __init__(self, station: Station, app: str, gone_s: float) -> None:
        self._station = station
        self._app = app
        self._gone_s = gone_s
        #: Last values sent to the page: state, holder, the holder's priority, position in the queue, how control was
        #: lost, and the waiting applications.
        self._sent: tuple[str, str | None, int | None, QueuePosition | None, str | None, list[str]] | None = None
        self._was_mine = False
        self._given, self._given_ns = False, 0  # whether control was handed over on request, and when
        self._loss: str | None = None  # how this page lost control; None if it has not lost control

    def released(self) -> None:
        """Treat the loss of control as intended, because the page itself released control."""
        self._was_mine, self._loss = False, None

    def handed_over(self, *, given: bool = True) -> None:
        """Treat the expected loss of control as a handover; ``given=False`` undoes this."""
        self._given, self._given_ns = given, monotonic_ns()

    def update(self, pilot: PilotConnection | None, place: QueuePosition | None) -> Json | None:
        """Return the message for the page, or None if unchanged. ``place``: its position in the queue, if any."""
        drone = self._station.drone
        state = "none" if pilot is None else pilot.authority.state
        next_owner: str | None = None  # name of the first application in the queue, which may be a program
        try:
            feedback = self._station.feedback()
            holder, priority = self._station.view.holder(feedback), feedback.owner_priority
            next_owner = feedback.next_owner
        except LinkError:
            holder, priority = None, None
        mine = state == "held"
        lost = drone.link.application in (LinkState.LOST, LinkState.CLOSED)
        if lost or (holder == self._app and not mine):  # the feedback is outdated
            holder = None
        if holder is None:
            priority = None
        if mine and pilot is not None:  # our own lease is known here before feedback reports it
            holder, priority = self._app, pilot.authority.priority
        if mine or (self._was_mine and pilot is not None):
            self._loss = None if mine or pilot is None else _end_of_control(pilot)
        if mine != self._was_mine and (mine or monotonic_ns() - self._given_ns > nanoseconds(GIVEN_S)):
            self._given = False  # the handover was long ago, or the other application did not accept it
        self._was_mine = mine
        why = None if self._loss is None else self._why(self._loss, holder, lost)
        sessions = self._station.sessions
        waiting = sorted(session.app for session in sessions if session.waits)
        if next_owner is not None and not lost and all(session.app != next_owner for session in sessions):
            waiting.insert(0, next_owner)  # requests from our own pages are known here before feedback reports them
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
        """Return whether a priority is higher than the holder's, or the holder's is unknown."""
        try:
            held = self._station.feedback().owner_priority
        except LinkError:
            return True
        return held is None or priority < held

    def busy(self, priority: int) -> str:
        """Explain why an application with this priority can't take control."""
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
        """Explain how the page lost control, and name the current pilot."""
        name = self._station.found.name
        now = f"{holder} has control" if holder else "nobody has control"
        if ended == "link" and lost:
            return f"the link to the proxy of {name} is down: nobody has control, and the state of {name} is unknown"
        if ended == "link":
            return f"the link to the proxy of {name} was lost: {now}, and what {name} did meanwhile is unknown"
        if ended == "silent":
            return f"the cockpit received nothing from this page for {self._gone_s:g} s, so its control expired: {now}"
        return f"{now} now"


def _end_of_control(pilot: PilotConnection) -> str:
    """Return how a page lost control: ``taken``, ``link``, ``silent`` or ``over``."""
    if pilot.authority.state != "none":
        return "taken"
    if not pilot.is_linked:
        return "link"
    return "silent" if pilot.is_silent else "over"
