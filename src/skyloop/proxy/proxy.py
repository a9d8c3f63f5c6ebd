"""The proxy: one vehicle's driver made a node that any number of applications see and one at a time flies.

Threads: the transport's receiving thread applies commands, the driver's threads publish what they heard, a ticker at
50 Hz looks after authority, failsafe and software autopilot, and a worker answers the requests that may ask the driver.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.base import Driver
from skyloop.errors import DecodeError, UsageError
from skyloop.messages import (
    Annotation,
    Command,
    EventKind,
    LinkState,
    LogEntry,
    ProcessorResult,
    Refusal,
    Request,
    Severity,
    Value,
    VehiclePose,
    Welcome,
    decode,
)
from skyloop.proxy.audit import AuditTrail
from skyloop.proxy.autopilot import PERIOD_S, AutopilotSettings
from skyloop.proxy.events import EventLog, Notice
from skyloop.proxy.failsafe import LadderSettings
from skyloop.proxy.flight import Flight
from skyloop.proxy.helm import Helm
from skyloop.proxy.limits import Limits
from skyloop.proxy.parameters import Parameters
from skyloop.proxy.poses import Poses
from skyloop.proxy.processors import Processors
from skyloop.proxy.requests import Requests
from skyloop.proxy.sessions import MAX_MALFORMED, Session
from skyloop.proxy.statistics import Counters
from skyloop.proxy.vehicle import Vehicle
from skyloop.proxy.watch import Watch
from skyloop.proxy.zones import ZONES, safety_of
from skyloop.transport.base import ANNOTATIONS, LOGS, Peer, ServerEnd

MAX_NAME: Final = 64  #: characters of a proxy's name
MAX_ANNOTATION: Final = 32_768  #: bytes of an annotation's packet

_log = logging.getLogger(__name__)


class Proxy:
    """Owns a driver and a transport's server end, from :meth:`start` to :meth:`stop`; also a context manager.

    ``clock`` is the clock of all its samples. ``ticker`` False leaves :meth:`tick` to the caller, for tests and for
    time that stands still. Raises :class:`UsageError` for a name that is empty or longer than 64 characters.
    """

    def __init__(
        self, driver: Driver, server_end: ServerEnd, *, name: str, clock: Clock = monotonic_ns, ticker: bool = True
    ) -> None:
        if not 1 <= len(name) <= MAX_NAME:
            raise UsageError(f"a proxy's name has 1 to {MAX_NAME} characters, and {name!r} has {len(name)}")
        self.name = name
        self.driver = driver
        self.server = server_end
        self.clock = clock
        self.run_id = secrets.randbits(63)  #: another number in each run
        self.capabilities = driver.capabilities()
        self._sessions: dict[int, Session] = {}
        self._counters = Counters()
        self._counts = self._counters.counts
        self.events = EventLog(server_end.publish, clock, self._counters)
        self.vehicle = Vehicle(server_end, self.events, self._counters, clock, self.capabilities)
        self.helm = Helm(driver, self.capabilities, self.vehicle)
        self.watch = Watch(self.helm, self.vehicle, self.events, server_end, clock, self._sessions)
        self.flight = Flight(self.watch, self.helm, self.vehicle, self.events, self._counters, server_end, clock)
        self.parameters = Parameters(driver.parameters, driver.set_parameter)
        self.processors = Processors(server_end, self.events, self._counters)
        self.poses = Poses(driver, self.events, self._counters)
        self.requests = self._make_requests()
        self.vehicle.on_link_up = self.requests.refresh_parameters
        self._ticker = threading.Thread(target=self._run, name="skyloop-ticker", daemon=True) if ticker else None
        self._stopping = threading.Event()
        self._life_lock = threading.Lock()
        self._started = self._stopped = False
        self._trail: AuditTrail | None = None
        self._decode = decode
        self._command = self.flight.command

    def _make_requests(self) -> Requests:
        uri = str(self.driver.uri)
        welcome = Welcome(0, self.name, self.run_id, os.getpid(), uri, 0, self.capabilities)
        return Requests(
            self.server,
            self.watch,
            self.parameters,
            self.vehicle,
            self.events,
            self._counters,
            self.clock,
            welcome,
            self._configure,
            self._applications,
            self.processors,
        )

    def _applications(self) -> int:
        return sum(session.role is not None for session in list(self._sessions.values()))

    def keep_trail(self, trail: AuditTrail) -> None:
        """Write who flies when to this trail, which ends with the proxy. To be called before :meth:`start`."""
        self._trail = trail
        self.events.listener = trail.note

    # Life cycle ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Serve. Raises what the server end and the driver raise when they cannot be opened, and is stopped then."""
        with self._life_lock:
            if self._started:
                raise UsageError(f"proxy {self.name} was started before: make another one")
            self._started = True
        self.requests.read_driver()
        self.watch.begin(self.clock())
        try:
            self.server.start(self)
        except BaseException:
            self._stopped = True
            if self._trail is not None:
                self._trail.close()
            raise
        if self._trail is not None:
            self._trail.begin(str(self.driver.uri))
        self.requests.start()
        try:
            self.driver.open(self.vehicle)
        except BaseException:
            self.stop()
            raise
        if self._ticker is not None:
            self._ticker.start()

    def land(self, timeout_s: float) -> bool:
        """Land what flies because the proxy is about to end, and wait for it; whether nothing flies any more.

        From the first call on the proxy takes no set-points, only landing and emergency stop.
        """
        if not self.watch.order_landing(self.clock()):
            return True
        return self.vehicle.wait_for(lambda _: not self.watch.airborne, timeout_s)

    def stop(self, *, reason: str = "the proxy was stopped") -> None:
        """Tell everybody and give every resource back. Idempotent.

        It does not land: what flies is left hovering, as far as the vehicle can by itself. See :meth:`land`.
        """
        with self._life_lock:
            if self._stopped or not self._started:
                return
            self._stopped = True
        self.events.tell(EventKind.PROXY_CLOSING, f"proxy {self.name} ends: {reason}", Severity.WARNING)
        self._stopping.set()
        if self._ticker is not None and self._ticker.is_alive():
            self._ticker.join()
        self.watch.leave_hovering(self.clock())
        self.requests.stop()
        try:
            self.driver.close()
        finally:
            self.server.stop()
            if self._trail is not None:
                self._trail.close()

    def __enter__(self) -> Proxy:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # From the transport ----------------------------------------------------------------------------------------

    def peer_joined(self, peer: Peer) -> None:
        """An application connected; it is nobody until its Hello."""
        self._sessions[peer.id] = Session(peer)

    def packet(self, peer: Peer, packet: bytes) -> None:
        """A packet of an application, on the receiving thread."""
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
            self.requests.take(session, sample, now_ns)
        elif kind is Annotation:
            self._relay_annotation(session, packet, now_ns)
        elif kind is LogEntry:
            self._relay(session, packet, now_ns, LOGS)
        elif isinstance(sample, ProcessorResult):
            self._relay_result(session, sample, now_ns)
        elif isinstance(sample, VehiclePose):
            self.poses.take(session, sample)
        else:
            self._malformed(session, f"{kind.__name__} is for the proxy to send", now_ns)

    def refused(self, peer: Peer, reason: str) -> None:
        """Somebody sent what its keys give it no right to, or what nobody that is connected may send."""
        session = self._sessions.get(peer.id)
        name = None if session is None else session.name
        code = Refusal.PROTOCOL if session is None else Refusal.OBSERVER
        self._counts["packets.refused"] += 1
        self.events.repeated(
            (peer.id, "refused"),
            lambda: Notice(
                EventKind.COMMAND_REFUSED,
                reason if name is None else f"{name}: {reason}",
                app=name,
                data={"reason": code.value, "app_id": peer.id},
            ),
        )

    def peer_left(self, peer: Peer, reason: str) -> None:
        """An application's connection ended."""
        session = self._sessions.get(peer.id)
        if session is None:
            return
        if session.role is not None:
            text = f"the connection of {session.name} ended: {reason}"
            data: dict[str, Value] = {"state": LinkState.LOST.value, "reason": reason, "app_id": session.app_id}
            self.events.tell(EventKind.APPLICATION_LINK, text, Severity.WARNING, app=session.name, data=data)
        if not self._stopping.is_set():  # else everybody leaves, and the driver may be closed already
            self.watch.gone(session, self.clock())
        self.processors.gone(session)
        del self._sessions[peer.id]

    def _relay_annotation(self, session: Session, packet: bytes, now_ns: int) -> None:
        if len(packet) > MAX_ANNOTATION:
            why = f"an annotation has {len(packet)} bytes, at most {MAX_ANNOTATION} are relayed"
            self._malformed(session, why, now_ns)
        else:
            self._relay(session, packet, now_ns, ANNOTATIONS)

    def _relay(self, session: Session, packet: bytes, now_ns: int, topic: str) -> None:
        """Hand what an application tells the others to whoever subscribed to it."""
        if session.role is None:
            self._malformed(session, f"a packet for {topic} came before Hello", now_ns)
        else:
            self._counts[f"{topic}.relayed"] += 1
            self.server.publish(topic, packet)

    def _relay_result(self, session: Session, result: ProcessorResult, now_ns: int) -> None:
        if session.role is None:
            self._malformed(session, "a result came before Hello", now_ns)
        else:
            self.processors.relay(session, result)

    def _malformed(self, session: Session, reason: str, now_ns: int) -> None:
        self._counts["packets.malformed"] += 1
        self.events.repeated(
            (session.app_id, "malformed"),
            lambda: Notice(
                EventKind.PACKET_MALFORMED,
                f"malformed packet of {session.name}: {reason}",
                app=session.name,
                data={"reason": reason[:200], "app_id": session.app_id},
            ),
        )
        if session.malformed(now_ns):
            session.ended = True
            why = f"more than {MAX_MALFORMED} malformed packets within a second (last: {reason[:200]}): connect anew"
            self.server.disconnect(session.peer, why)

    # Time ------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """What goes by time: authority, failsafe, software autopilot, feedback of a silent vehicle, sums of events."""
        self.watch.tick(now_ns)
        self.vehicle.keep_alive(now_ns)
        self.processors.tick(now_ns)
        self.events.tick(now_ns)

    def _run(self) -> None:
        period_ns = nanoseconds(PERIOD_S)
        due_ns = time.monotonic_ns() + period_ns
        while not self._stopping.wait(max(0, due_ns - time.monotonic_ns()) / 1e9):
            try:
                self.tick(self.clock())
            except Exception:  # noqa: BLE001  the vehicle needs its ladder whatever is wrong here
                _log.exception("a step of the ticker failed")
            due_ns = max(due_ns + period_ns, time.monotonic_ns())  # late ones are not made up for

    # Parameters ------------------------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Let the parameters' values take effect."""
        number = self.parameters.number
        limits = Limits(
            tilt=number("limits.tilt"),
            climb=number("limits.climb"),
            yaw_rate=number("limits.yaw_rate"),
            speed=number("limits.speed"),
            altitude=number("limits.altitude"),
        )
        ladder = LadderSettings(
            hover_after_s=number("failsafe.hover_after_s"),
            land_after_s=number("failsafe.land_after_s"),
            retry_s=number("failsafe.retry_s"),
            battery_warn=number("battery.warn"),
            battery_land=number("battery.land"),
        )
        autopilot = AutopilotSettings(
            takeoff_altitude=min(number("autopilot.takeoff_altitude"), limits.altitude),
            climb=min(number("autopilot.climb"), limits.climb),
            descent=min(number("autopilot.descent"), limits.climb),
            velocity_p=number("autopilot.velocity_p"),
            velocity_i=number("autopilot.velocity_i"),
            tilt=limits.tilt,
        )
        safety = safety_of(number, self.parameters.text(ZONES))
        with self.watch.lock:
            self.flight.limits = limits
            self.flight.safety = safety
            self.flight.max_age_ns = nanoseconds(number("command.max_age_s"))
            self.watch.authority.timeout_ns = nanoseconds(number("authority.timeout_s"))
            self.watch.authority.ask_ns = nanoseconds(number("authority.ask_s"))
            self.watch.ladder.settings = ladder
            if self.helm.autopilot is not None:
                self.helm.autopilot.settings = autopilot
