"""A page's pilot connection, and what the page is told of the authority.

That is who has it, how it was lost, who asks for it, and where the page waits.
:class:`TakeoverQuestions` and :class:`QueueTracker` are pure, the time is an argument; :class:`TakeoverDialog` joins
them to one page, and :class:`AuthorityReport` says what has changed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Self

from skyloop.client import AuthorityStatus, Drone
from skyloop.client.actions import OUTDONE, OVERRULED
from skyloop.client.authority import TakeoverQuery, takeover_query
from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.errors import LinkError, RefusedError
from skyloop.extend import Known, commands, let_go, open_unasked
from skyloop.messages import AnyAction, Event, EventKind, FlightState, Idle, LinkState, Outcome
from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.cockpit.commands import Answer
    from skyloop.cockpit.station import Station


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


Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class TakeoverQuestion:
    """Somebody asks for the authority that this page holds."""

    query: TakeoverQuery
    until_ns: int  #: when the time to ask is over, on the proxy's clock
    declined: bool = False  #: by this page; who is of higher priority gets it all the same when the time is over

    def to_json(self, now_ns: int) -> Json:
        """Return it as JSON values; ``now_ns`` is the proxy's clock."""
        return {
            "id": self.query.by_id,
            "by": self.query.request.by,
            "priority": self.query.request.priority,
            "for_s": self.query.request.for_s,
            "left_s": max(0.0, seconds(self.until_ns - now_ns)),
            "declined": self.declined,
        }


class TakeoverQuestions:
    """The open questions to a page, by the number of who asks. Times are on the proxy's clock.

    Each method that changes them returns whether anything has changed.
    """

    def __init__(self) -> None:
        self._open: dict[int, TakeoverQuestion] = {}

    def find(self, by_id: int) -> TakeoverQuestion | None:
        """Return the question of an application, None if there is none."""
        return self._open.get(by_id)

    def on_event(self, event: Event, app_id: int) -> bool:
        """Handle an event, as the application with this number."""
        if event.kind is EventKind.AUTHORITY_WITHDRAWN and event.data.get("app_id") == app_id:
            by_id = event.data.get("by_id")
            return isinstance(by_id, int) and self._open.pop(by_id, None) is not None
        query = takeover_query(event, app_id)
        if query is None:
            return False
        self._open[query.by_id] = TakeoverQuestion(query, event.at_ns + nanoseconds(query.request.within_s))
        return True

    def decline(self, by_id: int) -> bool:
        """Note that the page keeps control."""
        question = self._open.get(by_id)
        if question is None:
            return False
        self._open[by_id] = replace(question, declined=True)
        return True

    def update(self, lease: int, now_ns: int) -> bool:
        """Drop the questions of another lease, and those whose time is over."""
        left = {by_id: one for by_id, one in self._open.items() if one.query.lease == lease and now_ns < one.until_ns}
        changed, self._open = len(left) != len(self._open), left
        return changed

    def to_json(self, now_ns: int) -> Json:
        """Return the message to the page; who would get the authority first comes first."""
        ordered = sorted(self._open.values(), key=lambda one: (one.query.request.priority, one.until_ns))
        return {"type": "asked", "questions": [one.to_json(now_ns) for one in ordered]}


@dataclass(frozen=True, slots=True)
class QueuePosition:
    """Where a page stands in the queue for the authority."""

    position: int | None  #: 1 is next; None: not known
    until_ns: int | None  #: when it is expected to be its turn; None: not known
    asked: bool  #: the holder was asked first
    declined: str | None  #: and keeps it for this reason, which may be empty

    def to_json(self, now_ns: int) -> Json:
        """Return it as JSON values; ``now_ns`` is the monotonic clock."""
        wait_s = None if self.until_ns is None else max(0.0, seconds(self.until_ns - now_ns))
        return {"position": self.position, "wait_s": wait_s, "asked": self.asked, "declined": self.declined}


class QueueTracker:
    """Follows a page's position in the queue, and the answer to its question."""

    def __init__(self) -> None:
        self._asked = False
        self._declined: str | None = None
        self._known: tuple[int, float | None] | None = None  # what the newest status had
        self._until_ns: int | None = None

    def request(self, *, ask: bool) -> None:
        """Start over, as the page asks for the authority."""
        self._asked, self._declined, self._known = ask, None, None

    def on_event(self, event: Event, app_id: int) -> None:
        """Handle an event, as the application with this number."""
        if event.kind is EventKind.AUTHORITY_DECLINED and event.data.get("app_id") == app_id:
            self._declined = str(event.data.get("reason", ""))

    def update(self, status: AuthorityStatus, now_ns: int) -> QueuePosition | None:
        """Return the position in the queue.

        Returns:
            None for who does not wait. It is equal to the last one until the status changes.
        """
        if status.state == "held":  # who is overruled afterwards has it back without asking
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
    """Both sides of a takeover for one page. On the event loop.

    Args:
        send: Sends a message to the page.
    """

    def __init__(self, send: Callable[[Json], None]) -> None:
        self._send = send
        self._questions = TakeoverQuestions()
        self._queue = QueueTracker()

    def request(self, *, ask: bool) -> None:
        """Start over, as the page asks for the authority."""
        self._queue.request(ask=ask)

    def on_event(self, event: Event, pilot: PilotConnection) -> None:
        """Handle an event that came over the page's own connection."""
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
        """Send the page's answer to the proxy.

        Raises:
            RefusedError: Nobody asks any more.
            LinkError: The proxy does not answer.
        """
        question = self._questions.find(command.id)
        if question is None:
            raise RefusedError("nobody asks for control any more")
        lease = question.query.lease
        await asyncio.to_thread(pilot.answer_takeover, lease, command.id, command.grant, command.reason)
        if not command.grant and self._questions.decline(command.id):
            self._send(self._questions.to_json(pilot.proxy_now_ns))


GIVEN_S: Final = 2.0  #: control that was handed over is gone within this; later it is lost like any other


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
