"""The command handler. It executes applications' requests under the lock of :mod:`skyloop.proxy.supervision`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

from skyloop.clock import nanoseconds, seconds
from skyloop.errors import RefusedError
from skyloop.messages import (
    Action,
    AnswerTakeover,
    AnyAction,
    AnyReply,
    Applied,
    AuthorityGranted,
    AuthorityQueued,
    Command,
    Done,
    EmergencyStop,
    Failsafe,
    Fate,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    ReturnToStart,
    Role,
    Takeoff,
    Takeover,
    encode,
)
from skyloop.messages.command import SET_POINTS
from skyloop.messages.fields import LATEST_NS
from skyloop.proxy.core.airspace import AirspaceSettings
from skyloop.proxy.core.autopilot import AutopilotSettings, ReturnSettings
from skyloop.proxy.core.command_checks import TAKEOFF_NS, Intent, explain
from skyloop.proxy.core.failsafe import REASONS, FailsafeSettings
from skyloop.proxy.core.flight import Snapshot, Whose
from skyloop.proxy.events import EventDraft, emergency_event, name_of, refused_event, taken_event, thin_zones_event
from skyloop.proxy.requests import Session
from skyloop.proxy.supervision import SLEEP_NS, FlightSupervisor
from skyloop.transport.base import COMMANDS

_LEAVE_A_TAKEOFF: Final = (Takeoff, *SET_POINTS)  #: commands that don't affect a take-off in progress; others end it
#: Echo of a command that had no new effect because it was refused or already in effect.
_NOTHING: Final = Idle()


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """All settings that follow from parameters."""

    airspace: AirspaceSettings = field(default_factory=AirspaceSettings)
    failsafe: FailsafeSettings = field(default_factory=FailsafeSettings)
    autopilot: AutopilotSettings = field(default_factory=AutopilotSettings)
    returns: ReturnSettings = field(default_factory=ReturnSettings)
    max_age_ns: int = 0  #: maximum age of a command [ns]
    authority_timeout_ns: int = 0
    authority_ask_ns: int = 0


class CommandHandler(FlightSupervisor):
    """Handles applications' requests to one vehicle. Public methods are thread-safe."""

    def configure(self, settings: FlightSettings) -> None:
        """Apply new parameter values. Settings that have not changed are the same objects as before."""
        with self._lock:
            airspace, space = self.checks.airspace, settings.airspace.space
            if space is not airspace.settings.space:
                if space.thin and space != airspace.settings.space:
                    self._events.publish_drafts(thin_zones_event(space))
                self._executor.guarded = space.walled
            airspace.settings = settings.airspace
            self.checks.returns = settings.returns
            self.checks.max_age_ns = settings.max_age_ns
            self.authority.timeout_ns = settings.authority_timeout_ns
            self.authority.ask_ns = settings.authority_ask_ns
            self.ladder.settings = settings.failsafe
            if self._executor.autopilot is not None:
                self._executor.autopilot.settings = settings.autopilot

    def problem_with_ceiling(self, altitude: float) -> str:
        """Return a readable reason not to lower ``limits.altitude`` to this height [m] now; empty if there is none."""
        with self._lock:
            flies = self._executor.airborne
            return self.checks.airspace.ceiling_problem(altitude, self._publisher.feedback_now) if flies else ""

    def problem_with_moment(self) -> str:
        """Return a readable reason why a momentary parameter, such as a flip, can't be written now; empty if it can."""
        with self._lock:
            ladder, others = self.ladder, self.flight.others
            if ladder.barred == "closing" or (ladder.barred and self._executor.airborne):
                return f"only landing is possible: {REASONS[ladder.barred]}"
            if ladder.step is not Failsafe.NONE:
                return f"a failsafe is active, because {REASONS.get(ladder.reason, ladder.reason)}: command it first"
            return f"{others}: hover, take off or land first to take it over" if others else ""

    # The end of a flight ----------------------------------------------------------------------------------------

    def order_landing(self, now_ns: int) -> bool:
        """Land because the proxy is about to end. From now on, accept only landings and emergency stops.

        Returns whether the proxy has a flight, or a flight may be about to begin.
        """
        with self._lock:
            self.ladder.order_landing()
            self._update_failsafe(now_ns)
            if self.flight.ours and self.flight.may_begin(now_ns):
                self._rising_until_ns = now_ns  # continue to withdraw the take-off, because nothing else does so later
            self._withdraw_takeoff(now_ns)
            return self.airborne

    def leave_hovering(self, now_ns: int) -> None:
        """Leave a flying vehicle hovering as well as it can without the proxy, because the proxy is ending."""
        with self._lock:
            self.ladder.order_landing()
            try:
                self._observe_vehicle(now_ns)
                executor, withdrew = self._executor, self._withdraw_takeoff(now_ns)
                lands = executor.state is FlightState.LANDING and (Land in executor.native or not withdrew)
                if self.flight.ours and executor.airborne and not lands:
                    executor.leave(now_ns)
            finally:
                self._left = True

    @property
    def airborne(self) -> bool:
        """Whether the vehicle may be flying or about to fly, so that the proxy must land it. Acquires no lock."""
        return self.flight.ours and (self._executor.airborne or self.flight.may_begin(self._clock()))

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle is not flying, there is no pilot, and nothing is pending. Acquires no lock."""
        return (
            self.authority.holder is None
            and self.ladder.idle
            and not self.flight.ours
            and self._publisher.link_breaks == self._breaks_seen
            and not self._executor.airborne
        )

    # The authority ----------------------------------------------------------------------------------------------

    def request_authority(self, session: Session, request: RequestAuthority, now_ns: int) -> AnyReply:
        """Grant the authority or a position in the queue, or refuse the request and name the holder."""
        if session.role is not Role.PILOT:
            return Refused(Refusal.OBSERVER, "observers get no authority: connect as a pilot")
        term_ns = None if request.for_s is None else nanoseconds(request.for_s)
        ask = request.takeover is Takeover.ASK
        app_id, authority = session.app_id, self.authority
        with self._lock:
            effects = authority.request(app_id, request.priority, request.queue, now_ns, term_ns=term_ns, ask=ask)
            self._apply_authority(effects, now_ns)
            holder = authority.holder
            assert holder is not None  # after a request, there is always a holder
            if holder.app_id == app_id:
                return AuthorityGranted(authority.lease, authority.until_ns or 0)
            name, position = name_of(self._sessions, holder.app_id), authority.position(app_id)
            wait_ns, asked = authority.wait_ns(app_id, now_ns), authority.asking(app_id, now_ns)
        if position:
            wait_s = None if wait_ns is None else seconds(wait_ns)
            return AuthorityQueued(position, name, holder.priority, wait_s, asked)
        why = f"{name} holds the authority with priority {holder.priority}: use a higher one (0 is the highest)"
        return Refused(Refusal.BUSY, why)

    def answer_takeover(self, session: Session, answer: AnswerTakeover, now_ns: int) -> AnyReply:
        """Handle the holder's answer to a request to hand the authority over."""
        with self._lock:
            if not self.holds(session, answer.lease):
                return Refused(Refusal.FOREIGN_LEASE, "only the holder can answer, under its own lease")
            effects = self.authority.answer(
                session.app_id, answer.lease, answer.app_id, answer.grant, answer.reason, now_ns
            )
            self._apply_authority(effects, now_ns)
        return Done()

    def release_authority(self, session: Session, _request: ReleaseAuthority, now_ns: int) -> AnyReply:
        """Take the authority away from an application, or remove it from the queue."""
        with self._lock:
            self._apply_authority(self.authority.release(session.app_id, now_ns), now_ns)
        return Done()

    def application_left(self, session: Session, now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """Handle the end of a session that is still listed. ``news``: published once the vehicle hovers."""
        with self._lock:
            self._apply_authority(self.authority.gone(session.app_id, now_ns), now_ns, news)

    def holds(self, session: Session, lease: int) -> bool:
        with self._lock:
            holder = self.authority.holder
            return holder is not None and holder.app_id == session.app_id and lease == self.authority.lease

    # Commands: all methods but the first are called under the lock --------------------------------------------------

    def command(self, session: Session, command: Command, now_ns: int) -> None:
        """Check a command and execute it on the receiving thread."""
        # After the computer has slept, an old command looks as if it had just been sent: correct the command's age.
        if self._slept() - self._slept_seen >= SLEEP_NS:
            with self._lock:
                self._observe_sleep(now_ns)
        if command.sent_ns < self._awake_ns:
            command = msgspec.structs.replace(command, sent_ns=command.sent_ns - self._slept_ns)
        with self._lock:
            if type(command.action) is EmergencyStop:
                applied, applied_ns = self._stop_motors(session, command, now_ns)
            else:
                applied, applied_ns = self._obey(session, command, now_ns)
        self._counts["commands.received"] += 1
        if self._subscribers(COMMANDS):
            sent_ns = max(-LATEST_NS, min(command.sent_ns, LATEST_NS))  # within the limits of that field in the echo
            action, app_id = command.action, session.app_id
            echo = Applied(command.seq, command.lease, app_id, sent_ns, applied_ns, action, applied)
            self._publish(COMMANDS, encode(echo))

    def _obey(self, session: Session, command: Command, now_ns: int) -> tuple[AnyAction, int]:
        """Return what was applied and when. For a refused command, return when it was received."""
        # On a machine that was idle, as is usual before a command, each function call costs microseconds. Ordinary
        # commands are therefore received, judged and executed here. Error messages are written elsewhere.
        vehicle, checks, flight = self._publisher, self.checks, self.flight
        if vehicle.link_breaks != self._breaks_seen:
            self._observe_link(now_ns)
        if flight.whose is not Whose.OURS:
            self._observe_vehicle(now_ns)
        intents = session.intents
        state = self._observe_intent(session, now_ns)  # intents that ended earlier must not end this one
        refusal = checks.receive(command, intents, session.app_id, now_ns)
        if refusal is not None:
            if session.role is not Role.PILOT:
                return self._refuse_role(session, command), now_ns
            why = explain(
                refusal, command, intents.seq, now_ns=now_ns, max_age_ns=checks.max_age_ns, lease=self.authority.lease
            )
            return self._refuse(session, command, refusal, why), now_ns
        action = command.action
        kind = type(action)
        intent, new = intents.intent_of(command, state, now_ns)
        if kind not in _LEAVE_A_TAKEOFF:
            if self._withdraw_takeoff(now_ns):
                intent.withdrew = kind is Land
                if kind is Hover:  # the vehicle is on the ground and stays there
                    intent.end(Fate.COMPLETED if new else Fate.WITHDRAWN)
            state = self._executor.state
        if kind is Idle:
            if type(intents.newest.action) is Takeoff:
                intents.newest.end(Fate.WITHDRAWN)
            self._report_intent(session)
            return _NOTHING, self._count_applied(command)
        if intent.over:
            self._report_intent(session)
            if intent.reason is None:  # the intent was executed
                return _NOTHING, self._count_applied(command)
            return self._refuse(session, command, intent.reason, intent.text), now_ns
        intent.action = action  # a set-point that timed out may have become a hover
        automatic, fresh = command.automatic, new
        new = new and not automatic  # the library's own actions don't count as a person's decision
        seen = Snapshot(now_ns, state, vehicle.feedback_now, vehicle.link_state, vehicle.link_up)
        decision = checks.decide(action, intent, seen, new=new, automatic=automatic)
        if decision.refusal is not None:
            # A refusal may include a hover as a substitute. If the vehicle rejects it, the old action must still end.
            if decision.action is None or not self._executor.attempt(decision.action, now_ns, "apply"):
                self._stop_before(kind, now_ns)
            return self._refuse_intent(session, command, intent, decision.refusal, decision.why, now_ns), now_ns
        applied: AnyAction = _NOTHING
        if decision.action is not None:
            if decision.clamps or (decision.enforced is not None and decision.enforced is not self._enforced):
                self._report_limits(session, decision.clamps, decision.enforced, now_ns)
                if decision.clamps:
                    self._counts["commands.clamped"] += 1
            try:
                begins = new or (fresh and decision.takes_off)  # this includes a take-off that a waiting call repeats
                applied = self._executor.execute(decision.action, now_ns, new=begins)
            except RefusedError as error:
                self._stop_before(kind, now_ns)
                return self._refuse_intent(session, command, intent, Refusal.WRONG_STATE, str(error), now_ns), now_ns
            except Exception as error:  # noqa: BLE001  it is reported, and the flight continues
                why = vehicle.driver_refused("apply", error)
                self._stop_before(kind, now_ns)
                return self._refuse_intent(session, command, intent, Refusal.DRIVER_FAILED, why, now_ns), now_ns
            intent.begun = True
            if decision.takes_off:
                flight.claim(now_ns)
                self._rising_until_ns = intent.asked_ns + TAKEOFF_NS
            if flight.whose is not Whose.OURS or kind is Takeoff:
                self._take_vehicle(session, applied, new)
        intent.reason, intent.text = None, ""
        if kind is not ReturnToStart and decision.action is not None:
            checks.way_back = None
        # Observe the return before reporting the intent. Otherwise "arrived" would still refer to the previous return.
        if fresh and self._returns.observe():
            self._stamp()
        self._report_intent(session)
        applied_ns = self._count_applied(command)
        ladder = self.ladder
        if not (ladder.idle or checks.keeps_failsafe(kind, seen, automatic=automatic)):
            self._events.publish_drafts(*self._apply_failsafe(ladder.fresh_command(), now_ns))
        return applied, applied_ns

    def _take_vehicle(self, session: Session, applied: AnyAction, new: bool) -> None:
        """Attribute the flight to the proxy after an application's new command, or if no one else flies."""
        if type(applied) is Idle or not (new or self.flight.whose is not Whose.OTHERS):
            return
        others = self.flight.others
        self.flight.take()
        self._stamp()
        if others:
            self._events.publish_drafts(taken_event(session.name, applied.name, others))
        if self.on_ownership is not None:
            self.on_ownership(True)

    def _stop_before(self, kind: type[Action], now_ns: int) -> None:
        """Hover after a refused set-point, once the driver accepts it. The previous one must not continue."""
        moves = self._executor.state in (FlightState.FLYING, FlightState.HOVERING)
        if kind in SET_POINTS and moves and self.ladder.idle and not self.ladder.barred:
            self.ladder.hand_over(now_ns)
            self._update_failsafe(now_ns)

    def _stop_motors(self, session: Session, command: Command, now_ns: int) -> tuple[AnyAction, int]:
        """Execute any pilot's emergency stop, even if it comes without a lease, late, or out of sequence."""
        intents, holds = session.intents, self.holds(session, command.lease)
        refusal = intents.check(command, now_ns, self.checks.max_age_ns, self.authority.lease, holds)
        intents.stop(command)
        if session.role is not Role.PILOT:
            return self._refuse_role(session, command), now_ns
        if EmergencyStop not in self._executor.native:
            why = "the vehicle cannot stop its motors"
            return self._refuse(session, command, Refusal.UNSUPPORTED, why), now_ns
        try:
            applied = self._executor.execute(command.action, now_ns)
        except Exception as error:  # noqa: BLE001 it is reported, and the repeats try again
            why = self._publisher.driver_refused("emergency_stop", error)
            return self._refuse(session, command, Refusal.DRIVER_FAILED, why), now_ns
        if refusal is None:
            self.authority.last_command_ns = now_ns  # repeated stops count as signs of life: nothing else is sent
        self._rising_until_ns = None  # only the stop request is sent
        self._end_intents(Fate.EMERGENCY, now_ns)
        self.checks.way_back = None
        self._events.publish_repeated((session.app_id, "emergency"), lambda: emergency_event(session.name))
        return applied, self._count_applied(command)

    def _count_applied(self, command: Command) -> int:
        applied_ns = self._clock()
        self._counts["commands.applied"] += 1
        self._delays_ns.append(applied_ns - command.sent_ns)
        return applied_ns

    def _refuse_role(self, session: Session, command: Command) -> AnyAction:
        if session.role is Role.OBSERVER:
            return self._refuse(session, command, Refusal.OBSERVER, "observers can't command: connect as a pilot")
        return self._refuse(session, command, Refusal.PROTOCOL, "the first packet of a connection must be Hello")

    def _refuse(self, session: Session, command: Command, reason: Refusal, why: str) -> AnyAction:
        self._counts["commands.refused"] += 1
        self._counts[f"commands.refused.{reason.value}"] += 1
        self._events.publish_repeated(
            (session.app_id, reason), lambda: refused_event(session.name, command, reason, why)
        )
        return _NOTHING

    def _refuse_intent(
        self, session: Session, command: Command, intent: Intent, reason: Refusal, why: str, now_ns: int
    ) -> AnyAction:
        """Refuse the holder's intent and end it, so that repeats of the intent get the same answer."""
        intent.refuse(reason, why)
        self._report_intent(session)
        kind, seen = type(command.action), self._executor.seen(now_ns)
        if kind is Takeoff:
            self._withdraw_takeoff(now_ns)
        if self.ladder.continues_landing and not self.checks.keeps_failsafe(kind, seen, automatic=command.automatic):
            drafts = self._apply_failsafe(self.ladder.fresh_command(), now_ns)  # the landing is no longer wanted
            self._events.publish_drafts(*drafts)
            self.ladder.hand_over(now_ns)
        return self._refuse(session, command, reason, why)
