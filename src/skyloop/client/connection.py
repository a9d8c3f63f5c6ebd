"""Connect to a proxy with a series of supervised sessions, re-established after every loss."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from skyloop.client.channels import Notifier
from skyloop.client.monitoring import Thresholds
from skyloop.client.session import ConnectionHandler, ProxySession
from skyloop.clock import Clock, nanoseconds
from skyloop.errors import ClosedError, LinkError, NoAnswerError, RefusedError, SkyloopError, UsageError
from skyloop.messages import AnyReply, AnyRequest, Hello, LinkState, Refused, Welcome
from skyloop.platform import wait_precisely
from skyloop.transport.base import Dialer

_CHECK_NS: Final = nanoseconds(0.05)  #: how often the link's state is evaluated
_AGAIN_S: Final = 1.0  #: how often a thread that waits for samples retries receiving them itself
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class RedialPolicy:
    """Policy for reconnecting to a lost proxy: retry forever, with increasing pauses."""

    first_s: float = 0.02
    factor: float = 2.0
    cap_s: float = 0.3
    hello_s: float = 1.0  #: time limit for the answer to Hello once the proxy has been reached
    thresholds: Thresholds = field(default_factory=Thresholds)

    def pause_s(self, failures: int) -> float:
        """Return the pause before the next attempt, after ``failures`` failed attempts [s]."""
        return float(min(self.cap_s, self.first_s * self.factor ** min(failures, 30)))


class _EndedError(LinkError):
    """Raised when the proxy ends the connection before sending Welcome."""


class ProxyConnection:
    """Sends an application's packets and requests through the current session with the proxy. Thread-safe.

    It is created before all objects that use it; a :class:`ConnectionSupervisor` creates its sessions.
    """

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        #: Hands a packet to the current session's transport; returns False on failure.
        self.transmit: Callable[[bytes], bool] = _nowhere
        self.state = LinkState.CONNECTING
        self.reason = ""
        self.why_closed = ""  #: why requests can't be made; empty while they can
        self.poked = False  #: whether the supervisor must run immediately
        self.closing = False
        self.woken = Notifier()  #: wakes the supervisor
        self._clock = clock
        self._topics: list[str] = []
        self._lock = threading.Lock()  # guards the topics and the replacement of the session
        self.session: ProxySession | None = None  #: the current session; replaced under the lock
        self._malformed_before = self._missing_before = 0  # totals over earlier sessions

    @property
    def connected(self) -> bool:
        """Whether a proxy is connected and has answered Hello, as far as is known."""
        session = self.session
        return session is not None and session.open

    @property
    def malformed(self) -> int:
        """Number of undecodable packets and frames in all sessions."""
        session = self.session
        return self._malformed_before + (0 if session is None else session.monitor.malformed_count)

    @property
    def missing(self) -> int:
        """Number of feedback samples missing in all sessions, inferred from gaps in their sequence numbers."""
        session = self.session
        return self._missing_before + (0 if session is None else session.monitor.missing)

    @property
    def receiving(self) -> bool:
        """Whether the calling thread is the receiving thread, which must not wait for packets."""
        session = self.session
        return session is not None and session.receiving

    @property
    def adapts_frames(self) -> bool:
        """Whether the proxy adapts frames as requested; within one host, frames arrive unchanged."""
        session = self.session
        return session is not None and session.adapts_frames

    @property
    def offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
        session = self.session
        return 0 if session is None else session.offset_ns

    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]."""
        return self._clock() + self.offset_ns

    @property
    def uncertainty_ns(self) -> int:
        """Maximum error of :attr:`offset_ns` [ns]; 0 if both processes read the same clock."""
        session = self.session
        return 0 if session is None else session.uncertainty_ns

    def check_open(self) -> None:
        """Raise :class:`ClosedError` if the drone was closed, or if it belongs to the parent process."""
        if self.why_closed:
            raise ClosedError(self.why_closed)

    def check_may_wait(self) -> None:
        """Raise :class:`UsageError` if called on the receiving thread."""
        if self.receiving:
            raise UsageError("an inline callback can't wait for packets that it would itself have to receive")

    def poke(self) -> None:
        """Make the supervisor attend to the connection now."""
        self.poked = True
        self.woken.notify()

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:
        """Receive on the calling thread; see :meth:`skyloop.transport.base.TransportClient.lead`."""
        session = self.session
        return session is not None and session.lead(ready, wake, timeout_s)

    def subscribe(self, topic: str, on: bool = True) -> None:
        """Subscribe to or unsubscribe from a topic, in this session and in all later sessions."""
        with self._lock:
            if on == (topic in self._topics):
                return
            if on:
                self._topics.append(topic)
            else:
                self._topics.remove(topic)
            if self.session is not None:
                self.session.subscribe(topic, on)

    def resubscribe(self, topic: str) -> None:
        """Resubscribe to a topic that seems to have stopped delivering samples."""
        with self._lock:
            if topic in self._topics and self.session is not None:
                self.session.subscribe(topic, False)
                self.session.subscribe(topic, True)

    def ask(self, body: AnyRequest, done: Callable[[AnyReply | LinkError], None], timeout_s: float = 2.0) -> None:
        """Send a request without waiting.

        ``done`` is called once, on any thread, with the answer or, after ``timeout_s``, an error. It must be quick.
        """
        session = self.session
        if session is None:
            done(LinkError(f"the link is {self.state.value}: {self.reason}"))
        else:
            session.requests.ask(body, done, timeout_s, self._clock())

    def call(
        self, body: Callable[[], AnyRequest], timeout_s: float = 2.0, *, may_repeat: Callable[[], bool] = lambda: True
    ) -> AnyReply:
        """Send a request and wait for the answer. If the link is lost, wait for it to be restored.

        ``body`` is called for each attempt and returns the request. ``may_repeat``: whether to repeat the request if
        the link breaks after it is sent and before the answer arrives.

        Raises:
            NoAnswerError: If no answer arrives in time.
            ClosedError: If the drone is closed.
            LinkError: If called from an inline callback, or if the link broke and the request may have been executed.
        """
        if self.receiving:
            raise LinkError("an inline callback can't wait for an answer that it would itself have to receive")
        notifier = Notifier()
        answers: list[AnyReply | LinkError] = []

        def done(answer: AnyReply | LinkError) -> None:
            answers.append(answer)
            notifier.notify()

        deadline = time.monotonic() + timeout_s
        while not self.closing:
            left_s, sent = deadline - time.monotonic(), self.session is not None
            self.ask(body(), done, max(left_s, 0.001))
            notifier.wait_for(lambda: bool(answers), left_s + 1.0)  # the supervisor reports the time-out, maybe late
            answer = answers.pop() if answers else NoAnswerError("the link's thread has ended")
            if not isinstance(answer, LinkError):
                return answer
            if isinstance(answer, NoAnswerError) or left_s <= 0.02:
                raise NoAnswerError(f"{answer} (time-out {timeout_s:g} s)") from answer
            if sent and not may_repeat():
                raise LinkError(f"{answer}, after the request was sent: it may have been carried out") from answer
            notifier.wait_for(lambda: self.closing, 0.02)  # the link is down: try again soon
        raise ClosedError("this drone was closed")

    def forked(self) -> None:
        """Stop sending and waiting in a forked process, because the session belongs to the parent process."""
        self.why_closed = (
            f"this drone belongs to process {os.getppid()}, of which this one is a fork: connect again here"
        )
        self.closing = True
        self.session, self.transmit = None, _nowhere
        self.state, self.reason = LinkState.CLOSED, "the connection belongs to the parent process"

    # For the supervisor ----------------------------------------------------------------------------------------

    def attach(self, session: ProxySession) -> None:
        """Send through ``session`` from now on, and subscribe it to all active topics."""
        with self._lock:
            for topic in self._topics:
                session.subscribe(topic, True)
            self.session = session
            self.transmit = session.transmit
        self.poke()

    def detach(self) -> ProxySession | None:
        """Stop sending until a new session is attached; return the previous one."""
        with self._lock:
            session, self.session = self.session, None
            self.transmit = _nowhere
        if session is not None:
            self._malformed_before += session.monitor.malformed_count
            self._missing_before += session.monitor.missing
        return session


class ConnectionSupervisor:
    """Creates sessions with the proxy, evaluates their links, and replaces lost sessions."""

    def __init__(
        self,
        connection: ProxyConnection,
        handler: ConnectionHandler,
        dial: Dialer,
        hello: Hello,
        *,
        policy: RedialPolicy | None = None,
        clock: Clock = time.monotonic_ns,
        begin: Callable[[ConnectionSupervisor], None] | None = None,
    ) -> None:
        """Prepare to connect; :meth:`start` makes the connection.

        ``begin`` schedules calls to :meth:`attend`, starting with the first session; None: a separate thread does.
        """
        self.connection = connection
        self._handler = handler
        self._dial = dial
        self._hello = hello
        self._policy = policy or RedialPolicy()
        self._clock = clock
        self._begin = begin or ConnectionSupervisor.attend_for_ever
        self._failures = 0
        self._thread = threading.Thread(target=self._run, name="skyloop-link", daemon=True)

    def start(self, timeout_s: float = 5.0) -> None:
        """Make the first connection within ``timeout_s``, and stay connected from then on.

        Raises :class:`NoAnswerError` if the proxy does not answer Hello, :class:`RefusedError` if it refuses the
        connection, and any error of the dialer.
        """
        deadline = time.monotonic() + timeout_s
        ended = False
        while True:
            try:
                self._connect()
                break
            except NoAnswerError:  # Hello may have been lost, or the proxy may be slow to start
                if time.monotonic() > deadline:
                    raise
            except _EndedError:  # the proxy has just failed to start; dialing again raises the reason
                if ended:
                    raise
                ended = True
        self._begin(self)

    def close(self) -> None:
        """End the connection and the thread. Idempotent."""
        self.connection.closing = True
        self.connection.poke()
        started, me = self._thread.ident, threading.get_ident()
        if started not in (None, me) and not self.connection.receiving:
            self._thread.join()  # not possible from an inline callback or the thread itself
        self._drop(ClosedError("this drone was closed"), "closed by the application")
        self._set_state(LinkState.CLOSED, "closed by the application")

    def attend_for_ever(self) -> None:
        """Maintain the connection on a separate thread until :meth:`close`."""
        self._thread.start()

    def attend(self) -> float:
        """Do all due work; return the time until the next work [s], unless the connection is poked earlier."""
        self.connection.poked = False
        try:
            return self._step()
        except Exception:  # noqa: BLE001  (the link must come back after any error)
            _log.exception("the connection's thread failed; reconnecting")
            self._drop(LinkError("an error in the link"), "an error in the link")
            return self._policy.cap_s

    # On its thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        wait_precisely()
        while not self.connection.closing:
            pause_s = self.attend()
            self.connection.woken.wait_for(lambda: self.connection.poked, pause_s)

    def _step(self) -> float:
        session = self.connection.session
        if session is None:
            return self._redial()
        now_ns = self._clock()
        if now_ns >= session.check_ns or session.closed_reason is not None or self.connection.state is not LinkState.UP:
            session.check_ns = now_ns + _CHECK_NS
            if not self._judge(session, now_ns):
                return self._policy.pause_s(self._failures)
        due_ns = min(session.check_ns, self._handler.tick(now_ns))
        return max(0.0, (due_ns - self._clock()) / 1e9)

    def _judge(self, session: ProxySession, now_ns: int) -> bool:
        """Update the link's state; return False if the session has been dropped."""
        session.tick(now_ns)
        verdict = session.monitor.verdict(now_ns)
        reason = session.closed_reason or (verdict.reason if verdict.restart else None)
        if reason is not None:
            self._drop(LinkError(f"the link was lost: {reason}"), reason)
            return False
        if verdict.state is LinkState.UP:
            self._failures = 0
        else:
            session.renew_feedback(now_ns)
        if verdict.state is not LinkState.CONNECTING:
            self._set_state(verdict.state, verdict.reason)
        return True

    def _redial(self) -> float:
        try:
            self._connect()
        except (SkyloopError, OSError) as error:
            self.connection.reason = str(error)
            return self._policy.pause_s(self._failures)
        return 0.0

    def _connect(self) -> None:
        """Dial and send Hello. Until feedback arrives, the attempt counts as failed and lengthens the next pause."""
        self._failures += 1
        session = ProxySession(self._handler, self.connection.poke, self._policy.thresholds, self._clock, self._dial)
        try:
            welcome = self._welcome(session)
            self._handler.connected(welcome)
            self.connection.attach(session)
        except BaseException:
            session.close(LinkError("the connection was abandoned"))
            raise

    def _welcome(self, session: ProxySession) -> Welcome:
        answers: list[AnyReply | LinkError] = []

        def done(answer: AnyReply | LinkError) -> None:
            answers.append(answer)
            self.connection.woken.notify()

        sent_ns = self._clock()
        session.requests.ask(self._hello, done, self._policy.hello_s, sent_ns)
        self.connection.woken.wait_for(
            lambda: bool(answers) or session.closed_reason is not None or self.connection.closing, self._policy.hello_s
        )
        answer = answers[0] if answers else None
        if isinstance(answer, Welcome):
            session.welcomed(answer, sent_ns)
            return answer
        if isinstance(answer, Refused):
            raise RefusedError(f"the proxy refused the connection: {answer.message}", code=answer.code.value)
        if session.closed_reason is not None:
            raise _EndedError(f"the proxy ended the connection: {session.closed_reason}")
        raise NoAnswerError(f"the proxy at {session.address} was reached but did not answer: has it been stopped?")

    def _drop(self, error: LinkError, reason: str) -> None:
        session = self.connection.detach()
        if session is None:
            return
        session.close(error)
        self._handler.disconnected()
        if not self.connection.closing:
            self._set_state(LinkState.LOST, reason)

    def _set_state(self, state: LinkState, reason: str) -> None:
        connection = self.connection
        if state is not connection.state:
            connection.state, connection.reason = state, reason
            self._handler.link_changed(state, reason)


def _nowhere(packet: bytes) -> bool:  # noqa: ARG001  (there is no connection to hand it to)
    return False


class ReceivingNotifier(Notifier):
    """A notifier whose waiting thread receives samples itself, which lets a sample wake it directly."""

    __slots__ = ("_connection",)

    def __init__(self, connection: ProxyConnection) -> None:
        super().__init__()
        self._connection = connection

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true, up to 50 ms longer than ``timeout_s``; see :meth:`Notifier.wait_for`."""
        deadline_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not ready():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return ready()
            offered: list[bool] = []
            if not self._connection.lead(ready, partial(self._offer, offered), left_s):
                super().wait_for(partial(_either, ready, offered), min(left_s, _AGAIN_S))
        return True

    def _offer(self, offered: list[bool]) -> None:
        offered.append(True)
        self.notify()


def _either(ready: Callable[[], bool], offered: list[bool]) -> bool:
    return ready() or bool(offered)


class Scheduler:
    """Provides a drone's time. Here it is real time: waits sleep, and an application that is too slow misses samples.

    A replay stepped by its application uses another scheduler, in which waiting advances the time.
    """

    #: Whether callbacks always run on the receiving thread, where each of them receives every sample.
    in_step = False

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        self.clock = clock

    def notifier(self) -> Notifier:
        """Return a notifier for waiting threads of the application."""
        return Notifier()

    def sample_notifier(self, connection: ProxyConnection) -> Notifier:
        """Return a notifier for a thread that waits only for samples from this connection."""
        return ReceivingNotifier(connection)

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        """Start attending to the connection; called with the first session."""
        supervisor.attend_for_ever()

    def opened(self) -> None:
        """Handle the completed connection: the drone's state is known, and a pilot may command it."""
