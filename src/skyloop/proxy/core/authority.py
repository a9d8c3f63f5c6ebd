"""The authority to command: numbered leases, priorities, and a queue of waiting pilots. Pure: the time is an argument.

Priority 0 is the highest, 31 the lowest. At any time, at most one application *holds* the authority. The holder has a
lease, whose number is unique in this run. A strictly higher priority takes over at once or after the holder has been
asked. A pre-empted pilot waits in the queue, which is ordered by priority and then by arrival. A holder that requested
the authority for a limited time loses it once that time is over and others are waiting. See ``docs/proxy.md``.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, field, replace

from skyloop.clock import nanoseconds


@dataclass(frozen=True, slots=True, order=True)
class QueueEntry:
    """An application that holds or awaits the authority. Entries sort in the order in which they get the authority."""

    priority: int  #: 0 is the highest
    arrival: int  #: number of the application's first request since it was last neither holder nor waiting
    app_id: int
    term_ns: int | None = field(default=None, compare=False)  #: requested duration after the grant; None: unlimited
    #: When the holder's time to answer this request ends; None if the holder was not asked.
    asks_until_ns: int | None = field(default=None, compare=False)

    def asks(self, now_ns: int) -> bool:
        """Return whether the holder is still being asked."""
        return self.asks_until_ns is not None and now_ns < self.asks_until_ns


@dataclass(frozen=True, slots=True)
class Granted:
    """The authority was granted to ``app_id`` under a new lease."""

    app_id: int
    priority: int
    lease: int
    until_ns: int | None = None  #: end of the requested time; None: unlimited


@dataclass(frozen=True, slots=True)
class Lost:
    """The lease ended: ``released``, its holder was ``silent`` or ``gone``, or ``expired`` while others waited."""

    app_id: int
    lease: int
    reason: str


@dataclass(frozen=True, slots=True)
class Preempted:
    """The lease ended because of a request with strictly higher priority, or because the holder ``granted`` a request.

    The former holder waits in the queue.
    """

    app_id: int
    lease: int
    by_id: int
    by_priority: int
    granted: bool = False


@dataclass(frozen=True, slots=True)
class Queued:
    """An application is waiting in the queue, or has moved up; ``position`` 1 is next."""

    app_id: int
    priority: int
    position: int
    wait_ns: int | None = None  #: estimated waiting time; None if it is unknown


@dataclass(frozen=True, slots=True)
class Asked:
    """The holder is being asked to hand over the authority."""

    app_id: int  #: the holder
    lease: int
    by_id: int
    by_priority: int
    until_ns: int  #: time from which ``by_id`` wins if its priority is strictly higher
    term_ns: int | None = None  #: requested duration


@dataclass(frozen=True, slots=True)
class Declined:
    """The holder declined to hand the authority over to ``app_id``, and ``app_id`` continues to wait."""

    app_id: int
    holder_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class Withdrawn:
    """The request to the holder was withdrawn: the other application left the queue or stopped asking."""

    app_id: int  #: the holder
    lease: int
    by_id: int


@dataclass(frozen=True, slots=True)
class Expired:
    """The holder's time is over, but it keeps the authority until another application requests it. Reported once."""

    app_id: int
    lease: int


Effect = Granted | Lost | Preempted | Queued | Asked | Declined | Withdrawn | Expired


class Authority:
    """Tracks who holds the authority over one vehicle, and who waits for it. Methods return changes in order."""

    def __init__(self, timeout_s: float = 2.0, ask_s: float = 10.0) -> None:
        self.timeout_ns = nanoseconds(timeout_s)  #: after this time without a valid command, a holder loses the lease
        self.ask_ns = nanoseconds(ask_s)  #: time for a holder to answer before the higher priority wins
        self.holder: QueueEntry | None = None
        self.lease = 0  #: the lease in force; 0 if there is none
        self.last_command_ns = 0  #: time of the last valid command from the current or an earlier holder
        self._granted_ns = 0  # time at which the holder got the lease
        self.until_ns: int | None = None  #: end of the holder's time
        #: The last holder, if it lost the lease by falling silent. It is listed until someone requests the authority.
        self.silent: QueueEntry | None = None
        self._last_lease = 0
        self._arrivals = 0
        self._waiting: list[QueueEntry] = []
        self._known_positions: dict[int, int] = {}
        self._expiry_reported = False

    @property
    def owner(self) -> QueueEntry | None:
        """The owner that clients see: the holder, or a former holder that fell silent and has no successor."""
        return self.holder or self.silent

    @property
    def waiting(self) -> tuple[QueueEntry, ...]:
        """The queue, with the next application first."""
        return tuple(self._waiting)

    @property
    def granted(self) -> int:
        """Number of grants in this run."""
        return self._last_lease

    def position(self, app_id: int) -> int:
        """Return the position in the queue, counted from 1; 0 if the application is not waiting."""
        return next((position for position, entry in enumerate(self._waiting, 1) if entry.app_id == app_id), 0)

    def asking(self, app_id: int, now_ns: int) -> bool:
        """Return whether this application is currently asking the holder to hand over the authority."""
        return any(entry.app_id == app_id and entry.asks(now_ns) for entry in self._waiting)

    def wait_ns(self, app_id: int, now_ns: int) -> int | None:
        """Return how long an application must wait if all others keep to their times; None if any has no limit."""
        if self.holder is None or not self._waiting:
            return None
        wait_ns = None if self.until_ns is None else max(0, self.until_ns - now_ns)
        first = self._waiting[0]
        if first.asks_until_ns is not None and first.priority < self.holder.priority:
            asked_ns = max(0, first.asks_until_ns - now_ns)
            wait_ns = asked_ns if wait_ns is None else min(wait_ns, asked_ns)
        for entry in self._waiting:
            if entry.app_id == app_id:
                return wait_ns
            wait_ns = None if wait_ns is None or entry.term_ns is None else wait_ns + entry.term_ns
        return None

    # Requests from applications ----------------------------------------------------------------------------------

    def request(
        self, app_id: int, priority: int, queue: bool, now_ns: int, *, term_ns: int | None = None, ask: bool = False
    ) -> list[Effect]:
        """Request the authority, or change an earlier request's priority or time.

        ``queue``: whether to wait in the queue. ``term_ns``: requested duration; None means until it is released.
        ``ask``: whether to ask the holder first. Afterwards the application holds the authority, has a :meth:`position`
        in the queue, or was refused because a holder has at least the same priority.
        """
        effects: list[Effect] = []
        if self.holder is not None and self.holder.app_id == app_id:
            self.holder = replace(self.holder, priority=priority)
            self._change_term(term_ns, now_ns)
            if not (self._waiting and self._is_over(now_ns)):
                return self._settle(now_ns)
            effects.append(self._relieve())  # like all others, the application must request the authority again
        entry, asked_before = self._dequeue(app_id, priority, term_ns, ask, now_ns)
        if queue or self._may_be_taken(entry, now_ns):
            insort(self._waiting, entry)
            self._known_positions.pop(app_id, None)
        effects += self._hand_over(now_ns)
        if not queue and entry in self._waiting:  # other applications of higher priority were waiting
            self._waiting.remove(entry)
        effects += self._moved(now_ns)
        holder = self.holder
        if holder is None or holder.app_id == app_id:
            return effects
        asks_until_ns = entry.asks_until_ns if entry in self._waiting else None
        if asks_until_ns is not None and not asked_before:
            effects.append(Asked(holder.app_id, self.lease, app_id, priority, asks_until_ns, term_ns))
        elif asks_until_ns is None and asked_before:
            effects.append(Withdrawn(holder.app_id, self.lease, app_id))
        return effects

    def answer(self, app_id: int, lease: int, by_id: int, grant: bool, reason: str, now_ns: int) -> list[Effect]:
        """Handle the holder's answer. Does nothing if ``app_id`` is not the holder, or if ``by_id`` has not asked.

        If the holder agrees, the authority passes to the first in the queue. The former holder then waits, with no
        higher priority. A refusal is reported. A strictly higher priority still wins once the time to answer is up.
        """
        holder = self.holder
        asker = next((entry for entry in self._waiting if entry.app_id == by_id), None)
        if holder is None or (holder.app_id, self.lease) != (app_id, lease):
            return []
        if asker is None or asker.asks_until_ns is None:
            return []
        if not grant:
            return [Declined(by_id, app_id, reason)]
        return self._pre_empt(now_ns, granted=True) + self._moved(now_ns)

    def release(self, app_id: int, now_ns: int) -> list[Effect]:
        """Release the authority, or leave the queue. Does nothing for other applications."""
        return self._drop(app_id, "released", now_ns)

    def gone(self, app_id: int, now_ns: int) -> list[Effect]:
        """Handle the end of the application's connection."""
        return self._drop(app_id, "gone", now_ns)

    def update(self, now_ns: int) -> list[Effect]:
        """Apply changes that are due at this time. Call at a steady pace.

        The lease of a silent holder ends. The lease of a holder whose time is over ends while others wait. A holder
        that has been asked for long enough is pre-empted.
        """
        holder = self.holder
        if holder is None:
            return []
        if now_ns - max(self.last_command_ns, self._granted_ns) >= self.timeout_ns:
            effects = self._drop(holder.app_id, "silent", now_ns)
            if self.holder is None:
                self.silent = holder
            return effects
        effects = self._settle(now_ns)
        if self._is_over(now_ns) and not self._expiry_reported:  # nobody waits, or the lease would have ended
            self._expiry_reported = True
            effects.append(Expired(holder.app_id, self.lease))
        return effects

    def slept(self, ns: int) -> None:
        """Make everything older by this time, because the computer slept and its clock stopped meanwhile."""
        self.last_command_ns -= ns
        self._granted_ns -= ns
        if self.until_ns is not None:
            self.until_ns -= ns

    # Inside ----------------------------------------------------------------------------------------------------

    def _dequeue(
        self, app_id: int, priority: int, term_ns: int | None, ask: bool, now_ns: int
    ) -> tuple[QueueEntry, bool]:
        """Remove the application's queue entry. Return the new one, and whether the old one had asked the holder."""
        known = next((entry for entry in self._waiting if entry.app_id == app_id), None)
        asked_before = known is not None and known.asks(now_ns)
        if known is not None:
            self._waiting.remove(known)
            arrival = known.arrival
        else:
            self._arrivals += 1
            arrival = self._arrivals
        asks_until_ns = known.asks_until_ns if known is not None and asked_before else now_ns + self.ask_ns
        return QueueEntry(priority, arrival, app_id, term_ns, asks_until_ns if ask else None), asked_before

    def _may_be_taken(self, entry: QueueEntry, now_ns: int) -> bool:
        """Return whether this entry need not wait."""
        holder = self.holder
        if holder is None or self._is_over(now_ns):
            return True
        return entry.priority < holder.priority and not entry.asks(now_ns)

    def _is_over(self, now_ns: int) -> bool:
        return self.holder is not None and self.until_ns is not None and now_ns >= self.until_ns

    def _change_term(self, term_ns: int | None, now_ns: int) -> None:
        """Set the holder's remaining time. The time can't be extended while others wait. None leaves it unchanged."""
        if term_ns is None:
            return
        until_ns = now_ns + term_ns
        if self._waiting and self.until_ns is not None:
            until_ns = min(until_ns, self.until_ns)
        self.until_ns, self._expiry_reported = until_ns, False

    def _pre_empt(self, now_ns: int, *, granted: bool = False) -> list[Effect]:
        """Give the authority to the first application in the queue. The former holder then waits.

        The old holder keeps its remaining time, but gets at most the new one's priority, or it would win again at once.
        """
        holder, lease = self.holder, self.lease
        assert holder is not None
        left_ns = None if self.until_ns is None else max(1, self.until_ns - now_ns)
        grant = self._grant(now_ns)
        priority = max(holder.priority, grant.priority)
        insort(self._waiting, replace(holder, priority=priority, term_ns=left_ns))
        return [Preempted(holder.app_id, lease, grant.app_id, grant.priority, granted), grant]

    def _relieve(self) -> Lost:
        """End the lease of a holder whose time is up, if others are waiting."""
        assert self.holder is not None
        lost = Lost(self.holder.app_id, self.lease, "expired")
        self._vacate()
        return lost

    def _vacate(self) -> None:
        self.holder, self.lease, self.until_ns, self._expiry_reported = None, 0, None, False

    def _drop(self, app_id: int, reason: str, now_ns: int) -> list[Effect]:
        effects: list[Effect] = []
        if self.holder is not None and self.asking(app_id, now_ns):
            effects.append(Withdrawn(self.holder.app_id, self.lease, app_id))
        self._waiting = [entry for entry in self._waiting if entry.app_id != app_id]
        if self.silent is not None and self.silent.app_id == app_id:
            self.silent = None
        if self.holder is not None and self.holder.app_id == app_id:
            effects.append(Lost(app_id, self.lease, reason))
            self._vacate()
        return effects + self._settle(now_ns)

    def _settle(self, now_ns: int) -> list[Effect]:
        """Hand the authority over if this is due. Then report each application's changed position in the queue."""
        return self._hand_over(now_ns) + self._moved(now_ns)

    def _hand_over(self, now_ns: int) -> list[Effect]:
        """Give the authority to the first application in the queue if this is due.

        This is due if there is no holder, the holder's time is over, or a strictly higher priority need not wait.
        """
        effects: list[Effect] = []
        holder = self.holder
        if holder is not None and self._waiting:
            if self._is_over(now_ns):
                effects.append(self._relieve())
            elif any(entry.priority < holder.priority and not entry.asks(now_ns) for entry in self._waiting):
                effects += self._pre_empt(now_ns)
        if self.holder is None and self._waiting:
            effects.append(self._grant(now_ns))
        return effects

    def _grant(self, now_ns: int) -> Granted:
        first = self._waiting.pop(0)
        self._last_lease += 1
        self.holder, self.lease, self._granted_ns = replace(first, asks_until_ns=None), self._last_lease, now_ns
        self.until_ns = None if first.term_ns is None else now_ns + first.term_ns
        self._expiry_reported = False
        self.silent = None
        return Granted(first.app_id, first.priority, self.lease, self.until_ns)

    def _moved(self, now_ns: int) -> list[Effect]:
        """Report each position in the queue that has changed."""
        positions = {entry.app_id: position for position, entry in enumerate(self._waiting, 1)}
        moved: list[Effect] = [
            Queued(entry.app_id, entry.priority, positions[entry.app_id], self.wait_ns(entry.app_id, now_ns))
            for entry in self._waiting
            if self._known_positions.get(entry.app_id) != positions[entry.app_id]
        ]
        self._known_positions = positions
        return moved
