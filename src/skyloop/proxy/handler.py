"""The command handler: what applications ask of the vehicle, what the time asks of it, and one lock around both.

Every decision about the flight is made under this lock, for as long as the decision and the driver's call last. The
transport's threads bring commands and requests for the authority, the ticker brings the time, the thread of requests
asks who holds the authority. The decisions themselves are pure, in :mod:`skyloop.proxy.core`.

Lock order: this lock first, then the publisher's, then the events'. Nothing that is called under those two calls back
here; a driver publishes what it receives from any thread without this lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec

from skyloop.clock import NS_PER_S, Clock, nanoseconds, seconds
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
    Feedback,
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
    Velocity,
    encode,
)
from skyloop.messages.command import SET_POINTS
from skyloop.messages.fields import LATEST_NS
from skyloop.proxy.core.authority import Authority, Granted, Lost, Preempted
from skyloop.proxy.core.authority import Effect as AuthorityEffect
from skyloop.proxy.core.command_checks import TAKEOFF_NS, CommandChecks, Intent
from skyloop.proxy.core.failsafe import REASONS, BatteryLow, FailsafeInputs, FailsafeLadder, StepChange
from skyloop.proxy.core.failsafe import Effect as FailsafeEffect
from skyloop.proxy.core.flight import BELIEF_NS, Whose
from skyloop.proxy.core.settings import Clamp, FlightSettings
from skyloop.proxy.events import (
    UNHEARD,
    Counters,
    Episodes,
    EventContext,
    EventDraft,
    EventPublisher,
    authority_event,
    battery_event,
    clamped_event,
    drift_event,
    emergency_event,
    enforcement_event,
    failsafe_event,
    given_up_event,
    ownership_event,
    position_jumped_event,
    refused_event,
    slept_event,
    taken_event,
    thin_zones_event,
)
from skyloop.proxy.executor import ActionExecutor, ReturnSupervisor
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.requests import Session
from skyloop.transport.base import COMMANDS, TransportServer

_LAND: Final = Land()
_LEAVE_A_TAKEOFF: Final = (Takeoff, *SET_POINTS)  #: they leave a take-off that is under way alone; others end it
#: What an echo shows for a command that made the vehicle do nothing new: refused, or held.
_NOTHING: Final = Idle()
#: So much more sleep of the computer than was known is one: shorter ones are not told from a delay.
SLEEP_NS: Final = NS_PER_S // 4
_NOTICED_M_S: Final = 0.05  #: a step of the software autopilot that is shortened by less is not worth telling


class CommandHandler:
    """Authority, commands, failsafe and ownership of one vehicle. Public methods may be called from any thread.

    Args:
        executor: carries actions out; called under the lock only.
        publisher: what the vehicle reported.
        events: where events are published.
        counters: the proxy's counters.
        server: where echoes of commands are published.
        sessions: the connections, by the application's number; read here, changed by the proxy.
        clock: the proxy's clock [ns].
        slept: for how long the computer has slept, in all [ns].
    """

    def __init__(
        self,
        *,
        executor: ActionExecutor,
        publisher: VehiclePublisher,
        events: EventPublisher,
        counters: Counters,
        server: TransportServer,
        sessions: Mapping[int, Session],
        clock: Clock,
        slept: Clock,
    ) -> None:
        self.authority = Authority()
        self.ladder = FailsafeLadder()
        self.flight = executor.flight
        self.checks = CommandChecks(
            self.authority,
            self.ladder,
            self.flight,
            supported=executor.supported,
            why_not=executor.why_not,
            native=executor.native,
        )
        self._back = ReturnSupervisor(self.checks, self.ladder, executor, publisher)
        self.on_ownership: Callable[[bool], None] = lambda _: None  #: called with whether the flight is ours, locked
        if executor.autopilot is not None:
            executor.autopilot.guard = self._guard_step
        self._lock = threading.RLock()
        self._executor = executor
        self._vehicle = publisher
        self._events = events
        self._counts = counters.counts
        self._delays_ns = counters.delays_ns
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._sessions = sessions
        self._clock = clock
        self._left = False  # the proxy ends: nothing flies by a decision of it any more
        self._pilot = "none"  # why nobody holds the authority, or "held"
        self._breaks_seen = 0  # of the vehicle's link, when last looked at
        self._heard_ns = -LATEST_NS  # when the vehicle was heard last, as far as a tick noticed
        self._slept = slept
        self._slept_seen = slept()  # when last looked at, or noticed
        self._slept_ns, self._awake_ns = 0, -LATEST_NS  # for how long it slept last, and since when it is awake
        #: Until when a take-off that the vehicle was told of, and does not show yet, has time to; None: there is none.
        self._rising_until_ns: int | None = None
        self._drifts = False  # what the software autopilot flies; told last
        self._enforced = True  # whether the safety box and zones could be, at the last set-point
        self._episodes = Episodes()  # of limits that touch what the proxy does with nobody in command
        self._stamp()

    # From the proxy: what decides takes the lock -----------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        """Begin the run, before the server starts. A flight of an earlier run waits for its pilot."""
        self.authority.last_command_ns = now_ns

    def configure(self, settings: FlightSettings) -> None:
        """Let new values of the parameters take effect. Unchanged settings are the same object as before."""
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

    def aged(self, command: Command, now_ns: int) -> Command:
        """Return a command as old as it is: one from before the computer slept looks as if it had just been sent."""
        if self._slept() - self._slept_seen >= SLEEP_NS:
            with self._lock:
                self._observe_sleep(now_ns)
        if command.sent_ns >= self._awake_ns:
            return command
        return msgspec.structs.replace(command, sent_ns=command.sent_ns - self._slept_ns)

    def problem_with_ceiling(self, altitude: float) -> str:
        """Return why ``limits.altitude`` must not be lowered to this height [m] now, for a person; empty if it may."""
        with self._lock:
            flies = self._executor.airborne
            return self.checks.airspace.ceiling_problem(altitude, self._vehicle.feedback_now) if flies else ""

    def problem_with_moment(self) -> str:
        """Return why the vehicle must not do something once now, such as a flip, for a person; empty if it may."""
        with self._lock:
            ladder, others = self.ladder, self.flight.others
            if ladder.barred == "closing" or (ladder.barred and self._executor.airborne):
                return f"only landing is possible: {REASONS[ladder.barred]}"
            if ladder.step is not Failsafe.NONE:
                return (
                    f"a failsafe has the vehicle, because {REASONS.get(ladder.reason, ladder.reason)}: command it first"
                )
            return f"{others}: hover, take off or land first to take it over" if others else ""

    def command(self, session: Session, command: Command, now_ns: int) -> None:
        """Check a command and carry it out, on the thread that received it."""
        with self._lock:
            if type(command.action) is EmergencyStop:
                applied, applied_ns = self._stop_motors(session, command, now_ns)
            else:
                applied, applied_ns = self._obey(session, command, now_ns)
        self._counts["commands.received"] += 1
        if self._subscribers(COMMANDS):
            sent_ns = max(-LATEST_NS, min(command.sent_ns, LATEST_NS))  # others' counters take no more than that
            action, app_id = command.action, session.app_id
            echo = Applied(command.seq, command.lease, app_id, sent_ns, applied_ns, action, applied)
            self._publish(COMMANDS, encode(echo))

    def request_authority(self, session: Session, request: RequestAuthority, now_ns: int) -> AnyReply:
        """Give the authority, or a position in the queue, or return who holds it."""
        if session.role is not Role.PILOT:
            return Refused(Refusal.OBSERVER, "observers get no authority: connect as a pilot")
        term_ns = None if request.for_s is None else nanoseconds(request.for_s)
        ask = request.takeover is Takeover.ASK
        app_id, authority = session.app_id, self.authority
        with self._lock:
            effects = authority.request(app_id, request.priority, request.queue, now_ns, term_ns=term_ns, ask=ask)
            self._apply_authority(effects, now_ns)
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
        """Let the holder grant or decline what it was asked for."""
        with self._lock:
            if not self.holds(session, answer.lease):
                return Refused(Refusal.FOREIGN_LEASE, "only the holder can answer, under its own lease")
            effects = self.authority.answer(
                session.app_id, answer.lease, answer.app_id, answer.grant, answer.reason, now_ns
            )
            self._apply_authority(effects, now_ns)
        return Done()

    def release_authority(self, session: Session, _request: ReleaseAuthority, now_ns: int) -> AnyReply:
        """Take the authority back from an application, or remove it from the queue."""
        with self._lock:
            self._apply_authority(self.authority.release(session.app_id, now_ns), now_ns)
        return Done()

    def application_left(self, session: Session, now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """An application's connection ended; it must still be among the sessions. ``news``: told once it hovers."""
        with self._lock:
            self._apply_authority(self.authority.gone(session.app_id, now_ns), now_ns, news)

    def holds(self, session: Session, lease: int) -> bool:
        """Return whether the application holds the authority under this lease."""
        with self._lock:
            holder = self.authority.holder
            return holder is not None and holder.app_id == session.app_id and lease == self.authority.lease

    def tick(self, now_ns: int) -> None:
        """Update authority and failsafe, and let the software autopilot steer. Call at a steady pace.

        Raises:
            Exception: What the driver raised when it was asked who flies the vehicle, when all else is done.
        """
        with self._lock:
            if self._left:
                return
            self._observe_sleep(now_ns)
            self._observe_link(now_ns)
            self._observe_silence(now_ns)
            self._observe_position(now_ns)
            effects = self.authority.update(now_ns)
            if effects:
                self._apply_authority(effects, now_ns)
            self._update_failsafe(now_ns)
            holder = self.authority.holder
            session = self._sessions.get(holder.app_id) if holder is not None else None
            if session is not None:
                self._observe_intent(session, now_ns)
            self._observe_takeoff(now_ns)
            if self._back.update(now_ns, ours=self.flight.ours):
                self._stamp()
            steered = self._executor.step(now_ns)
            if steered is not None:
                self._echo_own(steered, now_ns)
                self._report_drift()
            why, self._executor.gave_up = self._executor.gave_up, ""
            if why and session is not None:
                session.intents.newest.end(Fate.REFUSED, why, Refusal.WRONG_STATE)
                self._tell(session, session.intents.newest)
            error, self._executor.unsaid = self._executor.unsaid, None
            if error is not None:
                raise error

    def order_landing(self, now_ns: int) -> bool:
        """Land because the proxy is about to end; from now on only landing and emergency stop are accepted.

        Returns:
            Whether anything of the proxy's flies, or may be about to.
        """
        with self._lock:
            self.ladder.order_landing()
            self._update_failsafe(now_ns)
            if self.flight.ours and self.flight.may_begin(now_ns):
                self._rising_until_ns = now_ns  # again and again: nobody withdraws it later
            self._withdraw_takeoff(now_ns)
            return self.airborne

    def leave_hovering(self, now_ns: int) -> None:
        """The proxy ends now: leave what flies hovering, as far as the vehicle can by itself."""
        with self._lock:
            self.ladder.order_landing()
            try:
                self._observe_flight(now_ns)
                executor, withdrew = self._executor, self._withdraw_takeoff(now_ns)
                lands = executor.state is FlightState.LANDING and (Land in executor.native or not withdrew)
                if self.flight.ours and executor.airborne and not lands:
                    executor.leave(now_ns)
            finally:
                self._left = True

    @property
    def airborne(self) -> bool:
        """Whether the vehicle flies, or may, or may be about to, and is the proxy's to land. Takes no lock."""
        return self.flight.ours and (self._executor.airborne or self.flight.may_begin(self._clock()))

    @property
    def at_rest(self) -> bool:
        """Whether nothing flies, nobody is in command and nothing is to be done. Takes no lock."""
        return (
            self.authority.holder is None
            and self.ladder.idle
            and not self.flight.ours
            and self._vehicle.link_breaks == self._breaks_seen
            and not self._executor.airborne
        )

    # Commands: all below is called under the lock ----------------------------------------------------------------

    def _obey(self, session: Session, command: Command, now_ns: int) -> tuple[AnyAction, int]:
        """Return what was applied, and when: the time of receipt for a command that was refused."""
        # Each call of a function costs microseconds on a machine that was idle, and a command comes when it was: an
        # ordinary command is received, decided and executed here; what went wrong is put into words elsewhere.
        vehicle, checks, flight = self._vehicle, self.checks, self.flight
        if vehicle.link_breaks != self._breaks_seen:
            self._observe_link(now_ns)
        if not flight.ours:
            self._observe_flight(now_ns)
        intents = session.intents
        state = self._observe_intent(session, now_ns)  # what ends intents before this one came does not end this one
        refusal = checks.receive(command, intents, session.app_id, now_ns)
        if refusal is not None:
            if session.role is not Role.PILOT:
                return self._refuse_role(session, command), now_ns
            return self._refuse(session, command, refusal, checks.explain(refusal, command, intents, now_ns)), now_ns
        action = command.action
        kind = type(action)
        intent, new = intents.receive(command, state, now_ns)
        if kind not in _LEAVE_A_TAKEOFF:
            if self._withdraw_takeoff(now_ns):
                intent.withdrew = kind is Land
                if kind is Hover:  # it stands, and stays so
                    intent.end(Fate.COMPLETED if new else Fate.WITHDRAWN)
            state = self._executor.state
        if kind is Idle:
            if type(intents.newest.action) is Takeoff:
                intents.newest.end(Fate.WITHDRAWN)
            self._tell(session, intents.newest)
            return _NOTHING, self._count_applied(command)
        if intent.over:
            self._tell(session, intents.newest)
            if intent.reason is None:  # it was done
                return _NOTHING, self._count_applied(command)
            return self._refuse(session, command, intent.reason, intent.text), now_ns
        intent.action = action  # a set-point may have decayed to hover
        known, automatic, fresh = vehicle.feedback_now, command.automatic, new
        new = new and not automatic  # what the library does by itself is nobody's decision
        decision = checks.decide(action, intent, state, vehicle.link_state, known, now_ns, new=new, automatic=automatic)
        if decision.refusal is not None:
            if decision.action is None or not self._stop_instead(decision.action, now_ns):
                self._stop_before(kind, now_ns)
            return self._refuse_intent(session, command, intent, decision.refusal, decision.why, now_ns), now_ns
        applied: AnyAction = _NOTHING
        if decision.action is not None:
            if decision.clamps or (decision.enforced is not None and decision.enforced is not self._enforced):
                self._report_limits(session, decision.clamps, decision.enforced, now_ns)
                if decision.clamps:
                    self._counts["commands.clamped"] += 1
            try:
                begins = new or (fresh and decision.takes_off)  # also one that a waiting call asks for again
                applied = self._executor.execute(decision.action, now_ns, new=begins)
            except RefusedError as error:
                self._stop_before(kind, now_ns)
                return self._refuse_intent(session, command, intent, Refusal.WRONG_STATE, str(error), now_ns), now_ns
            except Exception as error:  # noqa: BLE001  it is reported, and the flight goes on
                why = vehicle.driver_refused("apply", error)
                self._stop_before(kind, now_ns)
                return self._refuse_intent(session, command, intent, Refusal.DRIVER_FAILED, why, now_ns), now_ns
            intent.begun = True
            if decision.takes_off:
                flight.claim(now_ns)
                self._rising_until_ns = intent.asked_ns + TAKEOFF_NS
            if not flight.ours or kind is Takeoff:
                self._take_vehicle(session, applied, new)
        intent.reason, intent.text = None, ""
        if kind is not ReturnToStart and decision.action is not None:
            checks.back = None
        # Before feedback tells of this intent: beside it, "arrived" would be of the return before this one.
        if fresh and self._back.observe():
            self._stamp()
        self._tell(session, intent)
        applied_ns = self._count_applied(command)
        ladder = self.ladder
        if command.automatic:
            goes_on = ladder.lands_on or ladder.step is Failsafe.LAND
        elif kind is Land:
            goes_on = ladder.lands_on
        else:
            asked_anew = ladder.given_up or vehicle.link_up
            goes_on = ladder.step is Failsafe.HOVER and kind is Hover and not asked_anew
        if not (goes_on or ladder.idle):
            self._apply_failsafe(self.ladder.fresh_command(), now_ns)
        return applied, applied_ns

    def _stop_instead(self, action: AnyAction, now_ns: int) -> bool:
        """Do what a refusal leaves to be done: what was asked for before must not go on. Return whether it is done."""
        try:
            self._executor.execute(action, now_ns, new=False)
        except Exception as error:  # noqa: BLE001  both the error and the refusal are published
            self._vehicle.driver_failed("apply", error)
            return False
        return True

    def _stop_before(self, kind: type[Action], now_ns: int) -> None:
        """Hover where a set-point is refused, as soon as the driver does: what it took the place of must not go on."""
        moves = self._executor.state in (FlightState.FLYING, FlightState.HOVERING)
        if kind in SET_POINTS and moves and self.ladder.idle and not self.ladder.barred:
            self.ladder.hand_over(now_ns)
            self._update_failsafe(now_ns)

    def _stop_motors(self, session: Session, command: Command, now_ns: int) -> tuple[AnyAction, int]:
        """Carry out the emergency stop of any pilot: without a lease, however old or out of sequence."""
        in_time = command.seq > session.intents.seq and now_ns - command.sent_ns <= self.checks.max_age_ns
        session.intents.stop(command)
        if session.role is not Role.PILOT:
            return self._refuse_role(session, command), now_ns
        if EmergencyStop not in self._executor.native:
            why = "the vehicle cannot stop its motors"
            return self._refuse(session, command, Refusal.UNSUPPORTED, why), now_ns
        try:
            applied = self._executor.execute(command.action, now_ns)
        except Exception as error:  # noqa: BLE001  it is reported, and the repeats try again
            why = self._vehicle.driver_refused("emergency_stop", error)
            return self._refuse(session, command, Refusal.DRIVER_FAILED, why), now_ns
        if in_time and self.holds(session, command.lease):
            self.authority.last_command_ns = now_ns  # its repeats are a sign of life: nothing else is sent meanwhile
        self._rising_until_ns = None  # nothing but the stop is sent
        self._end_intents(Fate.EMERGENCY, now_ns)
        self.checks.back = None
        self._events.publish_repeated((session.app_id, "emergency"), lambda: emergency_event(session.name))
        return applied, self._count_applied(command)

    def _count_applied(self, command: Command) -> int:
        applied_ns = self._clock()
        self._counts["commands.applied"] += 1
        self._delays_ns.append(applied_ns - command.sent_ns)
        return applied_ns

    def _report_limits(
        self, session: Session | None, clamps: tuple[Clamp, ...], enforced: bool | None, now_ns: int
    ) -> None:
        """Publish what began to be in the way of a command of this application, or of what the proxy does itself."""
        if enforced is not None and enforced is not self._enforced:
            self._enforced = enforced
            self._events.publish_drafts(enforcement_event(enforced))
        episodes, name = (self._episodes, "the proxy") if session is None else (session.episodes, session.name)
        for clamp in episodes.begun(clamps, now_ns):
            self._events.publish_drafts(clamped_event(name, clamp))

    def _guard_step(self, wanted: Velocity, feedback: Feedback, now_ns: int) -> Velocity:
        """Return the nearest velocity that limits, safety box and zones allow in a step of the software autopilot."""
        allowed, found, _, _, enforced = self.checks.airspace.step(wanted, feedback, now_ns)
        clamps = tuple(clamp for clamp in found if clamp.asked - clamp.applied > _NOTICED_M_S)
        if clamps or (enforced is not None and enforced is not self._enforced):
            holder = self.authority.holder
            self._report_limits(None if holder is None else self._sessions.get(holder.app_id), clamps, enforced, now_ns)
        assert isinstance(allowed, Velocity)
        return allowed

    def _report_drift(self) -> None:
        """Tell when what the software autopilot flies begins, or ceases, to drift."""
        autopilot = self._executor.autopilot
        if autopilot is not None and autopilot.drifts is not self._drifts:
            self._drifts = drifts = autopilot.drifts
            self._events.publish_repeated((0, "drift", drifts), lambda: drift_event(drifts))

    def _refuse_role(self, session: Session, command: Command) -> AnyAction:
        if session.role is Role.OBSERVER:
            return self._refuse(session, command, Refusal.OBSERVER, "observers command nothing: connect as a pilot")
        return self._refuse(session, command, Refusal.PROTOCOL, "the first packet on a connection is a Hello request")

    def _refuse(self, session: Session, command: Command, reason: Refusal, why: str) -> AnyAction:
        self._counts["commands.refused"] += 1
        self._counts[f"commands.refused.{reason.value}"] += 1
        self._events.publish_repeated(
            (session.app_id, reason), lambda: refused_event(session.name, command, reason, why)
        )
        return _NOTHING

    # Intents -----------------------------------------------------------------------------------------------------

    def _refuse_intent(
        self, session: Session, command: Command, intent: Intent, reason: Refusal, why: str, now_ns: int
    ) -> AnyAction:
        """Refuse what the holder asked for, which is over with it: its repeats get the same answer."""
        intent.refuse(reason, why)
        self._tell(session, intent)
        if type(command.action) is Takeoff:
            self._withdraw_takeoff(now_ns)
        if self.ladder.lands_on and type(command.action) is not Land and not command.automatic:
            self._apply_failsafe(self.ladder.fresh_command(), now_ns)  # the landing is not wanted any more
            self.ladder.hand_over(now_ns)
        return self._refuse(session, command, reason, why)

    def _end_intents(self, fate: Fate, now_ns: int, why: str = "", reason: Refusal | None = None) -> None:
        """End what the holder asked for until now."""
        holder = self.authority.holder
        session = self._sessions.get(holder.app_id) if holder is not None else None
        if session is not None:
            session.intents.end(fate, why, reason)
            self._tell(session, session.intents.newest)
        self._withdraw_takeoff(now_ns)

    def _observe_intent(self, session: Session, now_ns: int) -> FlightState:
        """End, or complete, what a holder asked for by what the vehicle does; return the flight state."""
        state, intent = self._executor.state, session.intents.newest
        if not intent.over:
            if state is not intent.state:
                self._observe_flight(now_ns)  # a landing may be others': then that is what ended it
            feedback = self._vehicle.feedback_now
            intent.observe(state, now_ns, None if feedback is None else feedback.captured_ns)
            if intent.over:
                self._tell(session, intent)
                if intent.fate is not Fate.COMPLETED:
                    self._withdraw_takeoff(now_ns)
        if self._rising_until_ns is None:
            return state
        self._observe_takeoff(now_ns)
        return self._executor.state

    def _observe_takeoff(self, now_ns: int) -> None:
        """Withdraw a take-off that has had its time, although a set-point may have taken its place meanwhile."""
        if self._rising_until_ns is not None and not self._executor.stands:
            self._rising_until_ns = None  # it has left the ground
        elif self._rising_until_ns is not None and now_ns >= self._rising_until_ns:
            self._withdraw_takeoff(now_ns)

    def _withdraw_takeoff(self, now_ns: int) -> bool:
        """Make the vehicle forget a take-off that it has not begun to show; return whether there was one."""
        until_ns, self._rising_until_ns = self._rising_until_ns, None
        if until_ns is None or not self._executor.stands or self.flight.whose is Whose.OTHERS:
            return False
        if self._stop_instead(_LAND, now_ns):
            self.flight.call_off(now_ns)
        elif self.flight.ours:  # once more, while that take-off may show
            self._rising_until_ns = now_ns + nanoseconds(self.ladder.settings.retry_s)
        return True

    def _tell(self, session: Session, intent: Intent) -> None:
        """Let feedback tell what became of an intent: soon where it ended."""
        self._vehicle.tell(intent, session.app_id, session.name)

    def _echo_own(self, action: AnyAction, now_ns: int) -> None:
        """Publish what the proxy itself made the vehicle do."""
        if self._subscribers(COMMANDS):
            echo = Applied(0, self.authority.lease, 0, now_ns, self._clock(), action, action)
            self._publish(COMMANDS, encode(echo))

    # Authority ---------------------------------------------------------------------------------------------------

    def _apply_authority(self, effects: list[AuthorityEffect], now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """Make the vehicle hover where the authority changes hands, then publish ``news`` and the changes."""
        for effect in effects:
            if isinstance(effect, Lost):
                self._pilot = effect.reason
                if self.flight.ours and (session := self._sessions.get(effect.app_id)) and session.intents.lands:
                    self.ladder.land_on(now_ns)
            elif isinstance(effect, Granted):
                self._pilot = "held"
                self.ladder.hand_over(now_ns)
            if isinstance(effect, (Lost, Preempted, Granted)) and (session := self._sessions.get(effect.app_id)):
                session.intents.end(Fate.AUTHORITY)
                self._tell(session, session.intents.newest)
                self._withdraw_takeoff(now_ns)
        self._stamp()
        ended = [self._authority_draft(one, now_ns) for one in effects if isinstance(one, (Lost, Preempted))]
        self._update_failsafe(now_ns, [*news, *ended])  # which hovers, before anybody learns of any of this
        for effect in effects:
            if not isinstance(effect, (Lost, Preempted)):
                self._events.publish_drafts(self._authority_draft(effect, now_ns))

    def _authority_draft(self, effect: AuthorityEffect, now_ns: int) -> EventDraft:
        holder = self.authority.holder
        holder_name = "" if holder is None else self._name(holder.app_id)
        return authority_event(effect, EventContext(now_ns, self._name, self._identity, holder_name))

    def _identity(self, app_id: int) -> str:
        """What the transport knows about an application."""
        session = self._sessions.get(app_id)
        return "" if session is None else session.peer.address

    def _name(self, app_id: int) -> str:
        session = self._sessions.get(app_id)
        return session.name if session is not None else f"application {app_id}"

    def _stamp(self) -> None:
        """Let feedback show who is in command, the failsafe's step and whose the flight is."""
        owner = self.authority.owner
        self._vehicle.stamp(
            {
                "owner": self._name(owner.app_id) if owner is not None else None,
                "owner_id": owner.app_id if owner is not None else 0,
                "owner_priority": owner.priority if owner is not None else None,
                "lease": self.authority.lease,
                "failsafe": self.ladder.step,
                "others": self.flight.others or None,
                "start_position_m": self._back.start,
                "return_phase": self._back.phase,
            }
        )

    # The vehicle's link, and whose the flight is -----------------------------------------------------------------

    def _observe_link(self, now_ns: int) -> None:
        """Act on what happened to the vehicle's link since it was last observed.

        Intents end when it breaks and when it is back, so that nothing asked for in between is done later. Hover is
        given both times: a driver must not go on with an old set-point. A pilot's landing lasts, as nothing is safer.
        """
        breaks = self._vehicle.link_breaks
        if breaks == self._breaks_seen:
            return
        self._breaks_seen = breaks
        landing = self._landing
        if landing is None or (landing.automatic and not landing.begun):
            self._start_over(Fate.LINK, now_ns)
            return
        if landing.begun or self._vehicle.link_up:
            self.ladder.land_on(now_ns)
        else:
            self.ladder.hand_over(now_ns)
        self._update_failsafe(now_ns)

    def _observe_silence(self, now_ns: int) -> None:
        """Give up a hover or landing when the vehicle has not been heard for long: by then it may be on another flight.

        A landing that the ladder ordered leaves what is found in the air to others at once: nobody is there to say
        whose it is. After all else that is given up it does so when the vehicle is heard, as its pilot may be there.
        """
        if self._vehicle.link_up:
            self._heard_ns = now_ns
            return
        ladder, asked = self.ladder, self._asked(Hover, Land)
        if asked is None and not ladder.acts:
            return
        asked_ns = ladder.wanted_ns if asked is None else asked.asked_ns  # its pilot may have left
        if now_ns - max(asked_ns, self._heard_ns) < BELIEF_NS:
            return
        what = "landing" if ladder.lands or self._landing is not None else "hover"
        if asked is not None:
            self._end_intents(Fate.TIMED_OUT, now_ns, f"{UNHEARD}: ask for it again", Refusal.VEHICLE_LINK_LOST)
        if ladder.step is not Failsafe.LAND:
            ladder.give_up()
        elif not self.flight.forget():
            return
        self._events.publish_drafts(given_up_event(what))
        self._update_failsafe(now_ns)

    def _observe_sleep(self, now_ns: int) -> None:
        """Act on a sleep of the computer: all that is known is older than its clock says."""
        slept_ns = self._slept() - self._slept_seen
        if slept_ns < SLEEP_NS:
            return
        self._slept_seen += slept_ns
        self._slept_ns, self._awake_ns = slept_ns, now_ns
        self.authority.slept(slept_ns)
        self.flight.slept(slept_ns)
        self._events.publish_drafts(slept_event(seconds(slept_ns)))
        self._start_over(Fate.SLEPT, now_ns)

    def _start_over(self, fate: Fate, now_ns: int) -> None:
        """Hover, and let nothing that was asked for until now be done later."""
        self._end_intents(fate, now_ns)
        self.ladder.hand_over(now_ns)
        self._update_failsafe(now_ns)

    def _observe_position(self, now_ns: int) -> None:
        """Note where the vehicle is, and hover where that jumped: what was asked for meant another place."""
        airspace = self.checks.airspace
        airspace.observe(self._vehicle.feedback_now)
        if not airspace.jumped_m:
            return
        if self._executor.supported and self._executor.airborne and self.flight.ours:  # nobody flies a recording
            lands = self._landing is not None or self.ladder.lands_on  # wherever it is
            event = position_jumped_event(airspace.jumped_m, lands=lands)
            self._events.publish_repeated((0, "jumped"), lambda: event)
            if not lands:
                self._start_over(Fate.JUMPED, now_ns)
        airspace.jumped_m = 0.0

    def _asked(self, *kinds: type[Action]) -> Intent | None:
        """What the holder asks for, where that is of one of these kinds and under way."""
        holder = self.authority.holder
        session = self._sessions.get(holder.app_id) if holder is not None else None
        newest = None if session is None else session.intents.newest
        return newest if newest is not None and type(newest.action) in kinds and not newest.over else None

    @property
    def _landing(self) -> Intent | None:
        """Its pilot's landing, where the vehicle is, that is under way."""
        return self._asked(Land)

    def _take_vehicle(self, session: Session, applied: AnyAction, new: bool) -> None:
        """Make the flight ours if an application's new command was carried out, or nobody else's flight goes on."""
        if type(applied) is Idle or not (new or self.flight.whose is not Whose.OTHERS):
            return
        others = self.flight.others
        self.flight.take()
        self._stamp()
        if others:
            self._events.publish_drafts(taken_event(session.name, applied.name, others))
        self.on_ownership(True)

    def _observe_flight(self, now_ns: int) -> None:
        """Observe whose flight it is by now, and act on a change."""
        executor = self._executor
        changed = executor.observe(now_ns)
        if not self.flight.awaited:  # else the note of it stays as it is
            self.on_ownership(self.flight.ours)
        if changed is None:
            return
        self._stamp()
        if changed.whose is Whose.OTHERS:
            executor.stop_autopilot()
            why = f"{self.flight.others}: hover, take off or land first to take it over"
            self._end_intents(Fate.OTHERS, now_ns, why, Refusal.WRONG_STATE)
        elif changed.why:  # found on a flight that is ours: its pilot may come back, as if a command had just come
            self.authority.last_command_ns = max(self.authority.last_command_ns, now_ns)
        if changed.why and executor.supported:  # a recording that is played flies by itself, and nobody wonders
            self._events.publish_drafts(ownership_event(changed))

    # Failsafe ----------------------------------------------------------------------------------------------------

    def _update_failsafe(self, now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """Let the ladder decide and act; ``news``: to be published then, before its own."""
        if self._left:
            self._events.publish_drafts(*news)
            return
        vehicle, link_up = self._vehicle, self._vehicle.link_up
        if link_up and self.ladder.given_up:
            self.flight.forget()
        self._observe_flight(now_ns)
        feedback, state = vehicle.feedback_now, self._executor.state
        landing = None if link_up else self._landing
        if landing is not None and landing.begun:
            self.ladder.land_on(now_ns)  # no hover takes its pilot's landing back
        inputs = FailsafeInputs(
            state=state,
            airborne=self.flight.flies(state),
            last_command_ns=self.authority.last_command_ns,
            pilot=self._pilot,
            link_up=link_up,
            battery=feedback.battery if feedback is not None else None,
            ours=self.flight.ours,
            return_problem=self._back.why_not(now_ns),
            shown=link_up or Land not in self._executor.native,
        )
        effects = self.ladder.update(now_ns, inputs)
        if effects or news:
            self._apply_failsafe(effects, now_ns, news)

    def _apply_failsafe(self, effects: list[FailsafeEffect], now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """Act first, as each event takes its time, and publish then."""
        drafts = [*news]
        try:
            for effect in effects:
                if isinstance(effect, StepChange):
                    self._stamp()
                    if effect.step is not Failsafe.NONE:
                        self._end_intents(Fate.FAILSAFE, self._clock())
                    drafts.append(failsafe_event(effect))
                elif isinstance(effect, BatteryLow):
                    drafts.append(battery_event(effect))
                elif isinstance(effect.action, ReturnToStart):
                    self._back.begin(effect.action, now_ns)
                    self.ladder.attempted(True)
                else:
                    self.checks.back = None
                    taken = self._executor.failsafe(effect.action, now_ns)
                    self.ladder.attempted(taken)
                    if taken:
                        self._echo_own(effect.action, now_ns)
        finally:
            self._events.publish_drafts(*drafts)
