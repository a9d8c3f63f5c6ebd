"""Commands: checked, limited and given to the vehicle on the thread that received them."""

from __future__ import annotations

from typing import Final

from skyloop.clock import Clock
from skyloop.messages import (
    AnyAction,
    Applied,
    Attitude,
    Command,
    EmergencyStop,
    EventKind,
    Failsafe,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    Role,
    Severity,
    Value,
    Velocity,
    encode,
)
from skyloop.proxy.events import EventLog, Notice
from skyloop.proxy.gate import PLANS, Plan, explain, explain_state
from skyloop.proxy.helm import Helm
from skyloop.proxy.limits import Clamp, Limits
from skyloop.proxy.sessions import Session
from skyloop.proxy.statistics import Counters
from skyloop.proxy.vehicle import Vehicle
from skyloop.proxy.watch import REASONS, Watch
from skyloop.proxy.zones import Safety
from skyloop.transport.base import COMMANDS, ServerEnd

#: What an echo says of a command that made the vehicle do nothing new: refused, or held.
_NOTHING: Final = Idle()
_HOVER: Final = Hover()


class Flight:
    """The line from a decoded command to the driver. Every decision is made under the watch's lock."""

    def __init__(
        self,
        watch: Watch,
        helm: Helm,
        vehicle: Vehicle,
        events: EventLog,
        counters: Counters,
        server: ServerEnd,
        clock: Clock,
    ) -> None:
        self.limits = Limits()
        self.safety: Safety | None = None  #: the safety box and zones; None: there are none
        self._blind = False  # they are there and the position is not known
        self.max_age_ns = 0
        self._applied_ns = 0  # when the driver had taken the command at hand; when it came, if that got none
        self._watch = watch
        self._lock = watch.lock
        self._authority = watch.authority
        self._ladder = watch.ladder
        self._helm = helm
        self._vehicle = vehicle
        self._events = events
        self._counts = counters.counts
        self._delays_ns = counters.delays_ns
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._clock = clock

    def command(self, session: Session, command: Command, now_ns: int) -> None:
        """Check a command and apply it, on the thread that received it."""
        with self._lock:
            self._applied_ns = now_ns
            if type(command.action) is EmergencyStop:
                applied = self._stop_motors(session, command, now_ns)
            else:
                applied = self._obey(session, command, now_ns)
            applied_ns = self._applied_ns
        self._counts["commands.received"] += 1
        if self._subscribers(COMMANDS):
            self._echo(command, session.app_id, applied, applied_ns)

    def _obey(self, session: Session, command: Command, now_ns: int) -> AnyAction:
        # Each call of a function costs microseconds on a machine that was idle, and a command comes when it was:
        # what an ordinary command needs stands here in one piece, and the words for what went wrong elsewhere.
        vehicle, authority, track, action = self._vehicle, self._authority, session.track, command.action
        if vehicle.link_breaks != self._watch.breaks_seen:
            self._watch.look_at_link(now_ns)
        holder = authority.holder
        holds = holder is not None and holder.app_id == session.app_id
        refusal = track.receive(command, now_ns, self.max_age_ns, authority.lease, holds)
        if refusal is not None:
            if session.role is not Role.PILOT:
                return self._refuse_role(session, command)
            why = explain(refusal, command, track, now_ns=now_ns, max_age_ns=self.max_age_ns, lease=authority.lease)
            return self._refuse(session, command, refusal, why)
        authority.heard_ns = now_ns
        kind = type(action)
        if kind is Idle:
            self._count_applied(command)
            return _NOTHING
        helm, ladder = self._helm, self._ladder
        state = vehicle.told_state if helm.autopilot is None else helm.state
        plan = PLANS[kind][state]
        if (
            command.intent <= track.floor
            or not vehicle.link_up
            or kind not in helm.supported
            or ladder.barred
            or plan is Plan.HOVER
        ):
            problem = self._problem(session, command, state)
            if problem is not None:
                return self._refuse(session, command, *problem)
        is_set_point = kind is Velocity or kind is Attitude
        if plan is Plan.HOLD and is_set_point and ladder.step is Failsafe.LAND:
            plan = Plan.HOVER  # the ladder's landing, not a pilot's: a pilot who is back breaks it off
        if plan is Plan.REFUSE:
            return self._refuse(session, command, Refusal.WRONG_STATE, explain_state(action, state))
        applied: AnyAction = _NOTHING
        if plan is not Plan.HOLD:
            if plan is Plan.HOVER:
                action = _HOVER
            elif is_set_point:
                feedback = vehicle.feedback_now
                action, clamps = self.limits.clamp(action, feedback.altitude if feedback else None)  # type: ignore[arg-type]
                if self.safety is not None:
                    action, held, known = self.safety.clamp(action, feedback, now_ns)
                    clamps += held
                    if known is self._blind:
                        self._tell_blind(not known)
                if clamps:
                    self._tell_clamps(session, clamps, now_ns)
            try:
                applied = helm.execute(action, now_ns)
            except Exception as error:  # noqa: BLE001  it is told, and the flight goes on
                vehicle.driver_failed("apply", error)
                return self._refuse(session, command, Refusal.DRIVER_FAILED, f"the driver failed: {error!r}")
        self._count_applied(command)
        if not ladder.idle:
            self._watch.fresh_command(now_ns)
        return applied

    def _problem(self, session: Session, command: Command, state: FlightState) -> tuple[Refusal, str] | None:
        """What forbids a command of the holder, whatever its flight state's plan is."""
        kind = type(command.action)
        if not session.track.fresh(command):
            return Refusal.NOT_FRESH, "it repeats what was asked for before a failsafe or a new lease: ask anew"
        if not self._vehicle.link_up:
            return Refusal.VEHICLE_LINK_LOST, f"the link to the vehicle is {self._vehicle.link_state.value}"
        if kind not in self._helm.supported:
            why = self._helm.why_not or "neither the vehicle nor the software autopilot can do it"
            return Refusal.UNSUPPORTED, f"{command.action.name} is not possible: {why}"
        if self._ladder.barred and kind is not Land:
            return Refusal.WRONG_STATE, f"only landing is possible: {REASONS[self._ladder.barred]}"
        if PLANS[kind][state] is Plan.HOVER and Hover not in self._helm.supported:
            return Refusal.UNSUPPORTED, f"{command.action.name} is not possible while {state.value}"
        return None

    def _tell_clamps(self, session: Session, clamps: tuple[Clamp, ...], now_ns: int) -> None:
        self._counts["commands.clamped"] += 1
        for clamp in session.episodes.begun(clamps, now_ns):
            text = f"{session.name}: {clamp.limit} made {clamp.applied:.3g} of {clamp.asked:.3g}"
            data: dict[str, Value] = {"limit": clamp.limit, "asked": clamp.asked, "applied": clamp.applied}
            self._events.tell(EventKind.COMMAND_CLAMPED, text, app=session.name, data=data)

    def _tell_blind(self, blind: bool) -> None:
        self._blind = blind
        text = "the safety box and zones are " + (
            "not enforced: the vehicle's position is not known" if blind else "enforced: its position is known again"
        )
        severity = Severity.WARNING if blind else Severity.INFO
        self._events.tell(EventKind.VEHICLE_MESSAGE, text, severity, data={"reason": "safety", "enforced": not blind})

    def _stop_motors(self, session: Session, command: Command, now_ns: int) -> AnyAction:
        """The emergency stop of any pilot: no lease, no matter how old or out of order."""
        track = session.track
        track.seq, track.intent = max(track.seq, command.seq), max(track.intent, command.intent)
        if session.role is not Role.PILOT:
            return self._refuse_role(session, command)
        if EmergencyStop not in self._helm.native:
            return self._refuse(session, command, Refusal.UNSUPPORTED, "the vehicle cannot stop its motors")
        try:
            applied = self._helm.execute(command.action, now_ns)
        except Exception as error:  # noqa: BLE001  it is told, and the repeats try again
            self._vehicle.driver_failed("emergency_stop", error)
            return self._refuse(session, command, Refusal.DRIVER_FAILED, f"the driver failed: {error!r}")
        self._watch.end_intents()
        text = f"emergency stop by {session.name}"
        data = {"reason": text}
        self._events.repeated(
            (session.app_id, "emergency"),
            lambda: Notice(EventKind.EMERGENCY, text, Severity.ERROR, session.name, dict(data)),
        )
        self._count_applied(command)
        return applied

    def _count_applied(self, command: Command) -> None:
        self._applied_ns = applied_ns = self._clock()
        self._counts["commands.applied"] += 1
        self._delays_ns.append(applied_ns - command.sent_ns)

    def _refuse_role(self, session: Session, command: Command) -> AnyAction:
        if session.role is Role.OBSERVER:
            return self._refuse(session, command, Refusal.OBSERVER, "observers command nothing: connect as a pilot")
        return self._refuse(session, command, Refusal.PROTOCOL, "the first packet on a connection is a Hello request")

    def _refuse(self, session: Session, command: Command, reason: Refusal, why: str) -> AnyAction:
        self._counts["commands.refused"] += 1
        self._counts[f"commands.refused.{reason.value}"] += 1
        self._events.repeated(
            (session.app_id, reason),
            lambda: Notice(
                EventKind.COMMAND_REFUSED,
                f"{session.name}: {command.action.name} refused: {why}",
                app=session.name,
                data={"reason": reason.value, "seq": command.seq},
            ),
        )
        return _NOTHING

    def _echo(self, command: Command, app_id: int, applied: AnyAction, applied_ns: int) -> None:
        echo = Applied(command.seq, command.lease, app_id, command.sent_ns, applied_ns, command.action, applied)
        self._publish(COMMANDS, encode(echo))
