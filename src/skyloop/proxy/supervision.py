"""React to time, links and the authority during a flight. Every decision about the flight is made under one lock.

The lock is also held while the driver is called. The transport's threads deliver commands and requests for the
authority (:mod:`skyloop.proxy.handler`), and the ticker supplies the time. The decisions are pure functions in
:mod:`skyloop.proxy.core`.

Lock order: this lock first, then the publisher's lock, then the lock of the events. Nothing that is called under the
last two locks calls back into this module. A driver publishes what it receives on any thread without this lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from skyloop.clock import Clock, nanoseconds, seconds
from skyloop.messages import (
    Action,
    AnyAction,
    Applied,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Land,
    Refusal,
    ReturnToStart,
    Velocity,
    encode,
)
from skyloop.messages.fields import LATEST_NS
from skyloop.proxy.core.airspace import Clamp
from skyloop.proxy.core.authority import Authority, Granted, Lost, Preempted
from skyloop.proxy.core.authority import Effect as AuthorityEffect
from skyloop.proxy.core.command_checks import CommandChecks, Intent
from skyloop.proxy.core.failsafe import BatteryLow, FailsafeInputs, FailsafeLadder, StepChange
from skyloop.proxy.core.failsafe import Effect as FailsafeEffect
from skyloop.proxy.core.flight import BELIEF_NS, Snapshot, Whose
from skyloop.proxy.events import (
    UNHEARD,
    Counters,
    Episodes,
    EventDraft,
    EventPublisher,
    authority_event,
    battery_event,
    clamped_event,
    drift_event,
    enforcement_event,
    failsafe_event,
    given_up_event,
    name_of,
    ownership_event,
    position_jumped_event,
    slept_event,
)
from skyloop.proxy.executor import ActionExecutor, ReturnSupervisor
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.requests import Session
from skyloop.transport.base import COMMANDS, TransportServer

_LAND: Final = Land()
_NOTICED_M_S: Final = 0.05  #: software autopilot set-points that are reduced by less than this are not reported
#: A sleep of the computer that is shorter than this is ignored: it can't be distinguished from a delay.
SLEEP_NS: Final = nanoseconds(0.25)


class FlightSupervisor:
    """Supervises the authority, failsafe and ownership of one vehicle. Public methods are thread-safe.

    ``sessions``: the connections by application number. They are read here, and only the proxy changes them. ``slept``:
    returns how long the computer has slept in total [ns].
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
        self.on_ownership: Callable[[bool], None] | None = None  #: called under the lock; True if it is the proxy's
        self._returns = ReturnSupervisor(self.checks, self.ladder, executor)
        self._lock = threading.RLock()
        self._executor = executor
        self._publisher = publisher
        self._events = events
        self._counts = counters.counts
        self._delays_ns = counters.delays_ns
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._sessions = sessions
        self._clock = clock
        self._left = False  # the proxy is ending, and makes no more decisions about the flight
        self._pilot = "none"  # "held", or the reason why the authority has no holder
        self._breaks_seen = 0  # number of times that the vehicle link had broken at the last check
        self._heard_ns = -LATEST_NS  # time of the last tick at which the vehicle link was up
        self._slept = slept
        self._slept_seen = slept()  # time the computer had slept in total at the last check
        self._slept_ns, self._awake_ns = 0, -LATEST_NS  # duration of the last sleep, and the time when it ended
        #: Deadline for a take-off that was sent but has had no visible effect yet; None if there is none.
        self._rising_until_ns: int | None = None
        self._drifts = False  # whether the software autopilot drifts, as last reported
        self._enforced = True  # whether safety box and zones could be enforced at the last set-point
        self._episodes = Episodes()  # episodes in which limits reduced actions of the proxy itself, without a pilot
        if executor.autopilot is not None:
            executor.autopilot.guard = self._guard_step
        self._stamp()

    def begin(self, now_ns: int) -> None:
        """Start the run, before the server starts. Silence counts from now on, so that an earlier pilot can return."""
        self.authority.last_command_ns = now_ns

    def tick(self, now_ns: int) -> None:
        """Update authority and failsafe, and step the software autopilot. Call at a steady pace.

        If the driver failed to report who flies the vehicle, its error is raised after everything else is done.
        """
        with self._lock:
            if self._left:
                return
            executor = self._executor
            self._observe_sleep(now_ns)
            self._observe_link(now_ns)
            self._observe_silence(now_ns)
            self._observe_position(now_ns)
            if effects := self.authority.update(now_ns):
                self._apply_authority(effects, now_ns)
            self._update_failsafe(now_ns)
            session = self._holder
            if session is not None:
                self._observe_intent(session, now_ns)
            self._observe_takeoff(now_ns)
            if self._returns.update(executor.seen(now_ns), ours=self.flight.ours):
                self._stamp()
            steered = executor.step(now_ns)
            if steered is not None:
                self._echo_own(steered, now_ns)
                drifts = executor.drifts
                if drifts is not self._drifts:
                    self._drifts = drifts
                    self._events.publish_repeated((0, "drift", drifts), lambda: drift_event(drifts))
            why, executor.autopilot_refusal = executor.autopilot_refusal, ""
            if why and session is not None:
                session.intents.newest.end(Fate.REFUSED, why, Refusal.WRONG_STATE)
                self._report_intent(session)
            error, executor.observe_error = executor.observe_error, None
            if error is not None:
                raise error

    # The vehicle link, and whose flight it is; under the lock -------------------------------------------------------

    def _observe_link(self, now_ns: int) -> None:
        """React to changes of the vehicle link since the last call.

        Intents end when the link breaks, and again when it returns, so that no old command is executed later. A hover
        is sent both times, because a driver must not continue an old set-point. A landing in progress continues.
        """
        breaks = self._publisher.link_breaks
        if breaks == self._breaks_seen:
            return
        self._breaks_seen = breaks
        landing = self._asked(Land)
        if landing is None or (landing.automatic and not landing.begun):
            self._start_over(Fate.LINK, now_ns)
            return
        if landing.begun or self._publisher.link_up:
            self.ladder.continue_landing(now_ns)
        else:
            self.ladder.hand_over(now_ns)
        self._update_failsafe(now_ns)

    def _observe_silence(self, now_ns: int) -> None:
        """Give up a hover or landing after a long silence of the vehicle, because it may be on another flight by then.

        After a landing by the ladder, a vehicle found in the air counts as flown by others at once, because there is
        no pilot to claim it. Otherwise, this is decided when the vehicle answers, because its pilot may be present.
        """
        if self._publisher.link_up:
            self._heard_ns = now_ns
            return
        ladder, asked = self.ladder, self._asked(Hover, Land)
        if asked is None and not ladder.acts:
            return
        asked_ns = ladder.wanted_ns if asked is None else asked.asked_ns  # its pilot may have left
        if now_ns - max(asked_ns, self._heard_ns) < BELIEF_NS:
            return
        lands = ladder.lands or (asked is not None and type(asked.action) is Land)
        if asked is not None:
            self._end_intents(Fate.TIMED_OUT, now_ns, f"{UNHEARD}: command it again", Refusal.VEHICLE_LINK_LOST)
        if ladder.step is not Failsafe.LAND:
            ladder.give_up()
        elif not self.flight.forget():
            return
        if lands or self._executor.airborne:
            self._events.publish_drafts(given_up_event("landing" if lands else "hover"))
        self._update_failsafe(now_ns)

    def _observe_sleep(self, now_ns: int) -> None:
        """Handle the computer having slept, because all data is then older than its timestamp suggests."""
        slept_ns = self._slept() - self._slept_seen
        if slept_ns < SLEEP_NS:
            return
        self._slept_seen += slept_ns
        self._slept_ns, self._awake_ns = slept_ns, now_ns
        self.authority.slept(slept_ns)
        self.flight.slept(slept_ns)
        self._events.publish_drafts(slept_event(seconds(slept_ns)))
        self._start_over(Fate.SLEPT, now_ns)

    def _observe_position(self, now_ns: int) -> None:
        """Update the vehicle's position. Hover if it has jumped, because the request was based on the old position."""
        airspace = self.checks.airspace
        airspace.observe(self._publisher.feedback_now)
        if not airspace.jumped_m:
            return
        if self._executor.supported and self._executor.airborne and self.flight.ours:  # a recording has no pilot
            lands = self._asked(Land) is not None or self.ladder.continues_landing  # a landing is safe anywhere
            event = position_jumped_event(airspace.jumped_m, lands=lands)
            self._events.publish_repeated((0, "jumped"), lambda: event)
            if not lands:
                self._start_over(Fate.JUMPED, now_ns)
        airspace.jumped_m = 0.0

    def _start_over(self, fate: Fate, now_ns: int) -> None:
        """Hover, and end all requests so that none is executed later."""
        self._end_intents(fate, now_ns)
        self.ladder.hand_over(now_ns)
        self._update_failsafe(now_ns)

    def _observe_vehicle(self, now_ns: int) -> Snapshot:
        """Observe the vehicle, and react if its flight has changed hands."""
        executor, flight = self._executor, self.flight
        changed = executor.observe(now_ns)
        if self.on_ownership is not None and not flight.awaited:  # otherwise the note remains as it is
            self.on_ownership(flight.ours)
        if changed is not None:
            self._stamp()
            if changed.whose is Whose.OTHERS:
                executor.stop_autopilot()
                why = f"{flight.others}: hover, take off or land first to take it over"
                self._end_intents(Fate.OTHERS, now_ns, why, Refusal.WRONG_STATE)
            elif changed.why:  # our own flight was found, and its pilot may return: restart the silence
                self.authority.last_command_ns = max(self.authority.last_command_ns, now_ns)
            if changed.why and executor.supported:  # a replay has no pilot who might be surprised
                self._events.publish_drafts(ownership_event(changed))
        return executor.seen(now_ns)

    # Intents ------------------------------------------------------------------------------------------------------

    @property
    def _holder(self) -> Session | None:
        """The connection of the holder of the authority."""
        holder = self.authority.holder
        return None if holder is None else self._sessions.get(holder.app_id)

    def _asked(self, *kinds: type[Action]) -> Intent | None:
        """Return the holder's intent if it is in progress and is of one of these kinds."""
        session = self._holder
        newest = None if session is None else session.intents.newest
        return newest if newest is not None and type(newest.action) in kinds and not newest.over else None

    def _end_intents(self, fate: Fate, now_ns: int, why: str = "", reason: Refusal | None = None) -> None:
        """End all of the holder's requests so far."""
        session = self._holder
        if session is not None:
            session.intents.end(fate, why, reason)
            self._report_intent(session)
        self._withdraw_takeoff(now_ns)

    def _observe_intent(self, session: Session, now_ns: int) -> FlightState:
        """End or complete the holder's intent, based on the vehicle's actions; return the flight state."""
        state, intent = self._executor.state, session.intents.newest
        if not intent.over:
            if state is not intent.state:
                self._observe_vehicle(now_ns)  # others may have landed the vehicle, which ends the intent
            feedback = self._publisher.feedback_now
            intent.observe(state, now_ns, None if feedback is None else feedback.captured_ns)
            if intent.over:
                self._report_intent(session)
                if intent.fate is not Fate.COMPLETED:
                    self._withdraw_takeoff(now_ns)
        if self._rising_until_ns is None:
            return state
        self._observe_takeoff(now_ns)
        return self._executor.state

    def _observe_takeoff(self, now_ns: int) -> None:
        """Withdraw a take-off that is past its deadline, even if a set-point has replaced it."""
        if self._rising_until_ns is not None and not self._executor.stands:
            self._rising_until_ns = None  # the vehicle has left the ground
        elif self._rising_until_ns is not None and now_ns >= self._rising_until_ns:
            self._withdraw_takeoff(now_ns)

    def _withdraw_takeoff(self, now_ns: int) -> bool:
        """Cancel a take-off that has had no visible effect yet. Return whether a take-off was cancelled.

        A landing command sent to a vehicle on the ground cancels an arming that is still in progress.
        """
        until_ns, self._rising_until_ns = self._rising_until_ns, None
        if until_ns is None or not self._executor.stands or self.flight.whose is Whose.OTHERS:
            return False
        if self._executor.attempt(_LAND, now_ns, "apply"):
            self.flight.call_off(now_ns)
        elif self.flight.ours:  # retry while the earlier take-off may still take effect
            self._rising_until_ns = now_ns + nanoseconds(self.ladder.settings.retry_s)
        return True

    def _report_intent(self, session: Session) -> None:
        """Publish the outcome of an application's newest intent in feedback, promptly if it has ended."""
        self._publisher.set_outcome(session.intents.newest, session.app_id, session.name)

    def _echo_own(self, action: AnyAction, now_ns: int) -> None:
        if self._subscribers(COMMANDS):
            echo = Applied(0, self.authority.lease, 0, now_ns, self._clock(), action, action)
            self._publish(COMMANDS, encode(echo))

    def _report_limits(
        self, session: Session | None, clamps: tuple[Clamp, ...], enforced: bool | None, now_ns: int
    ) -> None:
        """Publish the limits that begin to affect this application's commands, or the proxy's own actions."""
        if enforced is not None and enforced is not self._enforced:
            self._enforced = enforced
            self._events.publish_drafts(enforcement_event(enforced))
        episodes, name = (self._episodes, "the proxy") if session is None else (session.episodes, session.name)
        for clamp in episodes.begun(clamps, now_ns):
            self._events.publish_drafts(clamped_event(name, clamp))

    def _guard_step(self, wanted: Velocity, feedback: Feedback, now_ns: int) -> Velocity:
        """Return the velocity nearest to the software autopilot's that limits, safety box and zones allow."""
        allowed, found, _, _, enforced = self.checks.airspace.step(wanted, feedback, now_ns)
        clamps = tuple(clamp for clamp in found if clamp.asked - clamp.applied > _NOTICED_M_S)
        if clamps or (enforced is not None and enforced is not self._enforced):
            self._report_limits(self._holder, clamps, enforced, now_ns)
        assert isinstance(allowed, Velocity)
        return allowed

    # Authority ----------------------------------------------------------------------------------------------------

    def _apply_authority(self, effects: list[AuthorityEffect], now_ns: int, news: Sequence[EventDraft] = ()) -> None:
        """Hover while the authority changes hands. Then publish the events in ``news`` and the changes."""
        for effect in effects:
            if not isinstance(effect, Lost | Preempted | Granted):
                continue
            session = self._sessions.get(effect.app_id)
            if isinstance(effect, Lost):
                self._pilot = effect.reason
                if session is not None and session.intents.lands and self.flight.ours:
                    self.ladder.continue_landing(now_ns)
            elif isinstance(effect, Granted):
                self._pilot = "held"
                self.ladder.hand_over(now_ns)
            if session is not None:
                session.intents.end(Fate.AUTHORITY)
                self._report_intent(session)
                self._withdraw_takeoff(now_ns)
        drafts = self._act(now_ns, stamps=True)  # hover before the changes are published
        holder = self.authority.holder
        changes = [(one, authority_event(one, self._sessions, holder, now_ns)) for one in effects]
        ended = [draft for one, draft in changes if isinstance(one, Lost | Preempted)]
        rest = [draft for one, draft in changes if not isinstance(one, Lost | Preempted)]
        self._events.publish_drafts(*news, *ended, *drafts, *rest)

    def _stamp(self) -> None:
        """Update the holder, the failsafe's step and the flight's owner in the feedback."""
        authority, flight = self.authority, self.flight
        owner = authority.holder or authority.silent
        waiting = authority.waiting
        self._publisher.stamp(
            {
                "owner": name_of(self._sessions, owner.app_id) if owner is not None else None,
                "owner_id": owner.app_id if owner is not None else 0,
                "owner_priority": owner.priority if owner is not None else None,
                "lease": authority.lease,
                "failsafe": self.ladder.step,
                "others": flight.others if flight.whose is Whose.OTHERS else None,
                "start_position_m": self._returns.start,
                "return_phase": self._returns.phase,
                "next_owner": name_of(self._sessions, waiting[0].app_id) if waiting else None,
            }
        )

    # Failsafe -----------------------------------------------------------------------------------------------------

    def _update_failsafe(self, now_ns: int) -> None:
        """Let the ladder decide and act, and publish the results."""
        if drafts := self._act(now_ns):
            self._events.publish_drafts(*drafts)

    def _act(self, now_ns: int, *, stamps: bool = False) -> list[EventDraft]:
        """Let the ladder decide and act. Return the events to publish. ``stamps``: whether the holder has changed."""
        if self._left:
            return []
        ladder, flight = self.ladder, self.flight
        seen = self._observe_vehicle(now_ns)
        # An abandoned flight may be a different one by now, unless the autopilot kept steering or the ladder lands.
        if seen.link_up and ladder.given_up and not ladder.lands and Hover in self._executor.native and flight.forget():
            seen = self._observe_vehicle(now_ns)
        if not seen.link_up and (landing := self._asked(Land)) is not None and landing.begun:
            ladder.continue_landing(now_ns)  # a hover must not interrupt the landing that its pilot requested
        inputs = FailsafeInputs(
            state=seen.state,
            airborne=flight.flies(seen.state),
            last_command_ns=self.authority.last_command_ns,
            pilot=self._pilot,
            link_up=seen.link_up,
            battery=None if seen.feedback is None else seen.feedback.battery,
            ours=flight.whose is Whose.OURS,
            return_problem=self._returns.why_not(seen),
            shown=seen.link_up or Land not in self._executor.native,
        )
        effects = ladder.update(now_ns, inputs)
        return self._apply_failsafe(effects, now_ns, stamps=stamps) if effects or stamps else []

    def _apply_failsafe(self, effects: list[FailsafeEffect], now_ns: int, *, stamps: bool = False) -> list[EventDraft]:
        """Execute the ladder's decisions. Return the events to publish afterwards, because publishing takes time."""
        if stamps or any(isinstance(effect, StepChange) for effect in effects):
            self._stamp()
        drafts = []
        for effect in effects:
            if isinstance(effect, StepChange):
                if effect.step is not Failsafe.NONE:
                    self._end_intents(Fate.FAILSAFE, self._clock())
                drafts.append(failsafe_event(effect))
            elif isinstance(effect, BatteryLow):
                drafts.append(battery_event(effect))
            elif isinstance(effect.action, ReturnToStart):
                self._returns.begin(effect.action, now_ns)
                self.ladder.attempted(True)
            else:
                self.checks.way_back = None
                taken = self._executor.failsafe(effect.action, now_ns)
                self.ladder.attempted(taken)
                if taken:
                    self._echo_own(effect.action, now_ns)
        return drafts
