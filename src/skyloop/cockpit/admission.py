"""How many connections may be open, and for how long one may be silent. Times are arguments.

A connection is *anonymous* until a request of a person who may come in was read from it. Anonymous connections have few
places, and the newest always has one: another of the address that has most gives up its own, one that has asked in vain
before the oldest. So a flood of strangers displaces itself, and somebody who sends a request at once is served in the
midst of it. People who are logged in have places of their own, some of them for pilots alone, and nobody else's
connections take those away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.cockpit.access import Person
from skyloop.messages import Role

MAX_ANONYMOUS: Final = 128  #: enough for everybody who logs in at one time
MAX_ANONYMOUS_OF_ADDRESS: Final = 32  #: a browser opens six, and several may share an address
MAX_KNOWN: Final = 512  #: a page that shows a drone with two cameras has about eight
MAX_KNOWN_OF_ADDRESS: Final = 192  #: of one role; a page, a class-room behind one router, a measuring program
_PILOTS_SHARE: Final = 0.25  # of the known: kept for pilots
DESCRIPTORS_LEFT: Final = 128  #: for drones, recordings, children and files; connections take none of these

HEADER_S: Final = 5.0  #: for a TLS handshake and a whole request
NEXT_S: Final = 10.0  #: for the next request of a connection; the server itself closes those that stay idle before
ANSWER_S: Final = 30.0  #: for a request of somebody unknown, and its answer


@dataclass(frozen=True, slots=True)
class Places:
    """How many connections there may be of each sort."""

    anonymous: int = MAX_ANONYMOUS
    anonymous_of_address: int = MAX_ANONYMOUS_OF_ADDRESS
    known: int = MAX_KNOWN
    known_of_address: int = MAX_KNOWN_OF_ADDRESS

    @property
    def observers(self) -> int:
        """How many of the known may be observers: the others are kept for pilots."""
        return self.known - round(self.known * _PILOTS_SHARE)

    @classmethod
    def within(cls, descriptors: int) -> Places:
        """Return as many places as a process with so many descriptors can have."""
        share = min(1.0, max(descriptors - DESCRIPTORS_LEFT, descriptors // 4) / (MAX_ANONYMOUS + MAX_KNOWN))
        most = (MAX_ANONYMOUS, MAX_ANONYMOUS_OF_ADDRESS, MAX_KNOWN, MAX_KNOWN_OF_ADDRESS)
        return cls(*(max(1, int(number * share)) for number in most))


@dataclass(eq=False, slots=True)
class Connection:
    """An open connection. ``end`` closes it at once; ``person`` is who was let in over it."""

    address: str
    end: Callable[[], None]
    person: Person | None = None
    deadline_ns: int | None = None  #: by then something must have happened
    asked: bool = False  #: whether a request came over it of somebody who is not known


@dataclass(slots=True)
class AdmissionCounts:
    """Counts since the start."""

    displaced: int = 0  #: anonymous connections that gave their place up to a newer one
    timed_out: int = 0  #: connections that were silent for too long
    refused: int = 0  #: requests of people who had too many connections


@dataclass
class Admission:
    """Keeps the list of open connections. Not thread-safe."""

    places: Places = field(default_factory=Places)
    counts: AdmissionCounts = field(default_factory=AdmissionCounts)

    def __post_init__(self) -> None:
        self._anonymous: dict[str, dict[Connection, None]] = {}  # by address; the oldest first
        self._known: dict[Connection, None] = {}

    @property
    def anonymous(self) -> int:
        """How many anonymous connections are open."""
        return sum(len(connections) for connections in self._anonymous.values())

    @property
    def known(self) -> int:
        """How many connections of known people are open."""
        return len(self._known)

    def opened(self, connection: Connection, now_ns: int) -> None:
        """Add a new connection, and end the one whose place it takes, if any."""
        if len(self._anonymous.get(connection.address, ())) >= self.places.anonymous_of_address:
            self._displace(connection.address)
        elif self.anonymous >= self.places.anonymous:
            self.shed()
        self._anonymous.setdefault(connection.address, {})[connection] = None
        connection.deadline_ns = now_ns + nanoseconds(HEADER_S)

    def shed(self) -> None:
        """End an anonymous connection of the address that has most of them."""
        if self._anonymous:
            self._displace(max(self._anonymous, key=lambda address: len(self._anonymous[address])))

    def requested(self, connection: Connection, person: Person | None, now_ns: int) -> str:
        """Note that a whole request has come.

        Args:
            connection: Over which it came.
            person: Who sent it, None for nobody known.
            now_ns: The monotonic clock [ns].

        Returns:
            Why it is refused; empty if it is not.
        """
        if person is None:
            connection.asked = True
            connection.deadline_ns = now_ns + nanoseconds(ANSWER_S)
            return ""
        new = connection.person is None or connection.person.role is not person.role
        if new and (reason := self._full(connection, person)):
            self.counts.refused += 1
            connection.deadline_ns = now_ns + nanoseconds(HEADER_S)
            return reason
        self.closed(connection)
        connection.person = person
        connection.deadline_ns = None
        self._known[connection] = None
        return ""

    def answered(self, connection: Connection, now_ns: int) -> None:
        """Note that the answer was sent, and the next request is waited for."""
        connection.deadline_ns = now_ns + nanoseconds(NEXT_S)

    def closed(self, connection: Connection) -> None:
        """Remove a connection that is closed; does nothing for one that is not listed."""
        self._known.pop(connection, None)
        of_address = self._anonymous.get(connection.address, {})
        of_address.pop(connection, None)
        if not of_address:
            self._anonymous.pop(connection.address, None)

    def end_overdue(self, now_ns: int) -> None:
        """End the connections that were silent for too long."""
        everybody = [*self._known, *(one for connections in self._anonymous.values() for one in connections)]
        for connection in everybody:
            if connection.deadline_ns is not None and now_ns >= connection.deadline_ns:
                self.counts.timed_out += 1
                self._end(connection)

    def _full(self, connection: Connection, person: Person) -> str:
        """Return why this person can have no further connection from this address; empty if it can."""
        role, places = person.role, self.places
        roles = Counter(one.person.role for one in self._known if one.person is not None and one is not connection)
        here = sum(
            one.address == connection.address and one.person is not None and one.person.role is role
            for one in self._known
        )
        if here >= places.known_of_address:
            return (
                f"{here} connections of {role}s are open from {connection.address}, and at most "
                f"{places.known_of_address} may be: close some pages"
            )
        open_ = sum(roles.values())
        if open_ >= places.known or (role is Role.OBSERVER and roles[role] >= places.observers):
            return f"{open_} connections are open, which is all that this cockpit takes of {role}s: close some pages"
        return ""

    def _displace(self, address: str) -> None:
        # Whoever has asked and is not known, such as with a wrong token, goes before those who have not asked yet: else
        # a guesser whose answers wait would end the handshakes of people at the same address.
        self.counts.displaced += 1
        of_address = self._anonymous[address]
        self._end(next((one for one in of_address if one.asked), next(iter(of_address))))

    def _end(self, connection: Connection) -> None:
        self.closed(connection)
        connection.end()
