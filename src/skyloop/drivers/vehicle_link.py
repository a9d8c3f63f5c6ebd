"""Serve the vehicle link over sockets: run its thread, and renew the sockets while nothing is received.

The session decides what the link transmits: see :mod:`skyloop.drivers.vehicle_session`.
"""

from __future__ import annotations

import errno
import ipaddress
import selectors
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from functools import partial
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import ServedLink, Sink
from skyloop.drivers.vehicle_session import SinkCallback, VehicleSession
from skyloop.messages import AnyAction, EventKind, Severity
from skyloop.platform import socket_pair

NAME_WAIT_S: Final = 0.2  #: time within which most name look-ups finish
PAUSE_S: Final = 0.03  #: pause after an error
RENEW_NS: Final = nanoseconds(2.0)  #: how often to renew sockets that receive nothing; this host may have a new address
MAX_DATAGRAM: Final = 65_536  #: size of the receive buffer [bytes], more than any UDP datagram needs
BURST: Final = 32  #: maximum number of datagrams to read before commands are sent

S = TypeVar("S", bound=VehicleSession)
C = TypeVar("C", bound="Readable")


class Readable(Protocol):
    """Anything with a file descriptor for which the link can wait, such as a socket."""

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class NameLookup:
    """Looks up one host name at a time, in its own thread: without a network, a resolver often takes 10 s.

    Not thread-safe. ``wait_s`` must be 0 on a thread that also serves other links.
    """

    def __init__(self, family: socket.AddressFamily = socket.AF_INET, wait_s: float = NAME_WAIT_S) -> None:
        self._family = family
        self._wait_s = wait_s
        self._asking: Future[str] | None = None

    @property
    def answered(self) -> bool:
        """Whether a pending look-up has finished and :meth:`address` is worth calling again."""
        return self._asking is not None and self._asking.done()

    def address(self, host: str) -> str:
        """Return the first address of a host, or raise ``OSError`` if it is not known within ``wait_s``."""
        try:
            return str(ipaddress.ip_address(host))
        except ValueError:
            pass
        if self._asking is None:
            self._asking = Future()
            resolve = partial(_resolve, self._asking, host, self._family)
            threading.Thread(target=resolve, name="skyloop-lookup", daemon=True).start()
        question = self._asking
        if not wait([question], self._wait_s).done:
            raise OSError(errno.ETIMEDOUT, f"the name {host} is still being looked up")
        self._asking = None
        return question.result()


def _resolve(question: Future[str], host: str, family: socket.AddressFamily) -> None:
    try:
        question.set_result(str(socket.getaddrinfo(host, None, family, socket.SOCK_STREAM)[0][4][0]))
    except UnicodeError:  # a label of the name is too long
        question.set_exception(OSError(errno.EINVAL, f"{host!r:.80} is not a valid host name"))
    except Exception as error:  # noqa: BLE001  (raised where the answer is awaited)
        question.set_exception(error)


class VehicleLink(ABC, Generic[S]):
    """Serves a session in its own thread from :meth:`start` to :meth:`stop`.

    The session makes all decisions while ``lock`` is held. Its callbacks run after the lock is released. A subclass for
    a kind of vehicle implements :meth:`_open_sockets`, :meth:`_close_sockets` and :meth:`_send_due`, and passes each
    socket that it opens to :meth:`_watch`.

    Args:
        name: Name of the thread.
        session: Protocol of the vehicle.
        deliver: Called on the link's thread with the callbacks that the session has queued for the sink.
        clock: A monotonic clock [ns].
        family: Address family used to look up the host.
        close_s: How long :meth:`stop` waits for the thread to end.
        serve: Passes the link to a thread that serves several links; None: the link uses its own thread.
    """

    def __init__(
        self,
        name: str,
        session: S,
        deliver: Callable[[list[SinkCallback]], None],
        clock: Clock = monotonic_ns,
        *,
        family: socket.AddressFamily = socket.AF_INET,
        close_s: float = 2.0,
        serve: Callable[[ServedLink], None] | None = None,
    ) -> None:
        self.session = session
        self.lock = threading.Lock()
        self._deliver = deliver
        self._clock = clock
        self._stopping = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._awake, self._waker = socket_pair()
        self._lookup = NameLookup(family) if serve is None else NameLookup(family, wait_s=0.0)
        self._awake_ns = 0  # latest time at which the link's thread wakes
        self._opened_ns: int | None = None  # when sockets were last opened, or an attempt was made to open them
        self._close_s = close_s
        self._within: int | None = None  # identity of the thread that currently serves the link
        self._ended = threading.Event()
        self._serve_elsewhere = serve
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread, or let a shared thread serve the link."""
        self._awake.setblocking(False)
        self._waker.setblocking(False)
        self._watch(self._awake, self._drain_wakeups)
        if self._serve_elsewhere is not None:
            self._serve_elsewhere(self)
        else:
            self._thread.start()

    def stop(self) -> None:
        """Stop the thread, close the sockets and end the session; callers that wait for an answer get none."""
        self._stopping.set()
        self._wake()
        if self._within != threading.get_ident():
            self._ended.wait(self._close_s)
        with self.lock:
            self.session.close()

    def command(self, action: AnyAction) -> AnyAction:
        """Pass an action to the session; if possible, send it immediately. Return the resulting action. Thread-safe."""
        return self._decide(partial(self.session.command, action))

    # For methods of subclasses that the proxy's threads call ------------------------------------------------------

    def _decide(self, decide: Callable[[int], AnyAction]) -> AnyAction:
        with self.lock:
            now_ns = self._clock()
            applied = decide(now_ns)
            if self.session.due_ns <= now_ns:
                self._send_due(now_ns)
            sooner = self.session.due_ns < self._awake_ns
        if sooner:
            self._wake()
        return applied

    def _wait_for_answer(
        self, ask: Callable[[Callable[[str | None], None]], None], within_s: float, otherwise: str | None
    ) -> str | None:
        """Send a request; return the answer, or ``otherwise`` if none arrives in time. Never on the link's thread.

        ``ask`` is called with the lock held, and receives the function to call with the answer.
        """
        done = threading.Event()
        answers: list[str | None] = []

        def end(answer: str | None) -> None:
            answers.append(answer)
            done.set()

        with self.lock:
            ask(end)
        self._wake()
        done.wait(within_s)
        return answers[0] if answers else otherwise

    # On the link's thread ----------------------------------------------------------------------------------------

    @abstractmethod
    def _open_sockets(self) -> None:
        """Replace the sockets with new ones. Called on the link's thread, without the lock.

        Raises ``OSError`` if the sockets can't be opened; the link retries.
        """

    @abstractmethod
    def _close_sockets(self) -> None:
        """Close the sockets that :meth:`_open_sockets` opened. The caller holds the lock."""

    @abstractmethod
    def _send_due(self, now_ns: int) -> None:
        """Send everything that is due. Called with the lock held, on any thread."""

    def _renewal_ns(self) -> int | None:
        """Return how long after opening the sockets they are reopened; None if they should stay open for now.

        The default suits UDP: sockets are reopened while they receive nothing. Called with the lock held.
        """
        return None if self.session.is_receiving else RENEW_NS

    def _poll(self, now_ns: int) -> None:
        """Do work at regular intervals. Called with the lock held, on the link's thread."""

    def _watch(self, source: Readable, ready: Callable[[], None]) -> None:
        """Call a function on the link's thread, without the lock, whenever a source is readable."""
        self._selector.register(source, selectors.EVENT_READ, ready)

    def _forget(self, source: Readable) -> None:
        """Stop watching a source and close it."""
        with suppress(KeyError, ValueError):
            self._selector.unregister(source)
        source.close()

    def _read_datagrams(
        self, port: socket.socket, handle: Callable[[bytes, int], None], sender: str | None = None
    ) -> None:
        """Handle at most :data:`BURST` received datagrams; with a ``sender``, only datagrams from that address."""
        for _ in range(BURST):
            try:
                datagram, source = port.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                with self.lock:
                    self.session.failed(error)
                return
            if sender is None or source[0] == sender:
                with self.lock:
                    handle(datagram, self._clock())

    def _send_datagram(self, port: socket.socket, datagram: bytes) -> None:
        """Send a datagram; report failures to the session. Called with the lock held."""
        try:
            port.send(datagram)
        except BlockingIOError:
            pass  # the datagram is lost, which any datagram may be
        except OSError as error:
            self.session.failed(error)

    def _renew(self) -> None:
        now_ns = self._clock()
        with self.lock:
            pace_ns = self._renewal_ns()
        if pace_ns is None:
            return
        if self._opened_ns is not None and now_ns - self._opened_ns < pace_ns and not self._lookup.answered:
            return
        self._opened_ns = now_ns
        try:
            self._open_sockets()
        except OSError as error:
            with self.lock:
                self.session.failed(error)

    def _step(self, *, wait: bool = True, poll: bool = True) -> None:
        self._renew()  # renew sockets before waiting; none is then closed between becoming readable and being read
        with self.lock:
            self._awake_ns = self.session.due_ns
            wait_ns = self._awake_ns - self._clock() if wait else 0
        for key, _ in self._selector.select(max(0.0, seconds(wait_ns))) if poll else ():
            key.data()
        with self.lock:
            now_ns = self._clock()
            if now_ns >= self.session.due_ns:
                self._send_due(now_ns)
            self._poll(now_ns)
            pending = self.session.drain()
        if not self._stopping.is_set():
            self._deliver(pending)

    def _run(self) -> None:
        self._within = threading.get_ident()
        try:
            while not self._stopping.is_set():
                try:
                    self._step()
                except Exception as error:  # noqa: BLE001  commands must keep flowing to the vehicle
                    self._deliver([partial(_report_failure, error)])
                    self._stopping.wait(PAUSE_S)
        finally:
            self.end()

    def end(self) -> None:
        """Close everything, on the serving thread; afterwards nothing is delivered."""
        with self.lock:
            self._close_sockets()
        self._selector.close()
        self._awake.close()
        self._waker.close()
        self._ended.set()

    # On a shared thread -----------------------------------------------------------------------------------------------

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when there is work to do."""
        if sys.platform == "win32":  # whose selector has none; a host there gives each link a thread
            raise NotImplementedError
        return self._selector.fileno()

    def serve(self, *, readable: bool) -> int | None:
        """Do all pending work, as described in :class:`skyloop.drivers.base.ServedLink`."""
        if self._stopping.is_set():
            return None
        self._within = threading.get_ident()
        try:
            self._step(wait=False, poll=readable)
        except Exception as error:
            self._deliver([partial(_report_failure, error)])
            raise
        finally:
            self._within = None
        with self.lock:
            self._awake_ns = self.session.due_ns
            return self._awake_ns

    def _wake(self) -> None:
        """Wake the link's thread. Thread-safe."""
        with suppress(OSError):  # the thread is already awake or has ended
            self._waker.send(b"\0")

    def _drain_wakeups(self) -> None:
        with suppress(OSError):
            while self._awake.recv(4096):
                pass


class ConnectionLink(VehicleLink[S], Generic[S, C]):
    """A link over one connection that is reopened when it breaks or delivers nothing.

    A subclass for a kind of vehicle implements :meth:`_connect`, :meth:`_read` and :meth:`_send_due`.
    """

    RETRY_NS: ClassVar[int]  #: pause between attempts to connect

    _silent_ns: int | None = None  # time without data before the connection is reopened; None: it never is
    _connection: C | None = None
    _broken = False  # whether nothing more can be sent

    @abstractmethod
    def _connect(self) -> C:
        """Open a connection. Called on the link's thread, without the lock.

        Raises ``OSError`` if the connection can't be opened; the link retries.
        """

    @abstractmethod
    def _read(self, connection: C) -> None:
        """Pass the received data to the session. Called on the link's thread, without the lock.

        Raises ``OSError`` if the connection has ended.
        """

    def _on_end(self, connection: C) -> None:
        """Send everything that is due before the connection is finally closed. Called with the lock held."""

    def _on_broken(self, error: OSError, now_ns: int) -> None:
        """Handle a connection that no longer accepts data. Called with the lock held."""
        self._broken = True
        self.session.broken(error, now_ns)

    def _renewal_ns(self) -> int | None:
        if self._connection is None or self._broken:
            return self.RETRY_NS
        return None if self.session.is_receiving else self._silent_ns

    def _open_sockets(self) -> None:
        with self.lock:
            self._close_sockets()
        made = self._connect()
        with self.lock:
            self._connection = made
            self.session.connected()
        self._watch(made, self._receive)

    def _receive(self) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            self._read(connection)
        except OSError as error:
            with self.lock:
                self.session.failed(error)
                self._close_sockets()

    def _close_sockets(self) -> None:
        connection, self._connection, self._broken = self._connection, None, False
        if connection is not None:
            if self._stopping.is_set():
                self._on_end(connection)
            self._forget(connection)


def _report_failure(error: Exception, sink: Sink) -> None:
    sink.event(EventKind.DRIVER_ERROR, f"the link to the vehicle failed: {error!r}", Severity.ERROR, where="link")
