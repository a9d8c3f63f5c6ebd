"""The connection to a proxy: one session after the other, supervised, and made again whenever it is lost."""

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
from skyloop.messages import (
    AnyReply,
    AnyRequest,
    Hello,
    LinkState,
    Refused,
    Welcome,
)
from skyloop.transport.base import Dialer

_LOOK_NS: Final = nanoseconds(0.05)  #: how often the link's state is judged
_AGAIN_S: Final = 1.0  #: how often a thread that waits for samples tries again to receive them itself
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class RedialPolicy:
    """How a lost proxy is reconnected to: for as long as it takes, with growing pauses [s]."""

    first_s: float = 0.02
    factor: float = 2.0
    cap_s: float = 0.3
    hello_s: float = 1.0  #: time for a reached proxy to answer Hello
    thresholds: Thresholds = field(default_factory=Thresholds)

    def pause_s(self, failures: int) -> float:
        """Return the pause before the next attempt after ``failures`` failed ones [s]."""
        return float(min(self.cap_s, self.first_s * self.factor ** min(failures, 30)))


class _EndedError(LinkError):
    """The proxy ended the connection before it sent Welcome."""


class ProxyConnection:
    """What an application sends and asks through, whichever session with the proxy there is. Any thread.

    It is made before everything that uses it; a :class:`ConnectionSupervisor` makes the sessions.
    """

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        #: Hands a packet to the transport of the present session; False if it could not be handed over.
        self.transmit: Callable[[bytes], bool] = _nowhere
        self.state = LinkState.CONNECTING
        self.reason = ""
        self.why_closed = ""  #: why nothing can be asked for any more; empty while something can
        self.poked = False  #: the supervisor is to attend to it now
        self.closing = False
        self.woken = Notifier()  #: wakes the supervisor
        self._clock = clock
        self._topics: list[str] = []
        self._lock = threading.Lock()  # guards the topics and the change of session
        self._session: ProxySession | None = None
        self._malformed_before = self._missing_before = 0  # in earlier sessions

    @property
    def connected(self) -> bool:
        """Whether, as far as is known, a proxy that has answered Hello is at the other end now."""
        session = self._session
        return session is not None and session.open

    @property
    def malformed(self) -> int:
        """Packets and frames that could not be decoded, in all sessions."""
        session = self._session
        return self._malformed_before + (0 if session is None else session.monitor.malformed_count)

    @property
    def missing(self) -> int:
        """Samples of feedback that are missing by the gaps in their numbers, in all sessions."""
        session = self._session
        return self._missing_before + (0 if session is None else session.monitor.missing)

    @property
    def receiving(self) -> bool:
        """Whether the calling thread is the receiving one, which must not wait for what it would itself receive."""
        session = self._session
        return session is not None and session.receiving

    @property
    def variants(self) -> bool:
        """Whether frames come in the form that was asked for; on one host they come as they are."""
        session = self._session
        return session is not None and session.variants

    @property
    def offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
        session = self._session
        return 0 if session is None else session.offset_ns

    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]."""
        return self._clock() + self.offset_ns

    @property
    def uncertainty_ns(self) -> int:
        """Largest error of :attr:`offset_ns` [ns]; 0 where both ends read one clock."""
        session = self._session
        return 0 if session is None else session.uncertainty_ns

    def check_open(self) -> None:
        """Raise :class:`ClosedError` once the drone was closed, or belongs to the parent process."""
        if self.why_closed:
            raise ClosedError(self.why_closed)

    def check_may_wait(self) -> None:
        """Raise :class:`UsageError` on the receiving thread."""
        if self.receiving:
            raise UsageError("an inline listener can't wait for what it would itself have to receive")

    def poke(self) -> None:
        """Wake the supervisor, so that it attends to the connection now."""
        self.poked = True
        self.woken.notify()

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:
        """Receive on the calling thread; see :meth:`skyloop.transport.base.TransportClient.lead`."""
        session = self._session
        return session is not None and session.lead(ready, wake, timeout_s)

    def subscribe(self, topic: str, on: bool = True) -> None:
        """Subscribe to a topic or unsubscribe, in this session and all that follow."""
        with self._lock:
            if on == (topic in self._topics):
                return
            if on:
                self._topics.append(topic)
            else:
                self._topics.remove(topic)
            if self._session is not None:
                self._session.subscribe(topic, on)

    def resubscribe(self, topic: str) -> None:
        """Subscribe again to a topic that seems to have stopped."""
        with self._lock:
            if topic in self._topics and self._session is not None:
                self._session.subscribe(topic, False)
                self._session.subscribe(topic, True)

    def ask(self, body: AnyRequest, done: Callable[[AnyReply | LinkError], None], timeout_s: float = 2.0) -> None:
        """Send a request without waiting.

        ``done`` is called once with the answer, or an error after ``timeout_s``, on any thread; it must be quick.
        """
        session = self._session
        if session is None:
            done(LinkError(f"the link is {self.state.value}: {self.reason}"))
        else:
            session.requests.ask(body, done, timeout_s, self._clock())

    def call(
        self,
        body: Callable[[], AnyRequest],
        timeout_s: float = 2.0,
        *,
        may_repeat: Callable[[], bool] = lambda: True,
    ) -> AnyReply:
        """Send a request and wait for the answer. While the link is lost, wait for it to come back.

        Args:
            body: Makes the request, for each attempt again.
            timeout_s: For all of it [s].
            may_repeat: Whether to ask once more, when the link broke before the answer to a request that was sent.

        Raises:
            NoAnswerError: If there is no answer in time.
            ClosedError: If the drone is closed.
            LinkError: If called from an inline callback, or what was asked may have been done and must not be repeated.
        """
        if self.receiving:
            raise LinkError("an inline listener can't wait for an answer, which it would itself have to receive")
        notifier = Notifier()
        answers: list[AnyReply | LinkError] = []

        def done(answer: AnyReply | LinkError) -> None:
            answers.append(answer)
            notifier.notify()

        deadline = time.monotonic() + timeout_s
        while not self.closing:
            left_s, sent = deadline - time.monotonic(), self._session is not None
            self.ask(body(), done, max(left_s, 0.001))
            notifier.wait_for(lambda: bool(answers), left_s + 1.0)
            answer = answers.pop() if answers else NoAnswerError("the link's thread has ended")
            if not isinstance(answer, LinkError):
                return answer
            if isinstance(answer, NoAnswerError) or left_s <= 0.02:
                raise NoAnswerError(f"{answer} ({timeout_s:g} s were given)") from answer
            if sent and not may_repeat():
                raise LinkError(f"{answer}, after the request was sent: it may have been carried out") from answer
            notifier.wait_for(lambda: self.closing, 0.02)
        raise ClosedError("this drone was closed")

    def forked(self) -> None:
        """Send nothing, wait for nothing: the session belongs to the parent process."""
        self.why_closed = (
            f"this drone belongs to process {os.getppid()}, of which this one is a fork: connect here as well"
        )
        self.closing = True
        self._session, self.transmit = None, _nowhere
        self.state, self.reason = LinkState.CLOSED, "the connection belongs to the parent process"

    # For the supervisor ----------------------------------------------------------------------------------------

    @property
    def session(self) -> ProxySession | None:
        """The present session; None while there is none."""
        return self._session

    def attach(self, session: ProxySession) -> None:
        """Send through ``session`` from now on, and subscribe in it to all topics that are wanted."""
        with self._lock:
            for topic in self._topics:
                session.subscribe(topic, True)
            self._session = session
            self.transmit = session.transmit
        self.poke()

    def detach(self) -> ProxySession | None:
        """Send nowhere until there is another session; return the previous one."""
        with self._lock:
            session, self._session = self._session, None
            self.transmit = _nowhere
        if session is not None:
            self._malformed_before += session.monitor.malformed_count
            self._missing_before += session.monitor.missing
        return session


class ConnectionSupervisor:
    """Makes one session with the proxy after the other, judges each, and drops those that are lost."""

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
        """Prepare to connect; :meth:`start` does it.

        ``begin`` sees to it that :meth:`attend` is called from the first session on; None: a thread does.
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
        """Connect for the first time, within ``timeout_s``, and keep connected from then on.

        Raises:
            NoAnswerError: If the proxy does not answer Hello.
            RefusedError: If the proxy refuses the connection.
            SkyloopError: Whatever else the dialer raises.
        """
        deadline = time.monotonic() + timeout_s
        ended = False
        while True:
            try:
                self._connect()
                break
            except NoAnswerError:  # Hello may have been lost, or the proxy starts slowly
                if time.monotonic() > deadline:
                    raise
            except _EndedError:  # the proxy has just failed to start: dialing again raises why
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
            self._thread.join()  # not from an inline callback or the thread itself
        self._drop(ClosedError("this drone was closed"), "closed by the application")
        self._set_state(LinkState.CLOSED, "closed by the application")

    def attend_for_ever(self) -> None:
        """Attend to the connection on a thread of its own until :meth:`close`."""
        self._thread.start()

    def attend(self) -> float:
        """Do what is due now; return for how long there is nothing to do [s], unless the connection is poked."""
        self.connection.poked = False
        try:
            return self._step()
        except Exception:  # noqa: BLE001  (whatever goes wrong, the link has to come back)
            _log.exception("the connection's thread failed; reconnecting")
            self._drop(LinkError("an error in the link"), "an error in the link")
            return self._policy.cap_s

    # On its thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self.connection.closing:
            pause_s = self.attend()
            self.connection.woken.wait_for(lambda: self.connection.poked, pause_s)

    def _step(self) -> float:
        """Do what is due; return for how long there is nothing to do [s]."""
        session = self.connection.session
        if session is None:
            return self._redial()
        now_ns = self._clock()
        if now_ns >= session.look_ns or session.closed_reason is not None or self.connection.state is not LinkState.UP:
            session.look_ns = now_ns + _LOOK_NS
            if not self._judge(session, now_ns):
                return self._policy.pause_s(self._failures)
        due_ns = min(session.look_ns, self._handler.tick(now_ns))
        return max(0.0, (due_ns - self._clock()) / 1e9)

    def _judge(self, session: ProxySession, now_ns: int) -> bool:
        """Update the state of the link; return False if the session was dropped."""
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
        """Dial and say Hello. Counts as a failure until feedback comes, so that pauses grow if it never does."""
        self._failures += 1
        session = ProxySession(self._handler, self.connection.poke, self._policy.thresholds, self._clock)
        session.dial(self._dial)
        try:
            welcome = self._welcome(session)
            self._handler.connected(welcome)
            self.connection.attach(session)
        except BaseException:
            session.close(LinkError("the connection was given up"))
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
        raise NoAnswerError(f"the proxy at {session.address} was reached but did not answer: is it stopped?")

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
    """A notifier for a thread that waits for samples: it receives meanwhile, so that a sample wakes it directly."""

    __slots__ = ("_connection",)

    def __init__(self, connection: ProxyConnection) -> None:
        super().__init__()
        self._connection = connection

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true; see :meth:`Notifier.wait_for`. May take 50 ms longer than ``timeout_s``."""
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
    """Where the time of a drone comes from, here real time: waiting is sleeping, and a slow application misses samples.

    A replay that is stepped by its application has another one, in which waiting advances the time.
    """

    #: Whether callbacks are always called on the receiving thread, so that each gets all samples.
    in_step = False

    def __init__(self, clock: Clock = time.monotonic_ns) -> None:
        self.clock = clock

    def notifier(self) -> Notifier:
        """Return a notifier for an application to wait for."""
        return Notifier()

    def sample_notifier(self, connection: ProxyConnection) -> Notifier:
        """Return a notifier for a thread that waits for nothing but samples of this connection."""
        return ReceivingNotifier(connection)

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        """Attend to the connection from now on; called with the first session."""
        supervisor.attend_for_ever()

    def opened(self) -> None:
        """Called when the drone is connected, its state is known, and it may be commanded if that was asked for."""
