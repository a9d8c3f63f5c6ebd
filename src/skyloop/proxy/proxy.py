"""The proxy, a node that lets any number of applications observe a vehicle and one at a time fly it.

Threads: the transport's threads execute commands and pass on poses. The driver's threads publish. A ticker (50 Hz)
updates authority, failsafe and autopilot, and one more thread answers requests. The handler's lock is held during every
driver call that flies the vehicle, including those in :meth:`Proxy.end`.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Final

import msgspec

from skyloop.child_process import leave_to_parent
from skyloop.clock import Clock, clock_identity, monotonic_ns, nanoseconds, seconds, slept_ns
from skyloop.drivers.base import Driver
from skyloop.errors import DecodeError, DriverError, UsageError
from skyloop.messages import (
    Annotation,
    AnswerTakeover,
    AnyReply,
    Command,
    EventKind,
    GetParameter,
    GetStatistics,
    Hello,
    JoinProcessor,
    LinkState,
    ListParameters,
    LogEntry,
    Ping,
    Pong,
    ProcessorResult,
    Refusal,
    Refused,
    ReleaseAuthority,
    Request,
    RequestAuthority,
    Role,
    SetParameter,
    Severity,
    Statistics,
    StreamReport,
    Value,
    VehiclePose,
    Welcome,
    decode,
)
from skyloop.proxy.core.autopilot import PERIOD_S, SoftwareAutopilot, software_actions
from skyloop.proxy.core.flight import Flight
from skyloop.proxy.events import Counters, EventDraft, EventPublisher
from skyloop.proxy.executor import ActionExecutor
from skyloop.proxy.handler import CommandHandler
from skyloop.proxy.parameters import ParameterRequests, Parameters, described
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.records import AuditTrail, FlightRecord
from skyloop.proxy.relay import ProcessorWorkers, Relay
from skyloop.proxy.requests import HELLO_NS, MAX_MALFORMED, JobQueue, RequestDispatcher, Session
from skyloop.proxy.topics import OverviewPublisher
from skyloop.transport.base import Peer, TransportServer

MAX_NAME: Final = 64  #: maximum number of characters in a proxy's name

_POLL_S: Final = 0.2  # interval at which ``hurry`` is polled during a landing
_ABANDON_S: Final = 1.0  #: time to wait for the proxy's other parts to end if the driver hangs
_log = logging.getLogger(__name__)


class Proxy:
    """Owns a driver and its transport server, both not open yet, from :meth:`start` to :meth:`end`. A context manager.

    Applications connect by ``name``, which must have 1 to 64 characters. ``clock`` gives the time of all samples [ns].
    With ``ticker=False``, the caller must call :meth:`tick`, for example for many proxies in one process or in
    simulated time. ``jobs`` answers requests that may wait for the vehicle, by default on a separate thread. ``slept``
    returns how long the computer has slept in total [ns]; its default is the system's if ``clock`` is the system's.
    """

    def __init__(
        self,
        driver: Driver,
        server_end: TransportServer,
        *,
        name: str,
        clock: Clock = monotonic_ns,
        ticker: bool = True,
        jobs: JobQueue | None = None,
        slept: Clock | None = None,
    ) -> None:
        if not 1 <= len(name) <= MAX_NAME:
            raise UsageError(f"a proxy's name must have 1 to {MAX_NAME} characters, and {name!r} has {len(name)}")
        self.name = name
        self.driver = driver
        self.server = server_end
        self.clock = clock
        self.run_id = secrets.randbits(63)  #: different in each run
        self.capabilities = driver.capabilities()
        software = software_actions(self.capabilities.actions)
        if software != self.capabilities.software:
            self.capabilities = msgspec.structs.replace(self.capabilities, software=software)
        uri = str(driver.uri)
        self._welcome = Welcome(0, name, self.run_id, os.getpid(), uri, 0, self.capabilities, clock_identity())
        self._sessions: dict[int, Session] = {}
        self._counters = Counters()
        self._counts = self._counters.counts
        self.events = EventPublisher(server_end.publish, clock, self._counters, driver.uri.scrub)
        steerable = bool(self.capabilities.actions & {"attitude", "velocity"})
        flight = Flight(self.capabilities.actions, shared=driver.shared)
        autopilot = SoftwareAutopilot(self.capabilities.actions, flight=flight) if steerable else None
        self.publisher = VehiclePublisher(
            server=server_end,
            events=self.events,
            counters=self._counters,
            clock=clock,
            capabilities=self.capabilities,
            state_of=flight.state,
            # Read the driver's parameters again, because the vehicle answers now.
            on_link_up=lambda: self._requests.call_later(self._parameter_requests.read_driver),
            scrub=driver.uri.scrub,
        )
        self.handler = CommandHandler(
            executor=ActionExecutor(driver, self.capabilities, flight, autopilot, self.publisher),
            publisher=self.publisher,
            events=self.events,
            counters=self._counters,
            server=server_end,
            sessions=self._sessions,
            clock=clock,
            slept=slept or (slept_ns if clock is monotonic_ns else lambda: 0),
        )
        self.parameters = Parameters(lambda: described(driver), driver.set_parameter)
        self.workers = ProcessorWorkers(server_end, self.events, self._counters, self.publisher.cameras)
        self._relay = Relay(driver, server_end, self.publisher, self.events, self._counters)
        self._parameter_requests = ParameterRequests(
            self.parameters, self.handler, self.publisher, self.events, clock, driver.parameters_without_authority
        )
        self._requests = RequestDispatcher(
            server_end,
            self._counters,
            immediate={
                Hello: self._greet,
                Ping: lambda _session, ping, _now_ns: Pong(ping.sent_ns, clock()),
                RequestAuthority: self.handler.request_authority,
                AnswerTakeover: self.handler.answer_takeover,
                ReleaseAuthority: self.handler.release_authority,
                JoinProcessor: self.workers.join,
            },
            deferred={
                GetParameter: self._parameter_requests.get,
                ListParameters: self._parameter_requests.page,
                SetParameter: self._parameter_requests.set,
                GetStatistics: lambda *_: Statistics(self.statistics()),
            },
            on_failure=self.publisher.driver_failed,
            jobs=jobs,
        )
        self.overview = OverviewPublisher(
            server_end,
            lambda: self.publisher.overview(self.name, uri, self.events.last, applications=self.applications),
        )
        self._ticker = threading.Thread(target=self._run, name="skyloop-ticker", daemon=True) if ticker else None
        self._stopping = threading.Event()
        self._life_lock = threading.Lock()
        self._started = False
        self.ended = False  #: whether the proxy is ending, or has ended
        self._trail: AuditTrail | None = None
        self._record: FlightRecord | None = None
        self._decode = decode
        self._command = self.handler.command

    def keep_trail(self, trail: AuditTrail) -> None:
        """Write an audit trail, and close it when the proxy ends. Call before :meth:`start`."""
        self._trail = trail
        self.events.listener = trail.note

    def keep_record(self, record: FlightRecord) -> None:
        """Record the flight in this file, and end a flight that is recorded there. Call before :meth:`start`."""
        self._record = record
        self.handler.on_ownership = record.set

    # Life cycle ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start serving. If the transport or the driver can't be opened, stop again and raise the error."""
        with self._life_lock:
            if self._started:
                raise UsageError(f"proxy {self.name} was started before: create another one")
            self._started = True
        leave_to_parent(self)
        self._parameter_requests.read_driver()
        self.handler.begin(self.clock())
        try:
            self.server.start(self)
        except BaseException:
            self.ended = True
            if self._trail is not None:
                self._trail.close()
            raise
        if self._trail is not None:
            self._trail.begin(str(self.driver.uri))
        if self._record is not None:  # the name is ours from here on
            left_s = self._record.left_s()
            if left_s > 0.0:
                self.handler.flight.began_before(self.clock() + nanoseconds(left_s))
            self._record.start()
        self._requests.start()
        self.overview.begin()
        try:
            self.driver.open(self.publisher)
        except BaseException as error:
            self.end()
            if self.driver.uri.scrub(str(error)) != str(error):  # the message contains the address
                raise DriverError(self.driver.uri.scrub(str(error))) from None
            raise
        if self._ticker is not None:
            self._ticker.start()

    def end(
        self,
        within_s: float = 0.0,
        *,
        reason: str = "the proxy was stopped",
        hurry: Callable[[], bool] = lambda: False,
        unless_flying: bool = False,
        hangs: bool = False,
    ) -> bool:
        """End the flight, then the proxy, and release all resources. Idempotent. Not on the driver's own threads.

        First, everything except landings and emergency stops is refused permanently, whether or not the vehicle is
        flying. A flying vehicle is then landed within ``within_s`` [s]; 0: don't land. If it does not land in time, it
        is left hovering if it can hover without the proxy. Otherwise the driver gets a final set-point of zero speed.

        ``hurry`` is called several times a second; True ends the wait for the landing. A vehicle that can't hover
        without the proxy is still landed, however much time has passed, because it would fall otherwise. With
        ``unless_flying``, the landing and the proxy continue if the vehicle does not land in time. With ``hangs``, the
        driver hangs or fails: nothing waits for the driver, and it is not asked to land or hover. Calls that may hang
        are left to daemon threads, as if the proxy had been killed.

        Returns whether no flight of the proxy remains. Raises the error of a failed step once all steps are done. If
        the driver hangs, errors are logged instead.
        """
        if not self._started or self.ended:
            return True
        try:
            landed = not hangs and self._land(within_s, hurry)
        except Exception:  # noqa: BLE001  if it can't land, it is left hovering, and closed
            _log.exception("the landing at the end of proxy %s failed", self.name)
            landed = False
        if unless_flying and not landed:
            return False
        with self._life_lock:
            if self.ended:
                return landed
            self.ended = True
        self._stopping.set()
        severity = Severity.ERROR if hangs else Severity.WARNING
        with ExitStack() as steps:  # the steps run in reverse order, even if some of them raise
            for kept in (self._record, self._trail):
                if kept is not None:
                    steps.callback(kept.close)
            steps.callback(self._abandon if hangs else self._close)
            steps.callback(self.overview.end)
            steps.callback(self.events.publish, EventKind.PROXY_CLOSING, f"proxy {self.name} ends: {reason}", severity)
            if not hangs:  # this runs first: stop obeying commands and steering
                steps.callback(lambda: self.handler.leave_hovering(self.clock()))
                if self._ticker is not None and self._ticker.is_alive():
                    self._ticker.join()
        return landed

    def _land(self, within_s: float, hurry: Callable[[], bool]) -> bool:
        """Land the vehicle if it flies; return whether no flight of the proxy remains."""
        handler, hovers = self.handler, "hover" in self.capabilities.actions
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s and not (hovers and hurry()):
            if not handler.order_landing(self.clock()):
                return True
            left_s = deadline_s - time.monotonic()
            self.publisher.wait_for(lambda _: not handler.airborne, max(0.0, min(_POLL_S, left_s)))
        return not handler.airborne

    def _close(self) -> None:
        with ExitStack() as steps:  # the steps run from last to first
            steps.callback(self.server.stop)
            steps.callback(self.publisher.streams.end)
            steps.callback(self.driver.close)
            steps.callback(self._requests.stop)

    def forked(self) -> None:
        """Leave the vehicle and the clients to the parent process. Called in a child of ``os.fork``."""
        self.ended = True

    def _abandon(self) -> None:
        """Release resources without waiting for parts that hang, and log failures."""
        parts: tuple[Callable[[], object], ...] = (self.server.stop, self.driver.close, self._requests.stop)
        threads = [
            threading.Thread(target=self._give_back, args=(part,), name="skyloop-abandoned", daemon=True)
            for part in parts
        ]
        for thread in threads:
            thread.start()
        deadline_s = time.monotonic() + _ABANDON_S
        for thread in threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))

    def _give_back(self, part: Callable[[], object]) -> None:
        try:
            part()
        except BaseException:  # noqa: BLE001  nothing else would ever report it
            _log.exception("proxy %s was abandoned, and not all of its resources could be released", self.name)

    def __enter__(self) -> Proxy:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    # From the transport ----------------------------------------------------------------------------------------

    def peer_joined(self, peer: Peer) -> None:
        """Handle a new connection. The application's name and role are unknown until its Hello."""
        self._sessions[peer.id] = Session(peer, self.clock())

    def packet(self, peer: Peer, packet: bytes) -> None:
        """Handle an application's packet on the receiving thread."""
        now_ns = self.clock()
        session = self._sessions.get(peer.id)
        if session is None or session.ended:
            return
        try:
            sample = self._decode(packet)
        except DecodeError as error:
            self._malformed(session, str(error), now_ns)
            return
        kind = type(sample)
        if kind is Command:
            self._command(session, sample, now_ns)  # type: ignore[arg-type]
        elif isinstance(sample, Request):
            self._requests.handle(session, sample, now_ns)
        elif isinstance(sample, Annotation):
            self._malformed(session, self._relay.annotation(session, sample, packet), now_ns)
        elif isinstance(sample, LogEntry):
            self._malformed(session, self._relay.log(session, packet), now_ns)
        elif isinstance(sample, ProcessorResult):
            self._malformed(session, self.workers.relay(session, sample, now_ns), now_ns)
        elif isinstance(sample, VehiclePose):
            self._relay.pose(session, sample)
        elif isinstance(sample, StreamReport):
            self._malformed(session, self.publisher.streams.report(sample), now_ns)
        else:
            self._malformed(session, f"{kind.__name__} may only be sent by the proxy", now_ns)

    def refused(self, peer: Peer, reason: str) -> None:
        """Count and report a packet that the sender's keys don't allow, or whose sender is not connected."""
        session = self._sessions.get(peer.id)
        name = None if session is None else session.name
        code = Refusal.PROTOCOL if session is None else Refusal.OBSERVER
        self._counts["packets.refused"] += 1
        self.events.publish_repeated(
            (peer.id, "refused"),
            lambda: EventDraft(
                EventKind.COMMAND_REFUSED,
                reason if name is None else f"{name}: {reason}",
                app=name,
                data={"reason": code.value, "app_id": peer.id},
            ),
        )

    def topic_problem(self, topic: str) -> str:
        """Return why a topic can't be subscribed to, or an empty string if it can."""
        return self.publisher.topic_problem(topic)

    def malformed(self, peer: Peer, reason: str) -> None:
        """Count an invalid request to the transport as malformed."""
        session = self._sessions.get(peer.id)
        if session is not None and not session.ended:
            self._malformed(session, reason, self.clock())

    def peer_left(self, peer: Peer, reason: str) -> None:
        """Handle the end of an application's connection."""
        session = self._sessions.get(peer.id)
        if session is None:
            return
        news = []
        if session.role is not None:
            text = f"the connection of {session.name} ended: {reason}"
            data: dict[str, Value] = {"state": LinkState.LOST.value, "reason": reason, "app_id": session.app_id}
            news.append(EventDraft(EventKind.APPLICATION_LINK, text, app=session.name, data=data))
        if self._stopping.is_set():  # all applications are leaving, and the driver may already be closed
            self.events.publish_drafts(*news)
        else:
            self.handler.application_left(session, self.clock(), news)
        self.workers.application_left(session)
        del self._sessions[peer.id]

    def _malformed(self, session: Session, reason: str, now_ns: int) -> None:
        """Count a packet as malformed if a reason is given. End a connection that sends too many."""
        if not reason:
            return
        self._counts["packets.malformed"] += 1
        self.events.publish_repeated(
            (session.app_id, "malformed"),
            lambda: EventDraft(
                EventKind.PACKET_MALFORMED,
                f"malformed packet of {session.name}: {reason}",
                app=session.name,
                data={"reason": reason[:200], "app_id": session.app_id},
            ),
        )
        if session.malformed(now_ns):
            session.ended = True
            why = f"more than {MAX_MALFORMED} malformed packets within a second (last: {reason[:200]}): connect again"
            self.server.disconnect(session.peer, why)

    # Time ------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Update all that depends on time: authority, failsafe, autopilot, events, and a silent vehicle's feedback."""
        if self._stopping.is_set():  # a shared ticker, or a ticker that was hanging, may still tick after the end
            return
        self.tick_flight(now_ns)
        self._end_silent(now_ns)
        self.workers.tick(now_ns)
        self.events.tick(now_ns)
        self.overview.tick(now_ns)

    def tick_flight(self, now_ns: int) -> None:
        """Do the part of :meth:`tick` that a flight needs 50 times a second. The other parts may run less often."""
        if self._stopping.is_set():
            return
        self.handler.tick(now_ns)
        self.publisher.keep_alive(now_ns)

    @property
    def at_rest(self) -> bool:
        """Whether feedback already shows that the vehicle is not flying and has no pilot. If so, nothing is urgent."""
        return self.handler.at_rest and self.publisher.is_shown

    def _end_silent(self, now_ns: int) -> None:
        """End connections that have sent no Hello, because they occupy places."""
        for session in list(self._sessions.values()):
            if session.role is None and not session.ended and now_ns - session.joined_ns > HELLO_NS:
                session.ended = True
                self._counts["connections.silent"] += 1
                why = f"no Hello arrived within {seconds(HELLO_NS):g} s"
                text = f"a connection of {session.peer.address} was closed: {why}"
                data: dict[str, Value] = {"state": LinkState.LOST.value, "reason": why, "app_id": session.app_id}
                draft = partial(EventDraft, EventKind.APPLICATION_LINK, text, data=data)
                self.events.publish_repeated(("silent",), draft)
                self.server.disconnect(session.peer, f"{why}: connect again")

    def _run(self) -> None:
        period_ns = nanoseconds(PERIOD_S)
        due_ns = time.monotonic_ns() + period_ns
        while not self._stopping.wait(max(0, due_ns - time.monotonic_ns()) / 1e9):
            try:
                self.tick(self.clock())
            except Exception:  # noqa: BLE001 the vehicle needs its failsafe whatever goes wrong here
                _log.exception("a step of the ticker failed")
            due_ns = max(due_ns + period_ns, time.monotonic_ns())  # missed periods are skipped

    # Requests that the proxy itself answers --------------------------------------------------------------------

    def _greet(self, session: Session, hello: Hello, now_ns: int) -> AnyReply:
        if session.role is not None:
            return Refused(Refusal.PROTOCOL, "Hello was already sent on this connection")
        if full := self.server.admit(session.peer, pilot=hello.role is Role.PILOT):
            return Refused(Refusal.BUSY, full)
        session.name, session.role = hello.name, hello.role
        text = f"{hello.name} connected as {hello.role.value} from {session.peer.address}"
        data: dict[str, Value] = {"state": LinkState.UP.value, "reason": "", "app_id": session.app_id}
        self.events.publish(EventKind.APPLICATION_LINK, text, app=hello.name, data=data)
        return msgspec.structs.replace(self._welcome, app_id=session.app_id, now_ns=now_ns)

    def statistics(self) -> dict[str, float]:
        """Return all counters by dotted name, as ``GetStatistics`` does. Thread-safe."""
        return self._counters.snapshot(applications=self.applications, **self.server.counters)

    @property
    def applications(self) -> int:
        """The number of connected applications. Thread-safe."""
        return sum(session.role is not None for session in list(self._sessions.values()))
