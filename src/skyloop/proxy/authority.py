"""Who may command: numbered leases, priorities, a line of waiting pilots. Pure: the time is an argument.

Priority 0 is the highest, 31 the lowest. At any time at most one application *holds* the authority, under a lease
whose number was never used before in this run. A strictly higher priority takes over at once, and the pilot who was
pre-empted goes on waiting with the place that its priority and first arrival give it. The rules in words are in
``docs/proxy.md``.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, replace

from skyloop.clock import nanoseconds


@dataclass(frozen=True, slots=True, order=True)
class Claim:
    """An application that holds the authority or waits for it. Sorts in the order in which claims are served."""

    priority: int  #: 0 is the highest
    arrival: int  #: number of its first request since it last held or wanted nothing
    app_id: int


@dataclass(frozen=True, slots=True)
class Granted:
    """The authority was given to ``app_id`` under a new lease."""

    app_id: int
    priority: int
    lease: int


@dataclass(frozen=True, slots=True)
class Lost:
    """The lease ended: ``released``, ``silent`` or ``gone``."""

    app_id: int
    lease: int
    reason: str


@dataclass(frozen=True, slots=True)
class Preempted:
    """The lease ended because somebody of strictly higher priority wants it; the loser waits in line."""

    app_id: int
    lease: int
    by_id: int
    by_priority: int


@dataclass(frozen=True, slots=True)
class Queued:
    """An application waits in line, ``position`` 1 being next."""

    app_id: int
    priority: int
    position: int


Effect = Granted | Lost | Preempted | Queued


class Authority:
    """The state of the right to command one vehicle. Every method returns what changed, in order."""

    def __init__(self, timeout_s: float = 2.0) -> None:
        self.timeout_ns = nanoseconds(timeout_s)  #: a holder silent for so long loses the lease
        self.holder: Claim | None = None
        self.lease = 0  #: the lease in force; 0 for none
        self.heard_ns = 0  #: when the holder sent its last valid command, or got the lease
        self._last_lease = 0
        self._arrivals = 0
        self._waiting: list[Claim] = []

    @property
    def waiting(self) -> tuple[Claim, ...]:
        """Those in line, the next one first."""
        return tuple(self._waiting)

    def position(self, app_id: int) -> int:
        """Place in the line from 1; 0 for an application that does not wait."""
        return next((place for place, claim in enumerate(self._waiting, 1) if claim.app_id == app_id), 0)

    def request(self, app_id: int, priority: int, queue: bool, now_ns: int) -> list[Effect]:
        """Ask for the authority, or change the priority of a claim.

        ``queue`` False: do not wait in line. Afterwards the application holds the authority, or has a
        :meth:`position`, or was refused because somebody of at least the same priority holds it.
        """
        if self.holder is not None and self.holder.app_id == app_id:
            self.holder = replace(self.holder, priority=priority)
            return self._settle(now_ns)
        claim = self._take_claim(app_id, priority)
        if not queue and self.holder is not None and self.holder.priority <= priority:
            return []
        insort(self._waiting, claim)
        effects = self._settle(now_ns)
        position = self.position(app_id)
        if position:
            effects.append(Queued(app_id, priority, position))
        return effects

    def release(self, app_id: int, now_ns: int) -> list[Effect]:
        """Give the authority back, or leave the line. Does nothing for an application that does neither."""
        return self._drop(app_id, "released", now_ns)

    def gone(self, app_id: int, now_ns: int) -> list[Effect]:
        """The application's connection ended."""
        return self._drop(app_id, "gone", now_ns)

    def tick(self, now_ns: int) -> list[Effect]:
        """Take the lease from a holder that sent no valid command for the time-out."""
        if self.holder is None or now_ns - self.heard_ns < self.timeout_ns:
            return []
        return self._drop(self.holder.app_id, "silent", now_ns)

    def _take_claim(self, app_id: int, priority: int) -> Claim:
        for claim in self._waiting:
            if claim.app_id == app_id:
                self._waiting.remove(claim)
                return replace(claim, priority=priority)
        self._arrivals += 1
        return Claim(priority, self._arrivals, app_id)

    def _drop(self, app_id: int, reason: str, now_ns: int) -> list[Effect]:
        self._waiting = [claim for claim in self._waiting if claim.app_id != app_id]
        if self.holder is None or self.holder.app_id != app_id:
            return []
        lost = Lost(app_id, self.lease, reason)
        self.holder, self.lease = None, 0
        return [lost, *self._settle(now_ns)]

    def _settle(self, now_ns: int) -> list[Effect]:
        """Give the authority to the first in line if nobody holds it, or somebody of lower priority does."""
        if not self._waiting:
            return []
        first = self._waiting[0]
        effects: list[Effect] = []
        if self.holder is not None:
            if self.holder.priority <= first.priority:
                return []
            effects.append(Preempted(self.holder.app_id, self.lease, first.app_id, first.priority))
            insort(self._waiting, self.holder)
        self._waiting.remove(first)
        self._last_lease += 1
        self.holder, self.lease, self.heard_ns = first, self._last_lease, now_ns
        effects.append(Granted(first.app_id, first.priority, self.lease))
        return effects
