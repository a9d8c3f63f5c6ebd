"""Accept connections on the listening socket, and limit their number and how long they may be silent.

A connection is *anonymous* until an admitted person has sent a request over it. The number of anonymous connections is
limited, but a new connection is always accepted. To make room, a connection from the address with the most connections
is closed, preferably one whose request was rejected, otherwise the oldest. A flood of strangers therefore displaces
only itself, and people who send a request immediately are served even during a flood. Connections of logged-in people
have a separate limit, and some of them are reserved for pilots. These decisions take the time as an argument.

asyncio's own listener accepts connections until it runs out of descriptors, and then logs errors endlessly. This module
therefore accepts connections itself and hands them to the HTTP server.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.cockpit.access import Person
from skyloop.cockpit.feeds import start_task
from skyloop.messages import Role

MAX_ANONYMOUS: Final = 128  #: sufficient for everyone to log in at the same time
MAX_ANONYMOUS_OF_ADDRESS: Final = 32  #: a browser opens six connections, and several browsers may share one address
MAX_KNOWN: Final = 512  #: a page that shows a drone with two cameras has about eight
MAX_KNOWN_OF_ADDRESS: Final = 192  #: limit for each role; a whole classroom may share one address
_PILOTS_SHARE: Final = 0.25  # fraction of the known connections that is reserved for pilots
DESCRIPTORS_LEFT: Final = 128  #: descriptors reserved for drones, recordings, child processes and files

HEADER_S: Final = 5.0  #: time limit for a TLS handshake and a whole request
NEXT_S: Final = 10.0  #: time limit for the next request on a connection; the server closes idle connections sooner
ANSWER_S: Final = 30.0  #: time limit for a stranger's request and the response to it


@dataclass(frozen=True, slots=True)
class Places:
    """The maximum number of connections of each kind."""

    anonymous: int = MAX_ANONYMOUS
    anonymous_of_address: int = MAX_ANONYMOUS_OF_ADDRESS
    known: int = MAX_KNOWN
    known_of_address: int = MAX_KNOWN_OF_ADDRESS

    @property
    def observers(self) -> int:
        """The number of known connections available to observers; the rest are reserved for pilots."""
        return self.known - round(self.known * _PILOTS_SHARE)

    @classmethod
    def within(cls, descriptors: int) -> Places:
        """Return the limits for a process that may open this number of descriptors."""
        share = min(1.0, max(descriptors - DESCRIPTORS_LEFT, descriptors // 4) / (MAX_ANONYMOUS + MAX_KNOWN))
        most = (MAX_ANONYMOUS, MAX_ANONYMOUS_OF_ADDRESS, MAX_KNOWN, MAX_KNOWN_OF_ADDRESS)
        return cls(*(max(1, int(number * share)) for number in most))


@dataclass(eq=False, slots=True)
class Connection:
    """An open connection. ``end`` closes the connection immediately; ``person`` is who was admitted over it."""

    address: str
    end: Callable[[], None]
    person: Person | None = None
    deadline_ns: int | None = None  #: the connection is closed if nothing happens by this time
    asked: bool = False  #: whether a stranger's request has arrived on it


@dataclass(slots=True)
class AdmissionCounts:
    """Counts since startup."""

    displaced: int = 0  #: anonymous connections closed in favour of newer ones
    timed_out: int = 0  #: connections closed because they were silent
    refused: int = 0  #: requests refused because the person had too many connections


@dataclass
class Admission:
    """Keeps track of open connections. Not thread-safe."""

    places: Places = field(default_factory=Places)
    counts: AdmissionCounts = field(default_factory=AdmissionCounts)

    def __post_init__(self) -> None:
        self._anonymous: dict[str, dict[Connection, None]] = {}  # keyed by address, oldest first
        self._known: dict[Connection, None] = {}

    @property
    def anonymous(self) -> int:
        """The number of open anonymous connections."""
        return sum(len(connections) for connections in self._anonymous.values())

    @property
    def known(self) -> int:
        """The number of open connections from known people."""
        return len(self._known)

    def opened(self, connection: Connection, now_ns: int) -> None:
        """Add a new connection. If it replaces another connection, close the old one."""
        if len(self._anonymous.get(connection.address, ())) >= self.places.anonymous_of_address:
            self._displace(connection.address)
        elif self.anonymous >= self.places.anonymous:
            self.shed()
        self._anonymous.setdefault(connection.address, {})[connection] = None
        connection.deadline_ns = now_ns + nanoseconds(HEADER_S)

    def shed(self) -> None:
        """Close an anonymous connection from the address that has the most anonymous connections."""
        if self._anonymous:
            self._displace(max(self._anonymous, key=lambda address: len(self._anonymous[address])))

    def requested(self, connection: Connection, person: Person | None, now_ns: int) -> str:
        """Record that a complete request has arrived.

        ``person``: the sender, or None for a stranger. Return why the request is refused, or "" if it is accepted.
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
        """Record that the answer was sent and that the connection is waiting for its next request."""
        connection.deadline_ns = now_ns + nanoseconds(NEXT_S)

    def closed(self, connection: Connection) -> None:
        """Remove a closed connection; do nothing if it is not listed."""
        self._known.pop(connection, None)
        of_address = self._anonymous.get(connection.address, {})
        of_address.pop(connection, None)
        if not of_address:
            self._anonymous.pop(connection.address, None)

    def end_overdue(self, now_ns: int) -> None:
        """Close connections that have been silent for too long."""
        everybody = [*self._known, *(one for connections in self._anonymous.values() for one in connections)]
        for connection in everybody:
            if connection.deadline_ns is not None and now_ns >= connection.deadline_ns:
                self.counts.timed_out += 1
                self._end(connection)

    def _full(self, connection: Connection, person: Person) -> str:
        """Return why this person may not open another connection from this address; empty if one is allowed."""
        role, places = person.role, self.places
        roles = Counter(one.person.role for one in self._known if one.person is not None and one is not connection)
        here = sum(
            one.address == connection.address and one.person is not None and one.person.role is role
            for one in self._known
        )
        if here >= places.known_of_address:
            return (
                f"{here} {role} connections are open from {connection.address}, at most "
                f"{places.known_of_address} are allowed: close some pages"
            )
        open_ = sum(roles.values())
        if open_ >= places.known or (role is Role.OBSERVER and roles[role] >= places.observers):
            return f"{open_} {role} connections are open, the most that this cockpit accepts: close some pages"
        return ""

    def _displace(self, address: str) -> None:
        # Connections on which a stranger's request arrived, such as one with a wrong token, are closed first. Otherwise
        # a guesser, whose responses are delayed, could displace the handshakes of people at the same address.
        self.counts.displaced += 1
        of_address = self._anonymous[address]
        self._end(next((one for one in of_address if one.asked), next(iter(of_address))))

    def _end(self, connection: Connection) -> None:
        self.closed(connection)
        connection.end()


BACKLOG: Final = 1024  #: maximum number of connections queued by the kernel; a client retries a dropped one after 1 s
AT_ONCE: Final = 16  #: number of connections accepted before existing ones are served again
PAUSE_S: Final = 0.1  #: pause after the system refused a connection for lack of resources
SWEEP_S: Final = 0.5  #: interval between the checks that close silent connections
_NO_ROOM: Final = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)

_MAX_MESSAGES: Final = 256  # number of messages a filter remembers; the program has fewer kinds of messages

_log = logging.getLogger(__name__)

#: Creates the HTTP protocol for one connection.
ProtocolFactory = Callable[[Connection], asyncio.Protocol]


class _Accepted(socket.socket):
    """A connection's socket, which reports when it is closed, whichever protocol used it last."""

    on_close: Callable[[], None] | None = None

    def close(self) -> None:
        super().close()
        on_close, self.on_close = self.on_close, None
        if on_close is not None:
            on_close()


class Acceptor:
    """Accepts connections while :meth:`run` is running, as long as the admission has room. Used on the event loop."""

    def __init__(
        self,
        listening: socket.socket,
        admission: Admission,
        protocol: ProtocolFactory,
        tls: ssl.SSLContext | None = None,
        clock: Clock = monotonic_ns,
    ) -> None:
        self._listening = listening
        self._admission = admission
        self._protocol = protocol
        self._tls = tls
        self._clock = clock
        self._handing_over: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Accept connections until cancelled. Connections that are already open stay open."""
        self._listening.setblocking(False)
        self._listening.listen(BACKLOG)
        sweeping = asyncio.create_task(self._sweep())
        try:
            await self._accept()
        finally:
            for task in (sweeping, *self._handing_over):
                task.cancel()
            await asyncio.gather(sweeping, *self._handing_over, return_exceptions=True)

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        taken = 0
        while True:
            try:
                bare, address = await loop.sock_accept(self._listening)
            except OSError as error:
                if error.errno == errno.EBADF:
                    raise  # the listening socket was closed
                if error.errno in _NO_ROOM:
                    self._admission.shed()
                    _log.warning("can't accept connections: %s", error.strerror)
                # Other errors affect only the connection that was being accepted, which is already gone.
                await asyncio.sleep(PAUSE_S if error.errno in _NO_ROOM else 0)
                continue
            self._open(bare, str(address[0]))
            taken += 1
            if taken % AT_ONCE == 0:  # a flood of connections must not keep pages waiting
                await asyncio.sleep(0)

    def _open(self, bare: socket.socket, address: str) -> None:
        accepted = _Accepted(fileno=bare.detach())
        accepted.setblocking(False)
        connection = Connection(address, lambda: _shut(accepted))
        accepted.on_close = lambda: self._admission.closed(connection)
        self._admission.opened(connection, self._clock())
        start_task(self._hand_over(accepted, connection), self._handing_over)

    async def _hand_over(self, accepted: _Accepted, connection: Connection) -> None:
        timeout_s = None if self._tls is None else HEADER_S
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: self._protocol(connection), accepted, ssl=self._tls, ssl_handshake_timeout=timeout_s
            )
        except OSError:
            accepted.close()  # the handshake failed or the client has disconnected
        except BaseException:
            accepted.close()
            raise

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            self._admission.end_overdue(self._clock())


def places_here() -> Places:
    """Return the limits that suit the descriptor limit of this process."""
    if sys.platform == "win32":  # without such a limit
        return Places()
    import resource

    descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return Places() if descriptors == resource.RLIM_INFINITY else Places.within(descriptors)


def _shut(accepted: socket.socket) -> None:
    """Shut down a connection, so that its protocol or the handshake reads the end of file and closes the connection."""
    with suppress(OSError):  # already closed
        accepted.shutdown(socket.SHUT_RDWR)


def limit_messages() -> None:
    """Limit the log messages that strangers can cause to one message of each kind per period."""
    for name in (__name__, "uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_REPEATS)


class RepeatLimit(logging.Filter):
    """A log filter that passes each message at most once per ``every_s`` [s] and adds the number of suppressed repeats.

    Messages that differ only in their values are considered equal. The filter remembers 256 messages, and first forgets
    the message that it passed longest ago.
    """

    def __init__(self, every_s: float = 10.0, clock: Clock = monotonic_ns) -> None:
        super().__init__()
        self._every_ns = round(every_s * 1e9)
        self._clock = clock
        self._logged: dict[str, tuple[int, int]] = {}  # time, and repeats dropped since, by message without values

    def filter(self, record: logging.LogRecord) -> bool:
        key, now_ns = f"{record.name} {record.msg}", self._clock()
        logged_ns, left_out = self._logged.get(key, (None, 0))
        if logged_ns is not None and now_ns - logged_ns < self._every_ns:
            self._logged[key] = logged_ns, left_out + 1
            return False
        if left_out:
            record.msg = f"{record.msg} ({left_out} more such messages)"
        self._logged.pop(key, None)  # keeps messages ordered by when they were last passed
        if len(self._logged) >= _MAX_MESSAGES:
            del self._logged[next(iter(self._logged))]
        self._logged[key] = now_ns, 0
        return True


_REPEATS: Final = RepeatLimit()
