"""What this application knows of its authority from replies, events and feedback, and requests to hand it over.

Pure. Replies and events can be lost, and feedback can be older than a grant: lease numbers grow, so the higher one is
the newer.
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
    """How an application asks for the authority over a drone: ``connect("alpha", authority=Authority(priority=4))``.

    Attributes:
        priority: 0 (highest) to 31 (lowest); a higher one pre-empts a lower one.
        wait_s: How long to wait in the queue while another application holds the authority [s].
        for_s: How long the authority is wanted [s], up to a day; then others can get it. None: open.
        takeover: ``"now"`` pre-empts a holder of lower priority at once, ``"ask"`` asks the holder first.
        stay: Whether to stay in the queue after ``wait_s``, without the authority, instead of failing.

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
    """Check a time to wait [s]: raise :class:`UsageError` if it is no finite number, or negative."""
    if not (isinstance(seconds, int | float) and 0.0 <= seconds < math.inf):
        raise UsageError(f"{what} is {seconds!r} and must be a number of seconds")


@dataclass(frozen=True, slots=True)
class AuthorityStatus:
    """This application's right to command.

    Attributes:
        state: ``none``: not requested, or released. ``queued``: waiting in the queue. ``held``: may command.
            ``preempted``: taken over by another application, and waiting in the queue to get it back.
        lease: Number of the lease while held, else 0.
        priority: Of the last request, 0 (highest) to 31.
        holder: Name of the application that holds it; None if nobody does or it is not known.
        position: Position in the queue from 1, the next; 0 if not known.
        expected_wait_s: Wait if each ahead in the queue keeps to the time it announced [s]; None if not known.
        until_ns: When the time that this application asked for is over, on the proxy's clock; None: not limited.
    """

    state: AuthorityState = "none"
    lease: int = 0
    priority: int = DEFAULT_PRIORITY
    holder: str | None = None
    position: int = 0
    expected_wait_s: float | None = None
    until_ns: int | None = None


class EndedSessions:
    """Sessions of this process that have ended, by run of the proxy and number of the application. Any thread.

    A proxy may hear of the end later than of the next session, and until then the old one has the authority.
    """

    MOST = 256  #: those that are remembered

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], None] = {}
        self._lock = threading.Lock()

    def add(self, run_id: int, app_id: int) -> None:
        """Remember one; the oldest is forgotten."""
        with self._lock:
            self._known[run_id, app_id] = None
            if len(self._known) > self.MOST:
                del self._known[next(iter(self._known))]

    def __contains__(self, session: tuple[int, int]) -> bool:
        return session in self._known


class AuthorityTracker:
    """Follows the authority of one application. Methods that return a bool return whether the status changed."""

    #: Feedback that names no owner may be older than the grant for this long.
    SETTLE_NS = nanoseconds(0.5)

    def __init__(self, name: str, ended: EndedSessions | None = None) -> None:
        self._name = name
        self._ended = EndedSessions() if ended is None else ended
        self._run_id = 0
        self._owner_id = 0  # who had it by the last feedback; 0: nobody
        self.app_id = 0
        self.wanted = False  #: the application asked for it and has not given it back
        self.pending = False  #: asked for on this connection, and not answered yet
        self.status = AuthorityStatus()
        self.last_request = RequestAuthority()  #: the last request, repeated on another connection
        self.declined = ""  #: why the holder declined
        #: Whether to request it again by itself after a lost connection, or after the lease was lost by silence.
        self.renews = True
        self._lease = 0  #: the newest lease that this application has held on this connection
        self._granted_ns = 0

    @property
    def held(self) -> bool:
        """Whether this application may command."""
        return self.status.state == "held"

    @property
    def awaited(self) -> bool:
        """Whether it is asked for, and nothing shows yet that another application has it."""
        return self.wanted and (self.status.state == "none" or not self.settled)

    @property
    def answered(self) -> bool:
        """Whether what was asked for is held, waited for, or not wanted any more. A lost link is no answer."""
        return not self.pending and (self.status.state != "none" or not self.wanted)

    @property
    def behind_itself(self) -> bool:
        """Whether it waits only until the proxy notices that an earlier session of this process has ended."""
        return self.status.state == "queued" and (self._run_id, self._owner_id) in self._ended

    @property
    def settled(self) -> bool:
        """Whether it is held, not wanted, or known from feedback to be another application's."""
        return self.status.state != "queued" or (self._owner_id != 0 and not self.behind_itself)

    def connected(self, app_id: int, run_id: int = 0) -> None:
        """Reset on a new connection, on which older leases mean nothing, and on another run numbers of applications."""
        if run_id != self._run_id:
            self._owner_id = 0
        self.app_id, self._run_id = app_id, run_id
        self._lease = 0

    def disconnected(self) -> bool:
        """The connection is lost, and the authority with it; it stays wanted if it is to be renewed."""
        if self.app_id:
            self._ended.add(self._run_id, self.app_id)
        self.pending = False
        self.wanted = self.wanted and self.renews
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def asked(self, request: RequestAuthority) -> None:
        """Note that the authority is being requested."""
        self.wanted = self.pending = True
        self.last_request = request
        self.declined = ""
        self.status = replace(self.status, priority=request.priority)

    def granted(self, lease: int, now_ns: int, until_ns: int | None = None) -> bool:
        """Note a grant, known from a reply, an event or feedback; one that was lost since is ignored.

        ``until_ns``: when its time is over, on the proxy's clock; None: not limited, or known from before.
        """
        self.pending = False
        if lease <= self._lease and not self.held:
            return False  # an old lease, reported late: it was lost since
        if until_ns is None and lease == self._lease:
            until_ns = self.status.until_ns  # feedback and some events do not repeat it
        self._lease, self._granted_ns = lease, now_ns
        return self._set(AuthorityStatus("held", lease, self.status.priority, self._name, until_ns=until_ns))

    def queued(self, position: int, holder: str, expected_wait_s: float | None = None) -> bool:
        """Note the position in the queue; see :class:`AuthorityStatus`."""
        self.pending = False
        state: AuthorityState = "preempted" if self.status.state == "preempted" else "queued"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder, position, expected_wait_s))

    def given_back(self) -> bool:
        """Note that it was released by the application, or refused: neither granted nor queued."""
        self.wanted = self.pending = False
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def event(self, event: Event, now_ns: int) -> bool:
        """Update from an event."""
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
        late = self.status.state == "preempted" and lease == self._lease  # feedback told of the next holder before
        if not ours or not (late or (self.held and lease >= self.status.lease)):
            return False
        if event.kind is EventKind.AUTHORITY_PREEMPTED:
            return self._lost(str(data.get("by", "")) or None)
        if event.kind is EventKind.AUTHORITY_LOST:
            if data.get("reason") == "expired":  # its time is over: not requested again by itself
                return self.given_back()
            return self._lost(None)
        return False

    def feedback(self, feedback: Feedback, now_ns: int) -> bool:
        """Update from the owner and the lease in feedback, in case events were lost."""
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
                return self.given_back()  # its time is over, and the event that says so was lost or is late
            nobody = not feedback.lease and now_ns - self._granted_ns > self.SETTLE_NS
            return (newer or nobody) and self._lost(feedback.owner if feedback.lease else None)
        if self.status.state in ("queued", "preempted"):
            return self._set(replace(self.status, holder=feedback.owner)) or feedback.owner_id != before_id
        return False

    def _lost(self, holder: str | None) -> bool:
        """Note that it was taken over by ``holder``, or ended by the proxy because this application was silent."""
        if not holder and not self.renews:
            return self.given_back()
        state: AuthorityState = "preempted" if holder else "none"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder))

    def _set(self, status: AuthorityStatus) -> bool:
        changed, self.status = status != self.status, status
        return changed


def _whole(value: object) -> int:
    return value if isinstance(value, int) else 0


#: True: hand it over; False, or the reason as a text: decline; None: leave it to the proxy.
TakeoverAnswer = bool | str | None


@dataclass(frozen=True, slots=True)
class TakeoverRequest:
    """Another application asks for the authority that this one holds."""

    by: str  #: name of that application
    priority: int  #: 0 is the highest
    within_s: float  #: after this time it wins if its priority is strictly higher
    for_s: float | None  #: for how long it wants the authority; None: open


@dataclass(frozen=True, slots=True)
class TakeoverQuery:
    """A request as it came, with what an answer needs."""

    request: TakeoverRequest
    lease: int  #: the lease that is to be given up
    by_id: int  #: number of the application that asks, in this run of the proxy


def authority_request(priority: int, for_s: float | None = None, takeover: TakeoverWay = "now") -> RequestAuthority:
    """Return the request for the authority, with the meaning that it has in :class:`Authority`.

    Raises:
        UsageError: If an argument is out of range.
    """
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
    """Return a callback for events that calls ``function`` when this application is asked to hand the authority over.

    ``answer`` is given the lease, the number of the application that asks, whether it is granted, and the reason.
    Raises :class:`UsageError` if ``function`` can't be called.
    """
    if not callable(function):
        raise UsageError(f"{function!r:.80} can't be called: a function with one argument is needed")

    def on_event(event: Event) -> None:
        query = takeover_query(event, app_id())
        if query is None:
            return
        reply = function(query.request)
        if reply is not None:
            answer(query.lease, query.by_id, reply is True, reply if isinstance(reply, str) else "")

    return on_event


def takeover_query(event: Event, app_id: int) -> TakeoverQuery | None:
    """Return the request that an event makes of the application ``app_id``; None if it makes none of it."""
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
