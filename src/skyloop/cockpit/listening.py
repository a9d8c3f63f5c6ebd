"""Accepts connections at the listening socket, and hands them to the HTTP server.

asyncio's own way of listening accepts whatever comes until there are no descriptors left, and then logs errors without
end.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from skyloop.clock import Clock, monotonic_ns
from skyloop.cockpit.admission import HEADER_S, Admission, Connection, Places

BACKLOG: Final = 1024  #: connections that the kernel keeps until they are taken; a dropped one is tried again after 1 s
AT_ONCE: Final = 16  #: connections accepted before open ones have their turn
PAUSE_S: Final = 0.1  #: after the system had no room for a connection
SWEEP_S: Final = 0.5  #: how often connections that were silent for too long are ended
_NO_ROOM: Final = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)

_MAX_MESSAGES: Final = 256  # kept in mind by a limit; they are the program's own, so there are fewer

_log = logging.getLogger(__name__)

#: Makes what speaks HTTP with one connection.
ProtocolFactory = Callable[[Connection], asyncio.Protocol]


class _Accepted(socket.socket):
    """A connection's socket, which reports when it is closed, whichever protocol had it last."""

    on_close: Callable[[], None] | None = None

    def close(self) -> None:
        super().close()
        on_close, self.on_close = self.on_close, None
        if on_close is not None:
            on_close()


class Listener:
    """Accepts connections while :meth:`run` runs, as many as the admission has places for. On the event loop.

    Args:
        listening: Bound already.
        admission: Counts the connections.
        protocol: Makes the HTTP protocol of a connection.
        tls: For HTTPS.
        clock: The monotonic clock [ns].
    """

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
        """Accept connections until it is cancelled; connections that are open stay so."""
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
                    raise  # nobody listens any more
                if error.errno in _NO_ROOM:
                    self._admission.shed()
                    _log.warning("no connection can be taken: %s", error.strerror)
                # Other errors are of the one connection that was to be taken, which is gone again.
                await asyncio.sleep(PAUSE_S if error.errno in _NO_ROOM else 0)
                continue
            self._open(bare, str(address[0]))
            taken += 1
            if taken % AT_ONCE == 0:  # a flood of them must not keep pages waiting
                await asyncio.sleep(0)

    def _open(self, bare: socket.socket, address: str) -> None:
        accepted = _Accepted(fileno=bare.detach())
        accepted.setblocking(False)
        connection = Connection(address, lambda: _shut(accepted))
        accepted.on_close = lambda: self._admission.closed(connection)
        self._admission.opened(connection, self._clock())
        task = asyncio.create_task(self._hand_over(accepted, connection))
        self._handing_over.add(task)
        task.add_done_callback(self._handing_over.discard)

    async def _hand_over(self, accepted: _Accepted, connection: Connection) -> None:
        timeout_s = None if self._tls is None else HEADER_S
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: self._protocol(connection), accepted, ssl=self._tls, ssl_handshake_timeout=timeout_s
            )
        except OSError:
            accepted.close()  # the handshake failed, or the other end is gone
        except BaseException:
            accepted.close()
            raise

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            self._admission.end_overdue(self._clock())


def places_here() -> Places:
    """Return as many places as this process's limit of descriptors leaves room for."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return Places()
    descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return Places() if descriptors == resource.RLIM_INFINITY else Places.within(descriptors)


def _shut(accepted: socket.socket) -> None:
    """Shut a connection down; its protocol, or the handshake, then reads the end of file and closes it."""
    with suppress(OSError):  # it is closed already
        accepted.shutdown(socket.SHUT_RDWR)


def limit_messages() -> None:
    """Limit the log messages that strangers can cause: each once in a while, and not for each connection."""
    for name in (__name__, "uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_REPEATS)


class RepeatLimit(logging.Filter):
    """A log filter that lets each message through once in ``every_s`` [s], with the count of those left out.

    Messages count as equal if they differ in their values only. Of more than 256 different ones, the one that was let
    through longest ago is forgotten.

    Args:
        every_s: The time [s].
        clock: The monotonic clock [ns].
    """

    def __init__(self, every_s: float = 10.0, clock: Clock = monotonic_ns) -> None:
        super().__init__()
        self._every_ns = round(every_s * 1e9)
        self._clock = clock
        self._logged: dict[str, tuple[int, int]] = {}  # by the message without its values: when, and how many since

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to log a record."""
        key, now_ns = f"{record.name} {record.msg}", self._clock()
        logged_ns, left_out = self._logged.get(key, (None, 0))
        if logged_ns is not None and now_ns - logged_ns < self._every_ns:
            self._logged[key] = logged_ns, left_out + 1
            return False
        if left_out:
            record.msg = f"{record.msg} ({left_out} more such messages)"
        self._logged.pop(key, None)  # so that they stand in the order in which they were let through
        if len(self._logged) >= _MAX_MESSAGES:
            del self._logged[next(iter(self._logged))]
        self._logged[key] = now_ns, 0
        return True


_REPEATS: Final = RepeatLimit()
