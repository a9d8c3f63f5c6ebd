"""Who may fly, as this application knows it from replies, events and feedback. Pure.

Replies and events can be lost, and feedback can be older than a grant: leases grow, so the higher one is the newer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from skyloop.clock import nanoseconds
from skyloop.messages import DEFAULT_PRIORITY, Event, EventKind, Feedback, RequestAuthority

AuthorityState = Literal["none", "queued", "held", "preempted"]


@dataclass(frozen=True, slots=True)
class AuthorityStatus:
    """This application's right to command.

    ``none``: not asked for, or given back; ``queued``: waiting in line; ``held``: may fly; ``preempted``: taken away by
    a higher priority, and waiting to have it back. ``lease`` is its number while held, else 0; ``position`` the place
    in line (1 is next), 0 if not known. ``holder`` names who flies now. ``expected_wait_s``: how long it will take if
    each ahead in the line keeps to the time that it said; None: not known. ``until_ns``: when the time is over that
    this application asked for, on the proxy's clock; None: not limited.
    """

    state: AuthorityState = "none"
    lease: int = 0
    priority: int = DEFAULT_PRIORITY
    holder: str | None = None
    position: int = 0
    expected_wait_s: float | None = None
    until_ns: int | None = None


class Authority:
    """Follows the authority of one application. Each method that takes news returns whether the status changed."""

    #: Feedback that names no owner may be older than the grant for this long.
    SETTLE_NS = nanoseconds(0.5)

    def __init__(self, name: str) -> None:
        self._name = name
        self.app_id = 0
        self.wanted = False  #: the application asked for it and has not given it back
        self.pending = False  #: asked for on this connection, and not answered yet
        self.status = AuthorityStatus()
        self.wish = RequestAuthority()  #: how it is asked for, also anew on another connection
        self.declined = ""  #: what was told when the holder declined
        self._lease = 0  #: the newest lease that was ever ours on this connection
        self._granted_ns = 0

    @property
    def held(self) -> bool:
        return self.status.state == "held"

    def connected(self, app_id: int) -> None:
        """A connection was made: leases of the one before mean nothing here."""
        self.app_id = app_id
        self._lease = 0

    def disconnected(self) -> bool:
        """The connection is gone, and the authority with it."""
        self.pending = False
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def asked(self, wish: RequestAuthority) -> None:
        """The authority is being asked for."""
        self.wanted = self.pending = True
        self.wish = wish
        self.declined = ""
        self.status = replace(self.status, priority=wish.priority)

    def granted(self, lease: int, now_ns: int, until_ns: int | None = None) -> bool:
        """By reply, by event or seen in feedback."""
        self.pending = False
        if lease <= self._lease and not self.held:
            return False  # an old lease, told again: it was lost since
        if until_ns is None and lease == self._lease:
            until_ns = self.status.until_ns  # told before, and not again
        self._lease, self._granted_ns = lease, now_ns
        return self._set(AuthorityStatus("held", lease, self.status.priority, self._name, until_ns=until_ns))

    def queued(self, position: int, holder: str, expected_wait_s: float | None = None) -> bool:
        """In line."""
        self.pending = False
        state: AuthorityState = "preempted" if self.status.state == "preempted" else "queued"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder, position, expected_wait_s))

    def given_back(self) -> bool:
        """Released by the application, or refused for good."""
        self.wanted = self.pending = False
        return self._set(AuthorityStatus("none", priority=self.status.priority))

    def refused(self) -> bool:
        """Not given and not in line."""
        return self.given_back()

    def event(self, event: Event, now_ns: int) -> bool:
        """News from the stream of events."""
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
        if not ours or not self.held or _whole(data.get("lease")) < self.status.lease:
            return False
        if event.kind is EventKind.AUTHORITY_PREEMPTED:
            return self._lost(str(data.get("by", "")) or None)
        if event.kind is EventKind.AUTHORITY_LOST:
            if data.get("reason") == "expired":  # its time is over: it is not asked for again by itself
                return self.given_back()
            return self._lost(None)
        return False

    def feedback(self, feedback: Feedback, now_ns: int) -> bool:
        """Feedback names the owner and the lease in force: what the events said, should they have been lost."""
        if feedback.owner_id == self.app_id and feedback.lease:
            return (
                self.wanted
                and not (self.held and feedback.lease == self.status.lease)
                and self.granted(feedback.lease, now_ns)
            )
        if self.held:
            newer = feedback.lease > self.status.lease
            nobody = not feedback.lease and now_ns - self._granted_ns > self.SETTLE_NS
            return (newer or nobody) and self._lost(feedback.owner if feedback.lease else None)
        if self.status.state in ("queued", "preempted") and feedback.owner != self.status.holder:
            return self._set(replace(self.status, holder=feedback.owner))
        return False

    def _lost(self, holder: str | None) -> bool:
        """Taken by somebody, or ended by the proxy because this application was silent."""
        state: AuthorityState = "preempted" if holder else "none"
        return self._set(AuthorityStatus(state, 0, self.status.priority, holder))

    def _set(self, status: AuthorityStatus) -> bool:
        changed, self.status = status != self.status, status
        return changed


def _whole(value: object) -> int:
    return value if isinstance(value, int) else 0
