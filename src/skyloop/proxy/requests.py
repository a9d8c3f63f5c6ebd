"""Handle connections and their requests. Each request is executed only once, but answered each time it is sent.

A client repeats a request, with the same number, until it receives the answer. A repeat of a pending request is merged
with it; a repeat of a request that changed something gets the stored answer. Requests about the proxy's own state
(Hello, authority, Ping) are answered immediately on the receiving thread, so that a take-over never waits behind a slow
parameter. Requests that may involve the driver are answered on a separate thread.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from queue import SimpleQueue
from typing import Any, Final, Protocol

from skyloop.clock import NS_PER_S
from skyloop.errors import ParameterError, UnknownNameError, shortened
from skyloop.messages import (
    AnswerTakeover,
    AnyReply,
    Hello,
    JoinProcessor,
    Refusal,
    Refused,
    ReleaseAuthority,
    Reply,
    Request,
    RequestAuthority,
    Role,
    SetParameter,
    encode,
)
from skyloop.proxy.core.command_checks import Intents
from skyloop.proxy.events import Counters, Episodes
from skyloop.transport.base import Peer, TransportServer

MAX_PENDING: Final = 16  #: maximum number of an application's waiting requests; further requests are refused
#: More malformed packets than this within a second end the connection: its ends evidently use different protocols.
MAX_MALFORMED: Final = 50
#: Time limit for a connection's Hello, which clients send immediately.
HELLO_NS: Final = 5 * NS_PER_S

MAX_KEPT: Final = 32  #: number of answers stored per connection; clients repeat requests for a few seconds at most
MAX_MESSAGE: Final = 1000  #: maximum number of characters in a refusal's message

_AUTHORITY: Final = (RequestAuthority, ReleaseAuthority)
#: Requests that change something. Repeats of other requests may be answered again, with the state at that time.
_CHANGING: Final = (*_AUTHORITY, AnswerTakeover, SetParameter, JoinProcessor)

_log = logging.getLogger(__name__)


class Session:
    """One application's connection, from joining to leaving. ``role`` is None until the application sends Hello."""

    def __init__(self, peer: Peer, joined_ns: int) -> None:
        self.peer = peer
        self.joined_ns = joined_ns
        self.app_id = peer.id
        self.name = f"application {peer.id}"  #: name of the application; preliminary until its Hello
        self.role: Role | None = None
        self.intents = Intents()
        self.episodes = Episodes()
        self.answers = Answers()
        self.authority_request = 0  #: number of the newest request for acquiring or releasing the authority
        self.ended = False  #: whether the proxy has disconnected the application and therefore ignores further packets
        self._malformed_ns: deque[int] = deque(maxlen=MAX_MALFORMED)

    def malformed(self, now_ns: int) -> bool:
        """Count a malformed packet; return whether there were too many within a second."""
        recent = self._malformed_ns
        too_many = len(recent) == MAX_MALFORMED and now_ns - recent[0] < NS_PER_S
        recent.append(now_ns)
        return too_many


class Answers:
    """The pending requests of one connection, and the answers that are stored for repeats. Not thread-safe."""

    def __init__(self) -> None:
        self.kept: dict[int, bytes] = {}  #: stored answers, by the number of the request
        self._pending: set[int] = set()
        self._forgotten = 0  # highest number of a request whose stored answer has been dropped

    def begin(self, number: int, most: float) -> tuple[bool, bool]:
        """Mark a request as pending, unless it is a repeat or ``most`` requests are already pending.

        Returns whether the request has been executed or is being executed, and whether the limit has been reached.
        """
        repeated = number in self._pending or number in self.kept or number <= self._forgotten
        full = not repeated and len(self._pending) >= most
        if not (repeated or full):
            self._pending.add(number)
        return repeated, full

    def end(self, number: int, answer: bytes | None) -> None:
        """Mark a request as answered. ``answer`` is stored for repeats; if it is None, repeats are executed again."""
        self._pending.discard(number)
        if answer is None:
            return
        self.kept[number] = answer
        if len(self.kept) > MAX_KEPT:
            oldest = next(iter(self.kept))
            del self.kept[oldest]
            self._forgotten = max(self._forgotten, oldest)


class JobQueue(Protocol):
    """Runs jobs one after another on a thread that may be shared with other proxies."""

    def start(self) -> None:
        """Start running jobs."""

    def put(self, job: Callable[[], None]) -> None:
        """Queue a job. The job must not raise. Thread-safe."""

    def stop(self, timeout_s: float) -> None:
        """Stop after the current job. If the job takes longer than this, leave it to its daemon thread."""


class JobThread:
    """A :class:`JobQueue` that has its own thread."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="skyloop-requests", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def put(self, job: Callable[[], None]) -> None:
        self._jobs.put(job)

    def stop(self, timeout_s: float) -> None:
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception:  # noqa: BLE001  later requests still get their answers
                _log.exception("a request could not be answered")


#: Answers one type of request, given the connection, the body, and the time of reception [ns].
Answer = Callable[[Session, Any, int], AnyReply]


class RequestDispatcher:
    """Answers requests on the receiving thread or the jobs thread, from :meth:`start` to :meth:`stop`.

    ``immediate`` and ``deferred``: the functions for the two threads, by type of the request's body. Errors raised by
    deferred requests become refusals. ``on_failure`` is called with the request's name and an unexpected error, and
    returns the text for the requester.
    """

    def __init__(
        self,
        server: TransportServer,
        counters: Counters,
        *,
        immediate: Mapping[type, Answer],
        deferred: Mapping[type, Answer],
        on_failure: Callable[[str, BaseException], str],
        jobs: JobQueue | None = None,
    ) -> None:
        self._server = server
        self._counts = counters.counts
        self._immediate = immediate
        self._deferred = deferred
        self._on_failure = on_failure
        self._jobs = jobs or JobThread()
        self._pending_lock = threading.Lock()

    def start(self) -> None:
        self._jobs.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """End after the current job. If a driver hangs for longer, leave it to its daemon thread."""
        self._jobs.stop(timeout_s)

    def call_later(self, job: Callable[[], None]) -> None:
        """Run a job on the requests thread, after the jobs that are already waiting. The job must not raise."""
        self._jobs.put(job)

    def handle(self, session: Session, request: Request, now_ns: int) -> None:
        """Answer immediately, or later on the requests thread. Called on the receiving thread."""
        self._counts["requests.received"] += 1
        kind = type(request.body)
        if session.role is None and kind is not Hello:
            self._reply(session, request, Refused(Refusal.PROTOCOL, "the first request of a connection must be Hello"))
            return
        with self._pending_lock:
            most = MAX_PENDING if kind in self._deferred else math.inf
            repeated, full = session.answers.begin(request.id, most)
            kept = session.answers.kept.get(request.id)
        if repeated:
            self._counts["requests.repeated"] += 1
            if kept is not None:
                self._send(session, kept)
            return
        if full:
            why = f"{MAX_PENDING} requests of this application are already waiting: wait for their answers"
            self._reply(session, request, Refused(Refusal.BUSY, why))
            return
        if isinstance(request.body, _AUTHORITY):
            # A delayed repeat of an old request must not undo a release that came after it.
            if request.id < session.authority_request:
                why = "a later request for the authority, or its release, has replaced it"
                self._finish(session, request, Refused(Refusal.NOT_FRESH, why))
                return
            session.authority_request = request.id
        answer = self._immediate.get(kind)
        if answer is not None:
            self._finish(session, request, answer(session, request.body, now_ns))
        else:
            self._jobs.put(partial(self._answer_later, session, request, now_ns))

    def _answer_later(self, session: Session, request: Request, now_ns: int) -> None:
        kind = type(request.body)
        try:
            reply = self._deferred[kind](session, request.body, now_ns)
        except UnknownNameError as error:
            reply = Refused(Refusal.UNKNOWN_PARAMETER, str(error))
        except ParameterError as error:
            reply = Refused(_refusal(error.code), shortened(str(error), MAX_MESSAGE))
        except Exception as error:  # noqa: BLE001  whatever a driver's code does, the requester gets an answer
            reply = Refused(Refusal.DRIVER_FAILED, shortened(self._on_failure(kind.__name__, error), MAX_MESSAGE))
        self._finish(session, request, reply)

    def _finish(self, session: Session, request: Request, body: AnyReply) -> None:
        """Send an answer. Store it for repeats if the request changed something."""
        packet = self._reply(session, request, body)
        with self._pending_lock:
            session.answers.end(request.id, packet if isinstance(request.body, _CHANGING) else None)

    def _reply(self, session: Session, request: Request, body: AnyReply) -> bytes:
        if isinstance(body, Refused):
            self._counts["requests.refused"] += 1
        try:
            packet = encode(Reply(request.id, body))
        except (ValueError, TypeError, OverflowError) as error:  # a driver's parameter may hold anything
            _log.error("an answer cannot be sent: %s", error)
            packet = encode(Reply(request.id, Refused(Refusal.DRIVER_FAILED, "the answer cannot be sent")))
        self._send(session, packet)
        return packet

    def _send(self, session: Session, packet: bytes) -> None:
        if not self._server.send(session.peer, packet):
            self._counts["replies.missed"] += 1


def _refusal(code: str) -> Refusal:
    try:
        return Refusal(code)
    except ValueError:
        return Refusal.DRIVER_FAILED  # a driver refused for a reason of its own, with an unknown code
