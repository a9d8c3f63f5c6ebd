"""Manage one application's authority and commands over any connection."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import ContextVar
from typing import Final

from skyloop.client.actions import CommandSchedule
from skyloop.client.authority import AuthorityStatus, AuthorityTracker
from skyloop.client.channels import Emit
from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.monitoring import ChannelCounter
from skyloop.errors import AuthorityError, ClosedError, Hint, LinkError, NoAnswerError, RefusedError, UnsupportedError
from skyloop.messages import (
    ACTION_NAMES,
    AnswerTakeover,
    AnyAction,
    AnyReply,
    Attitude,
    AuthorityGranted,
    AuthorityQueued,
    Capabilities,
    Command,
    EmergencyStop,
    Event,
    EventKind,
    Fate,
    Feedback,
    Hover,
    Idle,
    Land,
    Outcome,
    Position,
    Refusal,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    ResetEmergency,
    ReturnToStart,
    Role,
    Takeoff,
    Velocity,
    encode,
)
from skyloop.messages.command import ENDINGS, SET_POINTS
from skyloop.messages.config import MAX_REASON

ANSWER_S: Final = 2.0  #: time limit for the proxy's reply to an authority request
#: Time for the proxy to notice the end of an earlier session of this process; exceeds the time-out of its lease.
OWN_S: Final = 5.0
_LATER_NS: Final = 1_000_000_000  #: maximum time until the next tick
#: Requests by an application that the library's automatic hover must not end.
LANDING: Final = (Land, EmergencyStop)
_LATER_ACTIONS: Final = (Position, ReturnToStart)  #: older proxies don't know these actions
_REFUSING: Final = (Fate.REFUSED, Fate.OTHERS)  #: outcomes after which the next set-point is most likely refused, too
#: Actions that programs send continuously. Failing to send one of these actions is not an error.
_STREAMED: Final = (Idle, Hover, Velocity, Attitude)

_FLYING: Final = (Takeoff, ResetEmergency, *SET_POINTS)  #: actions not sent once the caller has stopped waiting
#: Whether the caller in the current thread or task has stopped waiting; set for threads that wait on behalf of another.
cancelled: Final[ContextVar[Callable[[], bool]]] = ContextVar("cancelled", default=lambda: False)


class GivenUpError(Exception):
    """Raised when the caller has stopped waiting; the library catches this exception itself."""


class CommandSender:
    """Requests and renews the authority; sends the newest command immediately and then at a steady rate.

    Only this object changes its ``authority``.
    """

    def __init__(
        self,
        role: Role,
        authority: AuthorityTracker,
        schedule: CommandSchedule,
        connection: ProxyConnection,
        scheduler: Scheduler,
        *,
        emit: Emit,
        changed: Callable[[], None],
        granted: Callable[[int], None],
    ) -> None:
        """Prepare for sending; nothing is sent before :meth:`connected` is called.

        ``emit`` receives the events created here. ``changed`` is called when the status of the authority has changed,
        and ``granted`` is called with the number of each new lease. Both run on the thread that noticed the change.
        """
        self.role = role
        self._authority = authority
        self.schedule = schedule  #: the set-point that is repeated; changed only here
        self._connection = connection
        self._clock = scheduler.clock
        self._emit = emit
        self._changed = changed
        self._granted = granted
        self._lock = threading.Lock()  # guards everything below; never held while waiting or calling a callback
        self._seq = 0
        self._connected_ns = 0  # when the current connection was made
        self._ask_now = False
        self._refusal: Refused | None = None
        self._present_until_ns: int | None = None
        self.barred = False  #: whether the flight is ending: only emergency stops and the library's commands are sent
        self._impossible: dict[type, str] = {}  # by type of action: why neither the vehicle nor the proxy supports it
        self.newest_outcome: Outcome | None = None  #: the proxy's newest report on this application's intents
        self._first_set_point = 0  # number of the first intent in this series of set-points; 0: none
        self.notifier = scheduler.notifier()  #: notified when the status of the authority changes
        self.sends = ChannelCounter()  #: counts commands sent, and those not handed to the transport as ``dropped``

    @property
    def status(self) -> AuthorityStatus:
        """The state of this application's authority."""
        return self._authority.status

    @property
    def app_id(self) -> int:
        """Number of this application in this run of its proxy."""
        return self._authority.app_id

    @property
    def intent(self) -> int:
        return self.schedule.intent

    def latest(self, *kinds: type[AnyAction]) -> int:
        """Return the number of the newest intent of the given kinds; 0 if there was none."""
        return max(self.schedule.latest.get(kind, 0) for kind in kinds)

    @property
    def newest(self) -> AnyAction:
        """The action being repeated; ``Idle`` if there is none."""
        return self.schedule.action

    @property
    def wants_flight(self) -> bool:
        """Whether the newest set-point keeps the vehicle in the air or makes it take off."""
        return self.schedule.wants_flight

    def bar(self) -> None:
        """Bar the application's commands except emergency stops; when this returns, none is still being sent."""
        with self._lock:
            self.barred = True

    def flown_by_person(self) -> None:
        """From now on, require a person to be present; see :meth:`present_until`.

        If the connection or lease is lost, only that person can request the authority again, never the library.
        """
        with self._lock:
            self._authority.renews = False
            self._present_until_ns = self._clock()

    def present_until(self, until_ns: int) -> None:
        """Extend the time until which the person flying is known to be present; an earlier time is ignored.

        After that time, nothing is repeated, no new flight is started and the authority is not requested. The proxy
        then considers the pilot absent. Commands that end a flight are still sent once, and emergency stops are always
        sent. The sending thread checks the time itself, so a delay in other threads does not matter.
        """
        with self._lock:
            known_ns = self._present_until_ns
            if known_ns is None or until_ns <= known_ns:
                return
            absent, schedule = known_ns <= self._clock(), self.schedule
            self._present_until_ns, kind = until_ns, type(schedule.action)
            ends = kind is Land or (kind is Hover and not schedule.automatic)  # a person may be waiting for this
            if absent and not ends:  # an old set-point must not take effect again when the person returns
                schedule.clear(Fate.WITHDRAWN)
                if kind in (Velocity, Attitude):
                    schedule.ask(Hover(), self._clock(), automatic=True)
        if absent:
            self._connection.poke()

    def is_present(self, now_ns: int) -> bool:
        """Return whether the person flying is known to be present; always True unless presence is required."""
        return self._present_until_ns is None or now_ns < self._present_until_ns

    # For the application ---------------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, now: bool = False, automatic: bool = False) -> bool:
        """Make ``action``, whose numbers have been checked, the newest set-point; see :class:`skyloop.Drone`.

        With ``now``, raise an error if the command can't be sent immediately; in that case, only a landing is still
        sent later. ``automatic``: whether the library itself requests it; it then takes no vehicle from others and
        ignores :meth:`bar`.

        Raises:
            ClosedError: If the drone is closed, or after :meth:`bar`.
            UnsupportedError: If neither the vehicle nor its proxy supports the action.
            AuthorityError: If another application holds the authority, none was requested, or this application is only
                an observer; with ``now``, also if the request for the authority has not been answered yet.
            RefusedError: If an emergency stop blocks a one-off action, or any action with ``now``.
            LinkError: If the link is down and ``now`` is True.
        """
        intent, sent = self._put(action, now=now, automatic=automatic)
        if not isinstance(action, SET_POINTS):
            # After any other command, a new series of set-points begins, and an earlier refusal no longer applies.
            self._first_set_point = 0
            return sent
        newest = self.newest_outcome
        self._first_set_point = self._first_set_point or intent
        return sent and not (newest is not None and newest.fate in _REFUSING and newest.intent >= self._first_set_point)

    def ask(self, action: AnyAction, *, automatic: bool = False, again: int | None = None) -> int:
        """Make ``action`` the newest set-point like :meth:`command`, and return the number of the intent.

        :meth:`outcome` returns its outcome. ``again`` is the intent that this call repeats under a new number. If
        another command has been given since, nothing is sent and the number stays the same.
        """
        return self._put(action, automatic=automatic, again=again)[0]

    def _put(
        self, action: AnyAction, *, now: bool = False, automatic: bool = False, again: int | None = None
    ) -> tuple[int, bool]:
        """Make ``action`` the newest set-point and send it if possible; return its intent and whether it was sent.

        Nothing can be sent while the link is down or the person flying is absent, nor before the authority is granted
        or an emergency stop confirmed. Raises :class:`GivenUpError` if the caller has stopped waiting
        (:data:`cancelled`).
        """
        connection, schedule, authority = self._connection, self.schedule, self._authority
        if connection.why_closed:
            raise ClosedError(connection.why_closed)
        if why := self._impossible.get(type(action)):
            raise UnsupportedError(f"{action.name} is not possible: {why}")
        now_ns = self._clock()
        stop = type(action) is EmergencyStop
        with self._lock:
            # Nothing changes before schedule.ask(): a call that raises or returns earlier has no effect.
            wanted = not automatic or type(action) is Takeoff  # the caller is still waiting for the take-off
            if self.barred and wanted and not stop:
                raise ClosedError(f"{action.name} comes too late: the end of this flight has begun")
            if wanted and isinstance(action, _FLYING) and cancelled.get()():
                raise GivenUpError  # nothing was sent, and newer commands stay in force
            if again is not None and again != schedule.intent:
                return again, False
            # A hover requested by the library must not end the application's landing or stop.
            if automatic and type(action) is not Land and type(schedule.action) in LANDING:
                return schedule.intent, False
            may_send, connected = authority.status.state == "held" or stop, connection.connected
            if not may_send and connected and not authority.awaited:
                raise self._not_ours(action)
            if stop and self.role is Role.OBSERVER:
                raise self._not_ours(action)
            if not schedule.may_ask(action):
                if now or not isinstance(action, _STREAMED):
                    text = f"{action.name} was not sent: this application's emergency stop is not confirmed yet"
                    raise RefusedError(text, code=Refusal.WRONG_STATE)
                return schedule.intent, False
            intent = schedule.ask(action, now_ns, automatic=automatic)
            # From here on, the set-point is stored: if it can't be sent now, tick() can still send it within 0.5 s.
            absent = self._present_until_ns is not None and now_ns >= self._present_until_ns
            if not may_send or not connected or (absent and isinstance(action, _FLYING)):
                if now:
                    if type(action) is not Land:  # after an error, the command must not be executed later
                        schedule.clear(Fate.WITHDRAWN)
                    raise self._not_now(action)
                return intent, False
            if schedule.due_ns <= now_ns:
                return intent, self._send_next(now_ns)
        connection.poke()  # the last command was too recent; the supervisor's thread sends this one
        return intent, True

    def outcome(self, intent: int) -> Outcome | None:
        """Return the outcome of an intent; None while the intent appears to be in progress."""
        with self._lock:
            if intent != self.schedule.intent:
                return Outcome(self.app_id, intent, Fate.REPLACED, Refusal.NOT_FRESH, ENDINGS[Fate.REPLACED])
            return self.schedule.over

    @property
    def may_ask(self) -> bool:
        """Whether commands can be sent now: a proxy is connected, and this application holds the authority."""
        return self._authority.held and self._connection.connected

    def drop(self) -> None:
        """Clear the set-point to prevent it from being sent later."""
        with self._lock:
            self.schedule.clear(Fate.WITHDRAWN)

    def request(self, request: RequestAuthority, wait_s: float, *, stay: bool = False) -> AuthorityStatus:
        """Request the authority and wait for it; see :meth:`skyloop.Drone.request_authority`.

        Raises:
            AuthorityError: If the authority is refused or not granted in time, or if this application is an observer.
            NoAnswerError: If the proxy does not answer the request, or if the link is lost and not restored in time.
            ClosedError: If the drone is closed during the wait.
        """
        if self.role is Role.OBSERVER:
            raise AuthorityError("this application only observes", code="observer").with_hint(Hint.FLY)
        authority = self._authority
        with self._lock:
            authority.asked(request)
            self._refusal = None
            self._ask_now = True
        self._connection.poke()
        answered = self._wait(lambda: authority.answered, ANSWER_S + max(0.0, wait_s))
        if answered:
            self._wait(lambda: authority.held or not authority.wanted, max(0.0, wait_s))
            self._wait(lambda: authority.settled, OWN_S)
        if self._connection.why_closed:
            raise ClosedError("this drone was closed while it requested the authority")
        if not answered:
            self.release(wait=False)
            raise NoAnswerError(f"the proxy did not answer the request for the authority within {ANSWER_S:g} s")
        status, refusal = self.status, self._refusal
        if status.state == "held" or (stay and status.state in ("queued", "preempted")):
            return status
        self.release(wait=False)
        if refusal is not None:
            raise AuthorityError(f"the authority was refused: {refusal.message}", code=refusal.code.value)
        if status.state == "none":
            raise NoAnswerError("the link was lost, or the authority released, during the request for it")
        raise AuthorityError(_busy(status, wait_s, self._authority.declined), code="busy").with_hint(Hint.OBSERVE)

    def _wait(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        return self.notifier.wait_for(lambda: self._connection.why_closed != "" or ready(), timeout_s)

    def answer(self, lease: int, app_id: int, grant: bool, reason: str, *, wait: bool = False) -> None:
        """Answer an application that requests the authority; a late answer has no effect.

        With ``wait``, return only once the proxy has the answer. Raises :class:`RefusedError` if this application no
        longer holds the authority, and :class:`LinkError` if the link fails.
        """
        answer = AnswerTakeover(lease, app_id, grant, reason[:MAX_REASON])
        if not wait:
            self._connection.ask(answer, lambda _: None, ANSWER_S)
        elif isinstance(reply := self._connection.call(lambda: answer, ANSWER_S), Refused):
            raise RefusedError(reply.message, code=reply.code.value)

    def release(self, *, wait: bool = True) -> None:
        """Clear the set-point, and release the authority or leave the queue if necessary.

        With ``wait``, raises :class:`NoAnswerError` if the proxy does not answer.
        """
        with self._lock:
            known = self._authority.wanted or self.status.state != "none"
            self.schedule.clear(Fate.AUTHORITY)
            changed = self._authority.given_back()
        if known and self._connection.connected:
            if wait:
                self._connection.call(ReleaseAuthority, ANSWER_S)
            else:
                self._connection.ask(ReleaseAuthority(), lambda _: None, ANSWER_S)
        if changed:
            self._notify()

    # For the connection ----------------------------------------------------------------------------------------

    def connected(self, app_id: int, run_id: int = 0, capabilities: Capabilities | None = None) -> None:
        """Reset on a new connection; :meth:`tick` requests the authority again if needed."""
        self._impossible = {} if capabilities is None else impossible(capabilities)
        with self._lock:
            self._authority.connected(app_id, run_id)
            self._seq, self._connected_ns = 0, self._clock()

    def disconnected(self) -> None:
        """Clear the set-point and the authority so that the next connection sends nothing old."""
        with self._lock:
            self.schedule.clear(Fate.LINK)
            self.newest_outcome = None
            changed = self._authority.disconnected()
        if changed:
            self._notify()

    def feedback(self, sample: Feedback, now_ns: int) -> None:
        """Update the authority and the set-point from the vehicle's state."""
        with self._lock:
            before = self.status
            changed = self._authority.feedback(sample, now_ns)
            self.schedule.observe(sample, now_ns, self.app_id)
            if sample.outcome is not None and sample.outcome.app_id == self.app_id:
                self.newest_outcome = sample.outcome
        if changed:
            self._moved(before, now_ns)

    def event(self, event: Event, now_ns: int) -> None:
        with self._lock:
            before = self.status
            changed = self._authority.event(event, now_ns)
        if changed:
            self._moved(before, now_ns)

    def tick(self, now_ns: int) -> int:
        """Send everything that is due; return the latest time of the next call, on this process's clock [ns]."""
        last_request, stalled, unshown, due_ns = None, False, False, now_ns + _LATER_NS
        with self._lock:
            authority, schedule, present = self._authority, self.schedule, self.is_present(now_ns)
            asks = self._ask_now or (authority.status.state == "none" and not authority.pending)
            if authority.wanted and present and asks:
                self._ask_now = False
                last_request = authority.last_request
                authority.asked(last_request)
            stopping = schedule.stopping
            if (authority.held and present) or stopping:
                if schedule.due_ns <= now_ns:
                    before = schedule.action
                    self._send_next(now_ns)
                    stalled = schedule.decayed(before)
                    unshown = stopping and not schedule.stopping
                due_ns = schedule.due_ns
        if last_request is not None:
            self._connection.ask(last_request, self._answered, ANSWER_S)
        if stalled:
            text = "the application made no call for too long, so its set-point decayed to hover"
            self._emit(EventKind.FAILSAFE, text, step="hover", reason="stalled")
        if unshown:
            text = "the emergency stop is no longer sent: the vehicle has not confirmed it, and may still be flying"
            self._emit(EventKind.VEHICLE_MESSAGE, text, reason="stop_given_up")
        return due_ns

    # Inside ----------------------------------------------------------------------------------------------------

    def _send_next(self, now_ns: int) -> bool:
        schedule = self.schedule
        action = schedule.next(now_ns)
        if action is None:
            return False
        first = None if schedule.owed is None else schedule.first(action, now_ns)
        if first is None or self._transmit(first.action, first.intent, first.automatic):
            schedule.owed = None
            if self._transmit(action, schedule.intent, schedule.automatic):
                self.sends.add(0, now_ns, now_ns)
                return True
        self.sends.dropped += 1
        schedule.not_sent(action, now_ns)
        return False

    def _transmit(self, action: AnyAction, intent: int, automatic: bool) -> bool:
        self._seq += 1
        connection = self._connection
        sent_ns = self._clock() + connection.offset_ns
        lease = self._authority.status.lease
        return connection.transmit(encode(Command(self._seq, lease, intent, sent_ns, action, automatic)))

    def _answered(self, answer: AnyReply | LinkError) -> None:
        """Handle the answer to a request for the authority, on the receiving thread."""
        now_ns = self._clock()
        with self._lock:
            before = self.status
            if not self._authority.wanted:
                return  # released since
            if isinstance(answer, AuthorityGranted):
                changed = self._authority.granted(answer.lease, now_ns, answer.until_ns or None)
            elif isinstance(answer, AuthorityQueued):
                changed = self._authority.queued(answer.position, answer.holder, answer.wait_s)
            elif isinstance(answer, Refused):
                self._refusal = answer
                changed = self._authority.given_back()
            else:  # no answer arrived: the next tick repeats the request
                self._authority.pending = False
                changed = False
        if changed:
            self._moved(before, now_ns)
        else:
            self.notifier.notify()

    def _moved(self, before: AuthorityStatus, now_ns: int) -> None:
        """Handle a changed status: clear the set-point if the authority was lost; start sending if it was granted."""
        status = self.status
        with self._lock:
            if status.state == "held" and (before.state, before.lease) != ("held", status.lease):
                self.schedule.resume(now_ns, self._connected_ns)
            elif before.state == "held" and status.state != "held":
                self.schedule.clear(Fate.AUTHORITY)
        if status.state == "held" and status.lease != before.lease:
            self._granted(status.lease)
        self._notify()
        self._connection.poke()

    def _notify(self) -> None:
        self.notifier.notify()
        self._changed()

    def _not_ours(self, action: AnyAction) -> AuthorityError:
        status = self.status
        if self.role is Role.OBSERVER:
            return AuthorityError(f"{action.name}: this application only observes", code="observer").with_hint(Hint.FLY)
        holder = status.holder or "another application"
        why = {
            "preempted": f"{holder} took over the authority; it returns when they release it",
            "queued": f"{holder} holds the authority, and this application waits in the queue",
        }.get(status.state, "call request_authority() first")
        return AuthorityError(f"{action.name}: {why}", code="no_authority")

    def _not_now(self, action: AnyAction) -> LinkError | AuthorityError:
        later = "; it is sent if that changes within half a second" if type(action) is Land else ""
        not_sent = f"{action.name} was not sent"
        if self._authority.held and self._connection.connected:
            return AuthorityError(f"{not_sent}: the person flying is not known to be present", code="no_authority")
        if self._connection.connected:
            text = f"{not_sent}: the proxy has not confirmed the authority yet{later}"
            return AuthorityError(text, code="no_authority")
        state, reason = self._connection.state.value, self._connection.reason
        return LinkError(f"{not_sent}: the link to the proxy is {state}{reason and f' ({reason})'}{later}")


def _busy(status: AuthorityStatus, wait_s: float, declined: str) -> str:
    waited = f" and did not give it back within {wait_s:g} s" if wait_s > 0 else ""
    expected = status.expected_wait_s
    words = f" (number {status.position} in the queue, expected wait {expected:.0f} s)" if expected is not None else ""
    refusal = f"; {declined}" if declined else ""
    return (
        f"{status.holder or 'another application'} holds the authority{waited}{words}{refusal}: wait longer, "
        "or ask with a higher priority (a lower number, 0 is the highest)"
    )


def impossible(capabilities: Capabilities) -> dict[type, str]:
    """Return, by type of action, why neither the vehicle nor its proxy supports it."""
    if not capabilities.actions:
        return dict.fromkeys(ACTION_NAMES, capabilities.why_not or "the vehicle has no commands")
    found: dict[type, str] = {}
    if ACTION_NAMES[EmergencyStop] not in capabilities.actions:
        found[EmergencyStop] = "the vehicle cannot stop its motors"
    for kind in _LATER_ACTIONS:  # older proxies can't even decode these actions
        if ACTION_NAMES[kind] not in capabilities.actions | capabilities.software:
            found[kind] = (
                f"neither the vehicle ({capabilities.vehicle}) nor its proxy can fly to a position; an older "
                "proxy must be updated"
            )
    return found
