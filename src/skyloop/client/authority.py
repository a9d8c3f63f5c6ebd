"""Track this application's authority from replies, events and feedback, and answer requests to hand it over.

Pure. Replies and events can be lost, and feedback can predate the newest grant. Lease numbers grow with each grant.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from skyloop.clock import nanoseconds
from skyloop.errors import UsageError
from skyloop.messages import (
    DEFAULT_PRIORITY,
    HIGHEST_PRIORITY,
    LONGEST_TERM_S,
    LOWEST_PRIORITY,
    Event,
    EventKind,
    Feedback,
    RequestAuthority,
    Takeover,
    Value,
)

AuthorityState = Literal["none", "queued", "held", "preempted"]
TakeoverWay = Literal["now", "ask"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Authority:
    """An application's request for authority over a drone: ``connect("alpha", authority=Authority(priority=4))``.

    Attributes:
        priority: 0 (highest) to 31 (lowest); a higher priority pre-empts a lower one.
        wait_s: How long to wait in the queue while another application holds the authority [s].
        for_s: How long to hold the authority [s], up to a day; after that, others can acquire it. None: unlimited.
        takeover: ``"now"`` pre-empts a holder of lower priority immediately; ``"ask"`` asks the holder first.
        stay: Whether to remain in the queue after ``wait_s`` instead of raising an error.

    Raises:
        UsageError: If a value is out of range.
    """

    priority: int = DEFAULT_PRIORITY
    wait_s: float = 0.0
    for_s: float | None = None
    takeover: TakeoverWay = "now"
    stay: bool = False

    def __post_init__(self) -> None:
        authority_request(self.priority, self.for_s, self.takeover)
        check_seconds("wait_s", self.wait_s)


def check_seconds(what: str, seconds: object) -> None:
    """Check a waiting time [s]; raise :class:`UsageError` if it is negative or not a finite number."""
    if not (isinstance(seconds, int | float) and 0.0 <= seconds < math.inf):
        raise UsageError(f"{what} is {seconds!r} and must be a number of seconds")


@dataclass(frozen=True, slots=True)
class AuthorityStatus:
    """The state of this application's right to command a drone."""

    #: ``none``: not requested, or released. ``queued``: waiting in the queue. ``held``: may command. ``preempted``:
    #: taken over by another application; waiting in the queue to get it back.
    state: AuthorityState = "none"
    lease: int = 0  #: number of the lease while held, otherwise 0
    priority: int = DEFAULT_PRIORITY  #: priority of the last request, 0 (highest) to 31
    holder: str | None = None  #: name of the application that holds it; None: none, or unknown
    position: int = 0  #: position in the queue, 1 being next; 0 if unknown
    expected_wait_s: float | None = None  #: wait if all requests ahead end at their announced times [s]; None: unknown
    until_ns: int | None = None  #: end of the requested time, on the proxy's clock; None: unlimited


class EndedSessions:
    """This process's finished sessions, identified by the proxy's run and the application's number. Thread-safe.

    A proxy may notice a session's end only after the next one has begun; until then, the old one holds the authority.
    """

    MOST = 256  #: maximum number of sessions remembered

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], None] = {}
        self._lock = threading.Lock()

    def add(self, run_id: int, app_id: int) -> None:
        """Remember a session, forgetting the oldest one if there are too many."""
        with self._lock:
            self._known[run_id, app_id] = None
            if len(self._known) > self.MOST:
                del self._known[next(iter(self._known))]

    def __contains__(self, session: tuple[int, int]) -> bool:
        return session in self._known


class AuthorityTracker:
    """Follows the authority of one application. Methods that return a bool return whether the status changed."""

    #: Time after a grant during which feedback without an owner may predate the grant.
    SETTLE_NS = nanoseconds(0.5)

    def __init__(self, name: str, ended: EndedSessions | None = None) -> None:
        self._name = name
        self._ended = EndedSessions() if ended is None else ended
        self._run_id = 0
        self._owner_id = 0  # the owner in the last feedback; 0: none
        self.app_id = 0
        self.wanted = False  #: whether the application has requested the authority and not released it
        self.pending = False  #: the authority was requested on this connection, but no answer has arrived yet
        self.status = AuthorityStatus()
        self.last_request = RequestAuthority()  #: the last request, which is repeated on a new connection
        self.declined = ""  #: why the holder declined
        #: Whether to request the authority again automatically after losing the connection, or the lease by time-out.
        self.renews = True
        self._lease = 0  #: the newest lease that this application has held on this connection
        self._granted_ns = 0

    @property
    def held(self) -> bool:
        """Whether this application may command."""
        return self.status.state == "held"

    @property
    def awaited(self) -> bool:
        """Whether the authority is requested and, as far as is known, not held by another application."""
        return self.wanted and (self.status.state == "none" or not self.settled)

    @property
    def answered(self) -> bool:
        """Whether the authority is held, queued for, or no longer wanted. A lost link does not count as an answer."""
        return not self.pending and (self.status.state != "none" or not self.wanted)

    @property
    def behind_itself(self) -> bool:
        """Whether the application is queued only until the proxy notices the end of this process's earlier session."""
        return self.status.state == "queued" and (self._run_id, self._owner_id) in self._ended

    @property
    def settled(self) -> bool:
        """Whether the authority is held, not wanted, or known from feedback to belong to another application."""
        return self.status.state != "queued" or (self._owner_id != 0 and not self.behind_itself)

    def connected(self, app_id: int, run_id: int = 0) -> None:
        """Reset on a new connection: older leases are invalid and, if the proxy was restarted, so are old numbers."""
        if run_id != self._run_id:
            self._owner_id = 0
        self.app_id, self._run_id = app_id, run_id
        self._lease = 0

    def disconnected(self) -> bool:
        """Handle a lost connection, which ends the authority; the application still wants it if it is to be renewed."""
        if self.app_id:
            self._ended.add(self._run_id, self.app_id)
        self.pending = False
        self.wanted = self.wanted and self.renews
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def asked(self, request: RequestAuthority) -> None:
        """Record that the authority is being requested."""
        self.wanted = self.pending = True
        self.last_request = request
        self.declined = ""
        self.status = replace(self.status, priority=request.priority)

    def granted(self, lease: int, now_ns: int, until_ns: int | None = None) -> bool:
        """Record a grant from a reply, an event or feedback, unless it has been lost in the meantime.

        ``until_ns``: when the lease ends, on the proxy's clock; None: never, or as reported before.
        """
        self.pending = False
        if lease <= self._lease and not self.held:
            return False  # this is a late report of an old lease that has been lost since then
        if until_ns is None and lease == self._lease:
            until_ns = self.status.until_ns  # feedback and some events do not repeat the time limit
        self._lease, self._granted_ns = lease, now_ns
        return self._set(AuthorityStatus("held", lease, self.status.priority, self._name, until_ns=until_ns))

    def queued(self, position: int, holder: str, expected_wait_s: float | None = None) -> bool:
        """Record the position in the queue; see :class:`AuthorityStatus`."""
        self.pending = False
        state: AuthorityState = "preempted" if self.status.state == "preempted" else "queued"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder, position, expected_wait_s))

    def given_back(self) -> bool:
        """Record that the application released the authority, or that the proxy refused it or let it expire."""
        self.wanted = self.pending = False
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def event(self, event: Event, now_ns: int) -> bool:
        data = event.data
        ours = data.get("app_id") == self.app_id
        if event.kind is EventKind.AUTHORITY_GRANTED and ours:
            return self.granted(_whole(data.get("lease")), now_ns, _whole(data.get("until_ns")) or None)
        if event.kind is EventKind.AUTHORITY_QUEUED and ours and self.status.state in ("queued", "preempted"):
            position, wait_s = _whole(data.get("position")), data.get("wait_s")
            expected = wait_s if isinstance(wait_s, float) else None
            return self._set(replace(self.status, position=position, expected_wait_s=expected))
        if event.kind is EventKind.AUTHORITY_DECLINED and ours:
            self.declined = event.text
        lease = _whole(data.get("lease"))
        late = self.status.state == "preempted" and lease == self._lease  # feedback has already named the next holder
        if not ours or not (late or (self.held and lease >= self.status.lease)):
            return False
        if event.kind is EventKind.AUTHORITY_PREEMPTED:
            return self._lost(str(data.get("by", "")) or None)
        if event.kind is EventKind.AUTHORITY_LOST:
            if data.get("reason") == "expired":  # the lease has expired, and is not requested again automatically
                return self.given_back()
            return self._lost(None)
        return False

    def feedback(self, feedback: Feedback, now_ns: int) -> bool:
        """Update the authority from the owner and the lease given in feedback, in case events were lost."""
        before_id, self._owner_id = self._owner_id, feedback.owner_id
        if feedback.owner_id == self.app_id and feedback.lease:
            return (
                self.wanted
                and not (self.held and feedback.lease == self.status.lease)
                and self.granted(feedback.lease, now_ns)
            )
        if self.held:
            newer = feedback.lease > self.status.lease
            until_ns = self.status.until_ns
            if newer and until_ns is not None and feedback.captured_ns >= until_ns:
                return self.given_back()  # its time has expired, and the event was lost or is late
            nobody = not feedback.lease and now_ns - self._granted_ns > self.SETTLE_NS
            return (newer or nobody) and self._lost(feedback.owner if feedback.lease else None)
        if self.status.state in ("queued", "preempted"):
            return self._set(replace(self.status, holder=feedback.owner)) or feedback.owner_id != before_id
        return False

    def _lost(self, holder: str | None) -> bool:
        """Record that ``holder`` took over, or that the proxy withdrew the authority because nothing was sent."""
        if not holder and not self.renews:
            return self.given_back()
        state: AuthorityState = "preempted" if holder else "none"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder))

    def _set(self, status: AuthorityStatus) -> bool:
        changed, self.status = status != self.status, status
        return changed


def _whole(value: object) -> int:
    return value if isinstance(value, int) else 0


#: True hands over the authority; False, or a reason as a string, declines; None leaves the decision to the proxy.
TakeoverAnswer = bool | str | None


@dataclass(frozen=True, slots=True)
class TakeoverRequest:
    """Another application's request for the authority held by this one."""

    by: str  #: name of the other application
    priority: int  #: 0 is the highest
    within_s: float  #: time after which the other application takes over if its priority is strictly higher [s]
    for_s: float | None  #: how long the application wants to hold the authority [s]; None: unlimited


@dataclass(frozen=True, slots=True)
class TakeoverQuery:
    """A request for the authority, with the data needed to answer it."""

    request: TakeoverRequest
    lease: int  #: the lease to give up
    by_id: int  #: number of the requesting application, in this run of the proxy


def authority_request(priority: int, for_s: float | None = None, takeover: TakeoverWay = "now") -> RequestAuthority:
    """Return a request for the authority; arguments and errors are those of :class:`Authority`."""
    if not isinstance(priority, int) or not HIGHEST_PRIORITY <= priority <= LOWEST_PRIORITY:
        raise UsageError(f"priority is {priority!r} and must be a whole number from 0 (highest) to 31 (lowest)")
    if takeover not in ("now", "ask"):
        raise UsageError(f'takeover is {takeover!r} and must be "now" or "ask"')
    if for_s is not None and not (isinstance(for_s, int | float) and 0.0 < for_s <= LONGEST_TERM_S):
        raise UsageError(f"for_s is {for_s!r} and must be a number of seconds, more than 0 and at most a day")
    return RequestAuthority(priority, True, None if for_s is None else float(for_s), Takeover(takeover))


def answering(
    function: Callable[[TakeoverRequest], TakeoverAnswer],
    app_id: Callable[[], int],
    answer: Callable[[int, int, bool, str], None],
) -> Callable[[Event], None]:
    """Return an event callback that calls ``function`` when another application requests this one's authority.

    ``answer`` is called with the lease, the requesting application's number, the decision and the reason. Raises
    :class:`UsageError` if ``function`` is not callable.
    """
    if not callable(function):
        raise UsageError(f"{function!r:.80} can't be called: expected a function with one argument")

    def on_event(event: Event) -> None:
        query = takeover_query(event, app_id())
        if query is None:
            return
        reply = function(query.request)
        if reply is not None:
            answer(query.lease, query.by_id, reply is True, reply if isinstance(reply, str) else "")

    return on_event


def takeover_query(event: Event, app_id: int) -> TakeoverQuery | None:
    """Return the request that an event contains for the application ``app_id``; None if it contains none."""
    data = event.data
    if event.kind is not EventKind.AUTHORITY_ASKED or data.get("app_id") != app_id:
        return None
    lease, by_id = data.get("lease"), data.get("by_id")
    if not isinstance(lease, int) or not isinstance(by_id, int):
        return None
    priority = data.get("by_priority")
    request = TakeoverRequest(
        str(data.get("by", "")),
        priority if isinstance(priority, int) else LOWEST_PRIORITY,
        _number(data.get("within_s")) or 0.0,
        _number(data.get("for_s")),
    )
    return TakeoverQuery(request, lease, by_id)


def _number(value: Value | None) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
