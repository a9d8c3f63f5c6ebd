"""The watch: who is in command, and what happens when nobody is.

It owns the lock that every decision about the flight is made under, for as long as the decision and the driver's call
last: the transport's thread brings commands and claims, the ticker brings the time.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

from skyloop.clock import Clock, nanoseconds, seconds
from skyloop.messages import (
    AnswerTakeover,
    AnyAction,
    AnyReply,
    Applied,
    AuthorityGranted,
    AuthorityQueued,
    Done,
    EventKind,
    Failsafe,
    FlightState,
    Hover,
    Refusal,
    Refused,
    RequestAuthority,
    Role,
    Severity,
    Takeover,
    encode,
)
from skyloop.proxy import authority as rights
from skyloop.proxy import failsafe
from skyloop.proxy.authority import Authority
from skyloop.proxy.events import EventLog
from skyloop.proxy.failsafe import Ladder, View
from skyloop.proxy.helm import Helm
from skyloop.proxy.rights_told import Scene, tell
from skyloop.proxy.sessions import Session
from skyloop.proxy.vehicle import Vehicle
from skyloop.transport.base import COMMANDS, ServerEnd

REASONS: Final = {
    "silent": "the pilot is silent",
    "gone": "the pilot's connection ended",
    "released": "the pilot released the authority",
    "expired": "the pilot's time is over",
    "none": "nobody is in command",
    "vehicle_link": "the link to the vehicle is lost",
    "battery": "the battery is nearly empty",
    "closing": "the proxy is closing",
}


class Watch:
    """Authority and failsafe ladder of one vehicle, with what follows from their decisions."""

    def __init__(
        self,
        helm: Helm,
        vehicle: Vehicle,
        events: EventLog,
        server: ServerEnd,
        clock: Clock,
        sessions: Mapping[int, Session],
    ) -> None:
        self.lock = threading.RLock()
        self.authority = Authority()
        self.ladder = Ladder()
        self._helm = helm
        self._vehicle = vehicle
        self._tell = events.tell
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._clock = clock
        self._sessions = sessions
        self._pilot = "none"  # why nobody holds the authority, or "held"
        self.breaks_seen = 0  #: of the vehicle's link, as last looked at
        self._stamp()

    def begin(self, now_ns: int) -> None:
        """The run begins: a vehicle that flies already waits for its pilot to come back, as if just heard."""
        self.authority.heard_ns = now_ns

    # Authority -------------------------------------------------------------------------------------------------

    def request_authority(self, session: Session, request: RequestAuthority, now_ns: int) -> AnyReply:
        """Give the authority, or a place in the line, or say who holds it."""
        if session.role is not Role.PILOT:
            return Refused(Refusal.OBSERVER, "observers get no authority: connect as a pilot")
        term_ns = None if request.for_s is None else nanoseconds(request.for_s)
        ask = request.takeover is Takeover.ASK
        app_id, authority = session.app_id, self.authority
        with self.lock:
            effects = authority.request(app_id, request.priority, request.queue, now_ns, term_ns=term_ns, ask=ask)
            self._take_rights(effects, now_ns)
            holder = authority.holder
            assert holder is not None  # a request leaves somebody in command
            if holder.app_id == app_id:
                return AuthorityGranted(authority.lease, authority.until_ns or 0)
            name, position = self._name(holder.app_id), authority.position(app_id)
            wait_ns, asked = authority.wait_ns(app_id, now_ns), authority.asking(app_id, now_ns)
        if position:
            wait_s = None if wait_ns is None else seconds(wait_ns)
            return AuthorityQueued(position, name, holder.priority, wait_s, asked)
        why = f"{name} holds the authority with priority {holder.priority}: ask with a higher one (0 is the highest)"
        return Refused(Refusal.BUSY, why)

    def answer_takeover(self, session: Session, answer: AnswerTakeover, now_ns: int) -> AnyReply:
        """The holder grants or declines what it was asked for."""
        with self.lock:
            if not self.holds(session, answer.lease):
                return Refused(Refusal.FOREIGN_LEASE, "only the holder can answer, under its own lease")
            effects = self.authority.answer(
                session.app_id, answer.lease, answer.app_id, answer.grant, answer.reason, now_ns
            )
            self._take_rights(effects, now_ns)
        return Done()

    def release_authority(self, session: Session, now_ns: int) -> AnyReply:
        """Give the authority back or leave the line."""
        with self.lock:
            self._take_rights(self.authority.release(session.app_id, now_ns), now_ns)
        return Done()

    def gone(self, session: Session, now_ns: int) -> None:
        """An application's connection ended: it is still among the sessions."""
        with self.lock:
            self._take_rights(self.authority.gone(session.app_id, now_ns), now_ns)

    def holds(self, session: Session, lease: int) -> bool:
        """Whether the application holds the authority under this lease."""
        with self.lock:
            holder = self.authority.holder
            return holder is not None and holder.app_id == session.app_id and lease == self.authority.lease

    def _take_rights(self, effects: list[rights.Effect], now_ns: int) -> None:
        """Bring the vehicle to hover where the authority changes hands, then tell everybody."""
        for effect in effects:
            if isinstance(effect, rights.Lost):
                self._pilot = effect.reason
            elif isinstance(effect, rights.Granted):
                self._pilot = "held"
                self._sessions[effect.app_id].track.end_intents()
                self.ladder.hand_over(now_ns)
        self._stamp()
        ended = [effect for effect in effects if isinstance(effect, (rights.Lost, rights.Preempted))]
        for effect in ended:
            self._tell_right(effect, now_ns)
        self._climb(now_ns)  # which hovers, before anybody hears that he has the authority
        for effect in effects:
            if effect not in ended:
                self._tell_right(effect, now_ns)

    def _tell_right(self, effect: rights.Effect, now_ns: int) -> None:
        holder = self.authority.holder
        scene = Scene(now_ns, self._name, self._identity, "" if holder is None else self._name(holder.app_id))
        notice = tell(effect, scene)
        self._tell(notice.kind, notice.text, notice.severity, app=notice.app, data=notice.data)

    def _identity(self, app_id: int) -> str:
        """What the transport knows of who this is."""
        session = self._sessions.get(app_id)
        return "" if session is None else session.peer.address

    def _name(self, app_id: int) -> str:
        session = self._sessions.get(app_id)
        return session.name if session is not None else f"application {app_id}"

    def _stamp(self) -> None:
        owner = self.authority.owner
        self._vehicle.stamp(
            {
                "owner": self._name(owner.app_id) if owner is not None else None,
                "owner_id": owner.app_id if owner is not None else 0,
                "owner_priority": owner.priority if owner is not None else None,
                "lease": self.authority.lease,
                "failsafe": self.ladder.step,
            }
        )

    # Time ------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Look after authority and ladder, and let the software autopilot steer. At a steady pace."""
        with self.lock:
            self.look_at_link(now_ns)
            effects = self.authority.tick(now_ns)
            if effects:
                self._take_rights(effects, now_ns)
            self._climb(now_ns)
            steered = self._helm.step(now_ns)
            if steered is not None:
                self._echo(steered, now_ns)

    def order_landing(self, now_ns: int) -> bool:
        """The proxy is about to end: land. Returns whether there is anything to land."""
        with self.lock:
            if not self._helm.airborne:
                return False
            self.ladder.order_landing()
            self._climb(now_ns)
            return True

    def leave_hovering(self, now_ns: int) -> None:
        """The proxy ends now: what flies is left hovering, as far as the vehicle can by itself."""
        with self.lock:
            if self._helm.airborne and self._helm.state is not FlightState.LANDING:
                self._helm.failsafe(Hover(), now_ns)

    @property
    def airborne(self) -> bool:
        """Whether the vehicle flies, or may."""
        return self._helm.airborne

    def look_at_link(self, now_ns: int) -> None:
        """Act on what happened to the vehicle's link since the last look. Under the lock.

        Intents end when it breaks and when it is back, so that nothing asked for in between is done later. Hover is
        given both times: a driver must not go on with an old set-point.
        """
        breaks = self._vehicle.link_breaks
        if breaks != self.breaks_seen:
            self.breaks_seen = breaks
            self.end_intents()
            self.ladder.hand_over(now_ns)
            self._climb(now_ns)

    def fresh_command(self, now_ns: int) -> None:
        """The pilot's fresh command was accepted: a step of the ladder ends. Under the lock."""
        self._take_steps(self.ladder.fresh_command(), now_ns)

    def end_intents(self) -> None:
        """Repeats of what the holder asked for until now are refused from here on. Under the lock."""
        holder = self.authority.holder
        session = self._sessions.get(holder.app_id) if holder is not None else None
        if session is not None:
            session.track.end_intents()

    def _climb(self, now_ns: int) -> None:
        feedback = self._vehicle.feedback_now
        view = View(
            state=self._helm.state,
            airborne=self._helm.airborne,
            heard_ns=self.authority.heard_ns,
            pilot=self._pilot,
            link_up=self._vehicle.link_up,
            battery=feedback.battery if feedback is not None else None,
        )
        effects = self.ladder.tick(now_ns, view)
        if effects:
            self._take_steps(effects, now_ns)

    def _take_steps(self, effects: list[failsafe.Effect], now_ns: int) -> None:
        for effect in effects:
            if isinstance(effect, failsafe.Do):
                taken = self._helm.failsafe(effect.action, now_ns)
                self.ladder.tried(taken)
                if taken:
                    self._echo(effect.action, now_ns)
            elif isinstance(effect, failsafe.BatteryLow):
                text = f"battery low: {effect.battery:.0%} left"
                self._tell(EventKind.BATTERY_LOW, text, Severity.WARNING, data={"battery": effect.battery})
            else:
                self._step(effect)

    def _step(self, step: failsafe.Step) -> None:
        self._stamp()
        why = REASONS.get(step.reason, step.reason)
        if step.step is Failsafe.NONE:
            text, severity = f"failsafe ended: {why}", Severity.INFO
        else:
            text, severity = f"failsafe: {step.step.value}, because {why}", Severity.WARNING
            self.end_intents()
        self._tell(EventKind.FAILSAFE, text, severity, data={"step": step.step.value, "reason": step.reason})

    def _echo(self, action: AnyAction, now_ns: int) -> None:
        if self._subscribers(COMMANDS):
            echo = Applied(0, self.authority.lease, 0, now_ns, self._clock(), action, action)
            self._publish(COMMANDS, encode(echo))
