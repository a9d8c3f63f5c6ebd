"""Requests: each is carried out once and answered as often as it is asked.

A client repeats a request until its answer arrives, with the same number. A repeat of one that is being answered joins
it; a repeat of one that changed something gets the kept answer. What concerns only the proxy's own state (Hello,
authority, Ping) is answered at once on the receiving thread, so that a take-over never waits behind a slow parameter.
What may ask the driver is answered on a thread of its own.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from queue import SimpleQueue
from typing import Any, Final, Protocol

from skyloop.clock import NS_PER_S, Clock, seconds
from skyloop.errors import ParameterError, UnknownNameError, shortened
from skyloop.messages import (
    AnswerTakeover,
    AnyReply,
    EventKind,
    GetParameter,
    Hello,
    JoinProcessor,
    ListParameters,
    ParameterValue,
    Refusal,
    Refused,
    ReleaseAuthority,
    Reply,
    Request,
    RequestAuthority,
    Role,
    SetParameter,
    Severity,
    Value,
    encode,
)
from skyloop.proxy.events import Counters, EventPublisher
from skyloop.proxy.handler import CommandHandler
from skyloop.proxy.parameters import Parameters
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.sessions import Session
from skyloop.transport.base import TransportServer

MAX_PENDING: Final = 16  #: requests of one application that wait for their thread; further ones are refused
MAX_MESSAGE: Final = 1000  #: characters of a refusal
#: A momentary parameter, such as a flip, is written within this time or never: its writer waits no longer.
MOMENT_NS: Final = 2 * NS_PER_S

_AUTHORITY: Final = (RequestAuthority, ReleaseAuthority)
#: Requests that change something. The others may be answered again, with what is true then.
_CHANGING: Final = (*_AUTHORITY, AnswerTakeover, SetParameter, JoinProcessor)

#: Answers one type of request: of this connection, with this body, received at this time [ns].
Answer = Callable[[Session, Any, int], AnyReply]

_log = logging.getLogger(__name__)


class JobQueue(Protocol):
    """Does jobs one after the other, on a thread that may be shared with other proxies."""

    def start(self) -> None:
        """Begin to do what is put."""

    def put(self, job: Callable[[], None]) -> None:
        """Do this after what waits already. ``job`` must not raise. Any thread."""

    def stop(self, timeout_s: float) -> None:
        """End after the job in progress; one that hangs longer is left to its daemon thread."""


class JobThread:
    """A :class:`JobQueue` with a thread of its own."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="skyloop-requests", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, job: Callable[[], None]) -> None:
        """Do this after what waits already."""
        self._jobs.put(job)

    def stop(self, timeout_s: float) -> None:
        """End after the job in progress."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception:  # noqa: BLE001  the next ones still get their answers
                _log.exception("a request could not be answered")


class RequestDispatcher:
    """Answers requests, on the receiving thread or on that of its jobs, from :meth:`start` to :meth:`stop`.

    Args:
        server: where answers are sent.
        counters: the proxy's counters.
        immediate: what answers on the receiving thread, by the type of the request's body.
        deferred: what answers on the thread of requests; may raise anything, which becomes a refusal.
        on_failure: called with the request's name and the error when ``deferred`` raises what is no refusal; returns
            the text for who asked.
        jobs: does what may wait for the driver; None: a thread of its own.
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
        """Begin to answer what may wait."""
        self._jobs.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """End after the job in progress; a driver that hangs longer is left to its daemon thread."""
        self._jobs.stop(timeout_s)

    def call_later(self, job: Callable[[], None]) -> None:
        """Call this on the thread of requests, after what waits there. ``job`` must not raise."""
        self._jobs.put(job)

    def handle(self, session: Session, request: Request, now_ns: int) -> None:
        """Answer now, or on the thread of requests. On the receiving thread."""
        self._counts["requests.received"] += 1
        kind = type(request.body)
        if session.role is None and kind is not Hello:
            self._reply(session, request, Refused(Refusal.PROTOCOL, "the first request on a connection is Hello"))
            return
        with self._pending_lock:
            repeated = session.answers.repeats(request.id)
            kept = session.answers.kept(request.id)
            full = not repeated and kind in self._deferred and session.answers.pending >= MAX_PENDING
            if not (repeated or full):
                session.answers.begin(request.id)
        if repeated:
            self._counts["requests.repeated"] += 1
            if kept is not None:
                self._send(session, kept)
            return
        if full:
            why = f"{MAX_PENDING} requests of this application wait already: wait for their answers"
            self._reply(session, request, Refused(Refusal.BUSY, why))
            return
        if isinstance(request.body, _AUTHORITY):
            # A request that was lost on the way and repeated must not undo the release that followed it.
            if request.id < session.authority_request:
                why = "a later request for the authority, or its release, has taken its place"
                self._finish(session, request, Refused(Refusal.NOT_FRESH, why))
                return
            session.authority_request = request.id
        answer = self._immediate.get(kind)
        if answer is not None:
            self._finish(session, request, answer(session, request.body, now_ns))
        else:
            self._jobs.put(lambda: self._answer_later(session, request, now_ns))

    def _answer_later(self, session: Session, request: Request, now_ns: int) -> None:
        kind = type(request.body)
        try:
            reply = self._deferred[kind](session, request.body, now_ns)
        except UnknownNameError as error:
            reply = Refused(Refusal.UNKNOWN_PARAMETER, str(error))
        except ParameterError as error:
            reply = Refused(_refusal(error.code), shortened(str(error), MAX_MESSAGE))
        except Exception as error:  # noqa: BLE001  whatever a driver's code does, the asker gets an answer
            reply = Refused(Refusal.DRIVER_FAILED, shortened(self._on_failure(kind.__name__, error), MAX_MESSAGE))
        self._finish(session, request, reply)

    def _finish(self, session: Session, request: Request, body: AnyReply) -> None:
        """Send an answer, and keep it for repeats if the request changed something."""
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
        return Refusal.DRIVER_FAILED  # a driver's own refusal, with a code that is not ours


class ParameterRequests:
    """Answers what applications ask about parameters, and lets their values take effect. May wait for the vehicle.

    Args:
        parameters: The store.
        handler: Knows who holds the authority, and gets new settings.
        publisher: Reports a driver that fails.
        events: Where changes are published.
        clock: The proxy's clock [ns].
        free: Parameters that any pilot may write without the authority. They change by themselves: each is read anew,
            and a change is no event.
    """

    def __init__(
        self,
        parameters: Parameters,
        handler: CommandHandler,
        publisher: VehiclePublisher,
        events: EventPublisher,
        clock: Clock,
        free: frozenset[str] = frozenset(),
    ) -> None:
        self._free = free
        self._parameters = parameters
        self._handler = handler
        self._publisher = publisher
        self._events = events
        self._clock = clock

    def read_driver(self) -> None:
        """Read the driver's parameters; a driver that raises keeps those it had."""
        try:
            self._parameters.refresh()
        except Exception as error:  # noqa: BLE001  it is reported, and the flight goes on
            self._publisher.driver_failed("parameters", error)
        if self._parameters.left_out:
            names = ", ".join(self._parameters.left_out)[:200]
            text = f"parameters too large to be sent: {names}"
            self._publisher.event(EventKind.DRIVER_ERROR, text, Severity.WARNING)
        for name, why in self._parameters.write_presets():
            if self._publisher.link_up:  # before, it has nobody to write to: it is tried again when the link is there
                text = f"{name} could not be set as this proxy was asked to: {why}"
                self._publisher.event(EventKind.DRIVER_ERROR, text, Severity.WARNING, where="preset")
        self._handler.configure(self._parameters.flight_settings())

    def get(self, _session: Session, request: GetParameter, _now_ns: int) -> AnyReply:
        """Answer with one parameter as last known. Raises :class:`UnknownNameError`."""
        if request.name in self._free:
            self.read_driver()
        return ParameterValue(self._parameters.get(request.name))

    def page(self, _session: Session, request: ListParameters, _now_ns: int) -> AnyReply:
        """Read the driver's parameters again and answer with a page of all."""
        self.read_driver()
        return self._parameters.page(request.first)

    def set(self, session: Session, request: SetParameter, now_ns: int) -> AnyReply:
        """Write one for the holder of the authority. Raises what :meth:`Parameters.set` raises."""
        waited_ns, momentary = self._clock() - now_ns, self._parameters.get(request.name).momentary
        if momentary and waited_ns > MOMENT_NS:
            why = f"{request.name} waited {seconds(waited_ns):.1f} s for the vehicle and is not done so late: ask again"
            return Refused(Refusal.STALE, why)
        if request.name in self._free and session.role is Role.PILOT:
            return ParameterValue(self._parameters.set(request.name, request.value))
        if not self._handler.holds(session, request.lease):
            code = Refusal.FOREIGN_LEASE if request.lease else Refusal.NO_AUTHORITY
            return Refused(code, "writing a parameter needs the authority: request it, and name its lease")
        if momentary and (problem := self._handler.problem_with_moment()):
            return Refused(Refusal.WRONG_STATE, f"{request.name} is not done now: {problem}")
        if request.name == "limits.altitude" and isinstance(request.value, int | float):
            problem = self._handler.problem_with_ceiling(float(request.value))
            if problem:
                return Refused(Refusal.OUT_OF_RANGE, f"{request.name} can't be {request.value:g} m now: {problem}")
        parameter = self._parameters.set(request.name, request.value)
        self._handler.configure(self._parameters.flight_settings())
        unit = f" {parameter.unit}" if parameter.unit else ""
        text = f"{session.name} set {parameter.name} to {parameter.value!r}{unit}"
        data: dict[str, Value] = {"name": parameter.name, "value": parameter.value, "app_id": session.app_id}
        self._events.publish(EventKind.PARAMETER_CHANGED, text, app=session.name, data=data)
        return ParameterValue(parameter)
