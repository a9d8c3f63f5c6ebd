"""Requests: each gets exactly one answer.

What only looks at the proxy's own state (Hello, authority, Ping) is answered at once on the receiving thread, so that
a take-over never waits behind somebody's slow parameter. What may ask the driver goes to the worker's thread.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final

import msgspec

from skyloop.clock import Clock
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import (
    AnswerTakeover,
    AnyReply,
    EventKind,
    GetParameter,
    GetStatistics,
    Hello,
    JoinProcessor,
    LinkState,
    ListParameters,
    Parameter,
    ParameterValue,
    Ping,
    Pong,
    Refusal,
    Refused,
    ReleaseAuthority,
    Reply,
    Request,
    RequestAuthority,
    SetParameter,
    Severity,
    Statistics,
    Value,
    Welcome,
    encode,
)
from skyloop.proxy.events import EventLog
from skyloop.proxy.parameters import Parameters
from skyloop.proxy.processors import Processors
from skyloop.proxy.sessions import Session
from skyloop.proxy.statistics import Counters
from skyloop.proxy.vehicle import Vehicle
from skyloop.proxy.watch import Watch
from skyloop.transport.base import ServerEnd

MAX_PENDING: Final = 16  #: requests of one application that wait for the worker; further ones are refused
MAX_MESSAGE: Final = 1000  #: characters of a refusal

_log = logging.getLogger(__name__)


class Requests:
    """Answers requests. :meth:`start` and :meth:`stop` are for its worker."""

    def __init__(
        self,
        server: ServerEnd,
        watch: Watch,
        parameters: Parameters,
        vehicle: Vehicle,
        events: EventLog,
        counters: Counters,
        clock: Clock,
        welcome: Welcome,
        configure: Callable[[], None],
        applications: Callable[[], int],
        processors: Processors,
    ) -> None:
        self._server = server
        self._watch = watch
        self._parameters = parameters
        self._vehicle = vehicle
        self._events = events
        self._counters = counters
        self._clock = clock
        self._welcome = welcome
        self._configure = configure
        self._applications = applications
        self._processors = processors
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._pending_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="skyloop-requests", daemon=True)

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """End after what is being done now; a driver that hangs longer is left to its daemon thread."""
        self._work.put(None)
        self._thread.join(timeout_s)

    def take(self, session: Session, request: Request, now_ns: int) -> None:
        """Answer now, or give it to the worker. On the receiving thread."""
        self._counters.counts["requests.received"] += 1
        reply = self._answer_now(session, request, now_ns)
        if reply is not None:
            self._reply(session, request, reply)
            return
        with self._pending_lock:
            full = session.pending >= MAX_PENDING
            if not full:
                session.pending += 1
        if full:
            why = f"{MAX_PENDING} requests of this application wait already: wait for their answers"
            self._reply(session, request, Refused(Refusal.BUSY, why))
            return
        self._work.put(lambda: self._answer_later(session, request))

    def refresh_parameters(self) -> None:
        """Let the worker read the driver's parameters anew, as when its vehicle has come."""
        self._work.put(self.read_driver)

    def read_driver(self) -> None:
        """Read the driver's parameters; a driver that raises keeps those it had."""
        try:
            self._parameters.refresh()
        except Exception as error:  # noqa: BLE001  it is told, and the flight goes on
            self._vehicle.driver_failed("parameters", error)
        if self._parameters.left_out:
            names = ", ".join(self._parameters.left_out)[:200]
            self._vehicle.event(EventKind.DRIVER_ERROR, f"parameters too large to be sent: {names}", Severity.WARNING)
        self._configure()

    # On the receiving thread -----------------------------------------------------------------------------------

    def _answer_now(self, session: Session, request: Request, now_ns: int) -> AnyReply | None:
        body = request.body
        if isinstance(body, Hello):
            return self._greet(session, body, now_ns)
        if session.role is None:
            return Refused(Refusal.PROTOCOL, "the first request on a connection is Hello")
        if isinstance(body, Ping):
            return Pong(body.sent_ns, self._clock())
        if isinstance(body, RequestAuthority):
            return self._watch.request_authority(session, body, now_ns)
        if isinstance(body, AnswerTakeover):
            return self._watch.answer_takeover(session, body, now_ns)
        if isinstance(body, ReleaseAuthority):
            return self._watch.release_authority(session, now_ns)
        if isinstance(body, JoinProcessor):
            return self._processors.join(session, body, now_ns)
        return None

    def _greet(self, session: Session, hello: Hello, now_ns: int) -> AnyReply:
        if session.role is not None:
            return Refused(Refusal.PROTOCOL, "Hello came before on this connection")
        session.name, session.role = hello.name, hello.role
        text = f"{hello.name} connected as {hello.role.value} from {session.peer.address}"
        data: dict[str, Value] = {"state": LinkState.UP.value, "reason": "", "app_id": session.app_id}
        self._events.tell(EventKind.APPLICATION_LINK, text, app=hello.name, data=data)
        return msgspec.structs.replace(self._welcome, app_id=session.app_id, now_ns=now_ns)

    # On the worker's thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (job := self._work.get()) is not None:
            job()

    def _answer_later(self, session: Session, request: Request) -> None:
        try:
            reply = self._answer(session, request)
        except UnknownNameError as error:
            reply = Refused(Refusal.UNKNOWN_PARAMETER, str(error))
        except ParameterError as error:
            reply = Refused(_refusal(error.code), str(error)[:MAX_MESSAGE])
        except Exception as error:  # noqa: BLE001  whatever a driver's code does, the asker gets an answer
            self._vehicle.driver_failed(type(request.body).__name__, error)
            reply = Refused(Refusal.DRIVER_FAILED, f"the driver failed: {error!r}"[:MAX_MESSAGE])
        with self._pending_lock:
            session.pending -= 1
        self._reply(session, request, reply)

    def _answer(self, session: Session, request: Request) -> AnyReply:
        body = request.body
        if isinstance(body, SetParameter):
            return self._set(session, body)
        if isinstance(body, GetParameter):
            return ParameterValue(self._parameters.get(body.name))
        if isinstance(body, ListParameters):
            self.read_driver()
            return self._parameters.page(body.first)
        assert isinstance(body, GetStatistics)
        return Statistics(self._counters.snapshot(applications=self._applications()))

    def _set(self, session: Session, body: SetParameter) -> AnyReply:
        if not self._watch.holds(session, body.lease):
            code = Refusal.FOREIGN_LEASE if body.lease else Refusal.NO_AUTHORITY
            return Refused(code, "writing a parameter needs the authority: request it, and name its lease")
        parameter = self._parameters.set(body.name, body.value)
        self._configure()
        self._tell_changed(session, parameter)
        return ParameterValue(parameter)

    def _tell_changed(self, session: Session, parameter: Parameter) -> None:
        unit = f" {parameter.unit}" if parameter.unit else ""
        text = f"{session.name} set {parameter.name} to {parameter.value!r}{unit}"
        data = {"name": parameter.name, "value": parameter.value}
        self._events.tell(EventKind.PARAMETER_CHANGED, text, app=session.name, data=data)

    # Either ----------------------------------------------------------------------------------------------------

    def _reply(self, session: Session, request: Request, body: AnyReply) -> None:
        if isinstance(body, Refused):
            self._counters.counts["requests.refused"] += 1
        try:
            packet = encode(Reply(request.id, body))
        except (ValueError, TypeError, OverflowError) as error:  # a driver's parameter may hold anything
            _log.error("an answer cannot be sent: %s", error)
            packet = encode(Reply(request.id, Refused(Refusal.DRIVER_FAILED, "the answer cannot be sent")))
        if not self._server.send(session.peer, packet):
            self._counters.counts["replies.missed"] += 1


def _refusal(code: str) -> Refusal:
    try:
        return Refusal(code)
    except ValueError:
        return Refusal.DRIVER_FAILED  # a driver's own refusal, with a code that is not ours
