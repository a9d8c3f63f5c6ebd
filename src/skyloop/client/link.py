"""The link to a proxy: one connection after the other, watched, and made anew whenever it is lost."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from skyloop.client.connection import Connection
from skyloop.client.monitor import Thresholds
from skyloop.client.slots import Bell
from skyloop.clock import Clock, nanoseconds
from skyloop.errors import ClosedError, LinkError, NoAnswerError, RefusedError, SkyloopError
from skyloop.messages import (
    Annotation,
    AnyReply,
    AnyRequest,
    Applied,
    EncodedFrame,
    Event,
    Feedback,
    FrameHeader,
    Hello,
    LinkState,
    LogEntry,
    ProcessorResult,
    ProcessorShare,
    Refused,
    Welcome,
)
from skyloop.transport.base import FEEDBACK, Dialer, Pixels

_LOOK_NS: Final = nanoseconds(0.05)  #: how often the link's state is judged
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class RedialPolicy:
    """How a lost proxy is looked for: for ever, with growing pauses."""

    first_s: float = 0.02
    factor: float = 2.0
    cap_s: float = 0.3
    hello_s: float = 1.0  #: how long a proxy that was reached may take to say welcome
    thresholds: Thresholds = field(default_factory=Thresholds)

    def pause_s(self, failures: int) -> float:
        """Pause before the next attempt after so many that failed."""
        return float(min(self.cap_s, self.first_s * self.factor ** min(failures, 30)))


class _EndedError(LinkError):
    """The proxy ended the connection before it said welcome."""


class LinkUser(Protocol):
    """What a link calls. ``feedback``, ``frame`` … on the receiving thread, the rest on the link's own thread."""

    def connected(self, welcome: Welcome) -> None:
        """A proxy said welcome; nothing else was received from it yet."""

    def disconnected(self, reason: str) -> None:
        """That connection is gone."""

    def link_changed(self, state: LinkState, reason: str) -> None:
        """The state of the hop to the proxy is another one now."""

    def tick(self, now_ns: int) -> int:
        """Called while connected, at the time that it returned last [ns] or earlier."""

    def feedback(self, sample: Feedback, now_ns: int) -> None: ...
    def frame(self, header: FrameHeader, pixels: Pixels, now_ns: int, topic: str = "") -> None: ...
    def event(self, event: Event, now_ns: int) -> None: ...
    def applied(self, applied: Applied, now_ns: int) -> None: ...
    def annotation(self, annotation: Annotation, now_ns: int) -> None: ...
    def log_entry(self, entry: LogEntry, now_ns: int) -> None: ...
    def encoded(self, picture: EncodedFrame, now_ns: int) -> None: ...
    def result(self, result: ProcessorResult, now_ns: int) -> None: ...
    def share(self, share: ProcessorShare, now_ns: int) -> None: ...


class Link:
    """Keeps an application connected. All methods may be called from any thread."""

    def __init__(
        self,
        dial: Dialer,
        hello: Hello,
        user: LinkUser,
        *,
        policy: RedialPolicy | None = None,
        clock: Clock = time.monotonic_ns,
        begin: Callable[[Link], None] | None = None,
    ) -> None:
        """``begin`` sees to it that :meth:`attend` is called from the first connection on; by default a thread does."""
        self._dial = dial
        self._hello = hello
        self._user = user
        self._policy = policy or RedialPolicy()
        self._clock = clock
        self._begin = begin or Link.attend_for_ever
        self._topics: list[str] = []
        self._lock = threading.Lock()  # guards the topics and the change of connection
        self._connection: Connection | None = None
        #: Hands a packet to the transport of the present connection; False if it could not be handed over.
        self.transmit: Callable[[bytes], bool] = _nowhere
        #: Says that a packet follows at once.
        self.knock: Callable[[], None] = _nobody
        self._wake = Bell()
        self.poked = False  #: somebody wants it to be attended to now
        self._closing = False
        self._failures = 0
        self._thread = threading.Thread(target=self._run, name="skyloop-link", daemon=True)
        self.state = LinkState.CONNECTING
        self.reason = ""
        self._malformed_before = 0  # on connections that are gone

    # Life cycle ------------------------------------------------------------------------------------------------

    def start(self, timeout_s: float = 5.0) -> None:
        """Connect for the first time, and keep connected from then on.

        Raises what the dialer raises, :class:`RefusedError`, and :class:`NoAnswerError` if nobody says welcome.
        """
        deadline = time.monotonic() + timeout_s
        ended = False
        while True:
            try:
                self._connect()
                break
            except NoAnswerError:  # the one packet may have been lost, or the proxy is slow to start
                if time.monotonic() > deadline:
                    raise
            except _EndedError:  # it has just failed to start: the dialer knows why
                if ended:
                    raise
                ended = True
        self._begin(self)

    def close(self) -> None:
        """End the connection and the thread. Idempotent."""
        self._closing = True
        self.poke()
        started, me = self._thread.ident, threading.get_ident()
        if started not in (None, me) and not self.receiving:  # else an inline listener or our own thread closes
            self._thread.join()
        self._drop(ClosedError("this drone was closed"), "closed by the application")
        self._set_state(LinkState.CLOSED, "closed by the application")

    # Use -------------------------------------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether a proxy that said welcome is at the other end now, as far as is known."""
        connection = self._connection
        return connection is not None and connection.open

    @property
    def malformed(self) -> int:
        """Packets and frames that could not be understood, on all connections."""
        connection = self._connection
        return self._malformed_before + (0 if connection is None else connection.monitor.malformed_count)

    @property
    def receiving(self) -> bool:
        """Whether the calling thread is the receiving one, which must not wait for what it would itself receive."""
        connection = self._connection
        return connection is not None and connection.receiver == threading.get_ident()

    @property
    def offset_ns(self) -> int:
        """The proxy's clock less ours."""
        connection = self._connection
        return 0 if connection is None else connection.offset_ns

    @property
    def now_ns(self) -> int:
        """The time on the proxy's clock."""
        return self._clock() + self.offset_ns

    @property
    def uncertainty_ns(self) -> int:
        """How wrong :attr:`offset_ns` may be; 0 where both ends read one clock."""
        connection = self._connection
        return 0 if connection is None else connection.uncertainty_ns

    def poke(self) -> None:
        """Let the link's thread look now what there is to do."""
        self.poked = True
        self._wake.ring()

    def subscribe(self, topic: str, on: bool = True) -> None:
        """Want a topic, or no longer, on this connection and on all that follow."""
        with self._lock:
            if on == (topic in self._topics):
                return
            if on:
                self._topics.append(topic)
            else:
                self._topics.remove(topic)
            if self._connection is not None:
                self._connection.subscribe(topic, on)

    def resubscribe(self, topic: str) -> None:
        """Ask for a topic anew that seems to have stopped."""
        with self._lock:
            if topic in self._topics and self._connection is not None:
                self._connection.subscribe(topic, False)
                self._connection.subscribe(topic, True)

    def ask(self, body: AnyRequest, done: Callable[[AnyReply | LinkError], None], timeout_s: float = 2.0) -> None:
        """Ask the proxy; ``done`` is called once, on another thread or this one, and must be quick."""
        connection = self._connection
        if connection is None:
            done(LinkError(f"the link is {self.state.value}: {self.reason}"))
        else:
            connection.requests.ask(body, done, timeout_s, self._clock())

    def call(self, body: Callable[[], AnyRequest], timeout_s: float = 2.0) -> AnyReply:
        """Ask the proxy and wait for the answer; over a lost link, wait for it to come back, within the time.

        ``body`` makes the question, anew for each connection. Raises :class:`NoAnswerError`, :class:`ClosedError`.
        """
        if self.receiving:
            raise LinkError("an inline listener can't wait for an answer, which it would itself have to receive")
        bell = Bell()
        answers: list[AnyReply | LinkError] = []

        def done(answer: AnyReply | LinkError) -> None:
            answers.append(answer)
            bell.ring()

        deadline = time.monotonic() + timeout_s
        while not self._closing:
            left_s = deadline - time.monotonic()
            self.ask(body(), done, max(left_s, 0.001))
            bell.wait_for(lambda: bool(answers), left_s + 1.0)
            answer = answers.pop() if answers else NoAnswerError("the link's thread has ended")
            if not isinstance(answer, LinkError):
                return answer
            if isinstance(answer, NoAnswerError) or left_s <= 0.02:
                raise NoAnswerError(f"{answer} ({timeout_s:g} s were given)") from answer
            bell.wait_for(lambda: self._closing, 0.02)
        raise ClosedError("this drone was closed")

    # The link's thread -----------------------------------------------------------------------------------------

    def attend_for_ever(self) -> None:
        """Attend to it on a thread of its own."""
        self._thread.start()

    def attend(self) -> float:
        """Do what is due now; returns for how many seconds there is nothing to do unless it is poked."""
        self.poked = False
        try:
            return self._step()
        except Exception:  # noqa: BLE001  (whatever goes wrong, the link has to come back)
            _log.exception("the link's thread failed; it connects anew")
            self._drop(LinkError("an error in the link"), "an error in the link")
            return self._policy.cap_s

    def _run(self) -> None:
        while not self._closing:
            pause_s = self.attend()
            self._wake.wait_for(lambda: self.poked, pause_s)

    def _step(self) -> float:
        """Do what is due; returns for how many seconds there is nothing to do."""
        connection = self._connection
        if connection is None:
            return self._redial()
        now_ns = self._clock()
        if now_ns >= connection.look_ns or connection.closed_reason is not None or self.state is not LinkState.UP:
            connection.look_ns = now_ns + _LOOK_NS
            if not self._judge(connection, now_ns):
                return self._policy.pause_s(self._failures)
        due_ns = min(connection.look_ns, self._user.tick(now_ns))
        return max(0.0, (due_ns - self._clock()) / 1e9)

    def _judge(self, connection: Connection, now_ns: int) -> bool:
        """Look how the connection does; False if it was given up."""
        connection.tick(now_ns)
        verdict = connection.monitor.verdict(now_ns)
        reason = connection.closed_reason or (verdict.reason if verdict.restart else None)
        if reason is not None:
            self._drop(LinkError(f"the link was lost: {reason}"), reason)
            return False
        if verdict.state is LinkState.UP:
            self._failures = 0
        elif connection.feedback_stalled(now_ns):
            self.resubscribe(FEEDBACK)
        if verdict.state is not LinkState.CONNECTING:
            self._set_state(verdict.state, verdict.reason)
        return True

    def _redial(self) -> float:
        try:
            self._connect()
        except (SkyloopError, OSError) as error:
            self.reason = str(error)
            return self._policy.pause_s(self._failures)
        return 0.0

    def _connect(self) -> None:
        """Dial and say hello. Counts as a failure until feedback came, so that pauses grow if it never does."""
        self._failures += 1
        connection = Connection(self._user, self.poke, self._policy.thresholds, self._clock)
        connection.dial(self._dial)
        try:
            welcome = self._welcome(connection)
            self._user.connected(welcome)
            with self._lock:
                for topic in self._topics:
                    connection.subscribe(topic, True)
                self._connection = connection
                self.transmit, self.knock = connection.transmit, connection.knock
        except BaseException:
            connection.close(LinkError("the connection was given up"))
            raise
        self.poke()

    def _welcome(self, connection: Connection) -> Welcome:
        answers: list[AnyReply | LinkError] = []

        def done(answer: AnyReply | LinkError) -> None:
            answers.append(answer)
            self._wake.ring()

        sent_ns = self._clock()
        connection.requests.ask(self._hello, done, self._policy.hello_s, sent_ns)
        self._wake.wait_for(
            lambda: bool(answers) or connection.closed_reason is not None or self._closing, self._policy.hello_s
        )
        answer = answers[0] if answers else None
        if isinstance(answer, Welcome):
            connection.welcomed(answer, sent_ns)
            return answer
        if isinstance(answer, Refused):
            raise RefusedError(f"the proxy refused the connection: {answer.message}", code=answer.code.value)
        if connection.closed_reason is not None:
            raise _EndedError(f"the proxy ended the connection: {connection.closed_reason}")
        raise NoAnswerError(f"the proxy at {connection.address} was reached but did not answer: is it stopped?")

    def _drop(self, error: LinkError, reason: str) -> None:
        with self._lock:
            connection, self._connection = self._connection, None
            self.transmit, self.knock = _nowhere, _nobody
        if connection is None:
            return
        self._malformed_before += connection.monitor.malformed_count
        connection.close(error)
        self._user.disconnected(reason)
        if not self._closing:
            self._set_state(LinkState.LOST, reason)

    def _set_state(self, state: LinkState, reason: str) -> None:
        if state is not self.state:
            self.state, self.reason = state, reason
            self._user.link_changed(state, reason)


def _nowhere(packet: bytes) -> bool:  # noqa: ARG001  (there is no connection to hand it to)
    return False


def _nobody() -> None:
    """Whom one knocks at when there is no connection."""
