"""The application's hands on the vehicle: authority and commands, over whatever connection there is."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

from skyloop.client.authority import Authority, AuthorityStatus
from skyloop.client.commander import Commander
from skyloop.client.delivery import Tell
from skyloop.client.link import Link
from skyloop.client.pace import Pace
from skyloop.client.statistics import ChannelCounter
from skyloop.errors import AuthorityError, LinkError, NoAnswerError
from skyloop.messages import (
    AnswerTakeover,
    AnyAction,
    AnyReply,
    AuthorityGranted,
    AuthorityQueued,
    Command,
    EmergencyStop,
    Event,
    EventKind,
    Feedback,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    Role,
    encode,
)
from skyloop.messages.config import MAX_REASON

ANSWER_S: Final = 2.0  #: how long the proxy may take to answer a request for the authority
_LATER_NS: Final = 1_000_000_000


class Pilot:
    """Holds the authority and sends the newest command, at once and then at a steady rate.

    ``tell`` takes the events that are made here; ``changed`` is called with each new status of the authority, on the
    receiving thread or the link's, and ``granted`` with each new lease.
    """

    def __init__(
        self,
        name: str,
        role: Role,
        commander: Commander,
        pace: Pace,
        *,
        tell: Tell,
        changed: Callable[[AuthorityStatus], None],
        granted: Callable[[int], None],
    ) -> None:
        self._name = name
        self._role = role
        self._commander = commander
        self._clock = pace.clock
        self._tell = tell
        self._changed = changed
        self._granted = granted
        self._lock = threading.Lock()  # guards all below; never held while something waits or a user's code runs
        self._authority = Authority(name)
        self._seq = 0
        self._ask_now = False
        self._refusal: Refused | None = None
        self.link: Link
        self.bell = pace.bell()  #: rings when the status of the authority changes
        self.sends = ChannelCounter()  #: commands sent; dropped: those that could not be handed to the link

    @property
    def status(self) -> AuthorityStatus:
        return self._authority.status

    @property
    def app_id(self) -> int:
        return self._authority.app_id

    @property
    def seq(self) -> int:
        """Number of the last command sent on this connection."""
        return self._seq

    @property
    def open_ns(self) -> int:
        """From when on a new set-point goes out at once, on our clock."""
        return self._commander.open_ns

    @property
    def wants_flight(self) -> bool:
        """Whether the newest intent keeps, or brings, the vehicle in the air."""
        return self._commander.wants_flight

    # The application's side ------------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> bool:
        """Make it the newest set-point; False if it can't go out now, because the link is down.

        Raises :class:`AuthorityError` while somebody else has the authority, or nobody asked for it.
        """
        now_ns = self._clock()
        if self._authority.held and self._commander.open_ns <= now_ns:
            self.link.knock()  # the proxy wakes up while the command is being made
        stop = type(action) is EmergencyStop
        with self._lock:
            authority = self._authority
            may_send = authority.held or stop
            if not may_send and self.link.connected and not (authority.wanted and authority.status.state == "none"):
                raise self._not_ours(action)
            if stop and self._role is Role.OBSERVER:
                raise self._not_ours(action)
            self._commander.ask(action, now_ns)
            if not may_send or not self.link.connected:
                return False
            if self._commander.due_ns <= now_ns:
                return self._send_next(now_ns)
        self.link.poke()  # a moment later, on the link's thread: the last one went out just before
        return True

    def drop(self, action: AnyAction) -> None:
        """Want this no longer, if it is the newest set-point."""
        with self._lock:
            if self._commander.action is action:
                self._commander.clear()

    def is_newest(self, action: AnyAction) -> bool:
        """Whether the application asked for this and for nothing since, and has the authority."""
        return self._authority.held and self._commander.asked is action

    def lapsed(self, action: AnyAction) -> bool:
        """Whether it is the newest and yet over, ended by a failsafe, a lost link or a lost lease, and could be asked
        for anew now."""
        with self._lock:
            return self.is_newest(action) and self._commander.action is not action and self.link.connected

    def request(self, wish: RequestAuthority, wait_s: float, *, stay: bool = False) -> AuthorityStatus:
        """Ask for the authority and wait for it. See :meth:`skyloop.client.drone.Drone.request_authority`."""
        if self._role is Role.OBSERVER:
            raise AuthorityError('this application observes: connect with access="pilot" to fly', code="observer")
        with self._lock:
            self._authority.asked(wish)
            self._refusal = None
            self._ask_now = True
        self.link.poke()
        if not self.bell.wait_for(lambda: not self._authority.pending, ANSWER_S + max(0.0, wait_s)):
            self.release(wait=False)
            raise NoAnswerError(f"the proxy did not answer the request for the authority within {ANSWER_S:g} s")
        self.bell.wait_for(lambda: self._authority.held or not self._authority.wanted, max(0.0, wait_s))
        status, refusal = self.status, self._refusal
        if status.state == "held" or (stay and status.state in ("queued", "preempted")):
            return status
        self.release(wait=False)
        if refusal is not None:
            raise AuthorityError(f"the authority was refused: {refusal.message}", code=refusal.code.value)
        raise AuthorityError(_busy(status, wait_s, self._authority.declined), code="busy")

    def answer(self, lease: int, app_id: int, grant: bool, reason: str) -> None:
        """Answer an application that asks for the authority. Too late an answer changes nothing."""
        self.link.ask(AnswerTakeover(lease, app_id, grant, reason[:MAX_REASON]), lambda _: None, ANSWER_S)

    def release(self, *, wait: bool = True) -> None:
        """Give the authority back, or leave the line. Does nothing for who has and wants none."""
        with self._lock:
            known = self._authority.wanted or self.status.state != "none"
            self._commander.clear()
            changed = self._authority.given_back()
        if known and self.link.connected:
            if wait:
                self.link.call(ReleaseAuthority, ANSWER_S)
            else:
                self.link.ask(ReleaseAuthority(), lambda _: None, ANSWER_S)
        if changed:
            self._told()

    # The link's side -------------------------------------------------------------------------------------------

    def connected(self, app_id: int) -> None:
        """A connection was made: the authority is asked for again by :meth:`tick`, if it is wanted."""
        with self._lock:
            self._authority.connected(app_id)
            self._seq = 0

    def disconnected(self) -> None:
        """Nothing that was asked for before is taken up again."""
        with self._lock:
            self._commander.clear()
            changed = self._authority.disconnected()
        if changed:
            self._told()

    def feedback(self, sample: Feedback, now_ns: int) -> None:
        """What the vehicle does, and who owns it."""
        with self._lock:
            before = self.status
            changed = self._authority.feedback(sample, now_ns)
            self._commander.observe(sample, now_ns)
        if changed:
            self._moved(before, now_ns)

    def event(self, event: Event, now_ns: int) -> None:
        """News about the authority."""
        with self._lock:
            before = self.status
            changed = self._authority.event(event, now_ns)
        if changed:
            self._moved(before, now_ns)

    def tick(self, now_ns: int) -> int:
        """Send what is due; returns when to call again."""
        wish, stalled, due_ns = None, False, now_ns + _LATER_NS
        with self._lock:
            authority = self._authority
            if authority.wanted and (self._ask_now or (authority.status.state == "none" and not authority.pending)):
                self._ask_now = False
                wish = authority.wish
                authority.asked(wish)
            if authority.held or isinstance(self._commander.action, EmergencyStop):
                if self._commander.due_ns <= now_ns:
                    stalled = self._decay(now_ns)
                due_ns = self._commander.due_ns
        if wish is not None:
            self.link.ask(wish, self._answered, ANSWER_S)
        if stalled:
            text = "the application made no call for too long: its set-point decayed to hover"
            self._tell(EventKind.FAILSAFE, text, step="hover", reason="stalled")
        return due_ns

    # Inside ----------------------------------------------------------------------------------------------------

    def _decay(self, now_ns: int) -> bool:
        """Send what is due; whether that was a set-point's decay to hover."""
        before = self._commander.action
        self._send_next(now_ns)
        return self._commander.decayed(before)

    def _send_next(self, now_ns: int) -> bool:
        action = self._commander.next(now_ns)
        if action is None:
            return False
        self._seq += 1
        link, lease, intent = self.link, self._authority.status.lease, self._commander.intent
        sent_ns = self._clock() + link.offset_ns
        if link.transmit(encode(Command(self._seq, lease, intent, sent_ns, action))):
            self.sends.add(0, now_ns, now_ns)
            return True
        self.sends.dropped += 1
        return False

    def _answered(self, answer: AnyReply | LinkError) -> None:
        """The answer to a request for the authority came, on the receiving thread."""
        now_ns = self._clock()
        with self._lock:
            before = self.status
            if not self._authority.wanted:
                return  # given back in the meantime
            if isinstance(answer, AuthorityGranted):
                changed = self._authority.granted(answer.lease, now_ns, answer.until_ns or None)
            elif isinstance(answer, AuthorityQueued):
                changed = self._authority.queued(answer.position, answer.holder, answer.wait_s)
            elif isinstance(answer, Refused):
                self._refusal = answer
                changed = self._authority.refused()
            else:  # no answer: asked again by the next tick, on this connection or the next
                self._authority.pending = False
                changed = False
        if changed:
            self._moved(before, now_ns)
        else:
            self.bell.ring()

    def _moved(self, before: AuthorityStatus, now_ns: int) -> None:
        """The status is another one: nothing old goes on, and what is new begins."""
        status = self.status
        with self._lock:
            if status.state == "held":
                self._commander.resume(now_ns)
            elif before.state == "held":
                self._commander.clear()
        if status.state == "held" and status.lease != before.lease:
            self._granted(status.lease)
        self._told()
        self.link.poke()

    def _told(self) -> None:
        self.bell.ring()
        self._changed(self.status)

    def _not_ours(self, action: AnyAction) -> AuthorityError:
        status = self.status
        if self._role is Role.OBSERVER:
            return AuthorityError(
                f'{action.name}: this application observes; connect with access="pilot" to fly', code="observer"
            )
        if status.state == "preempted":
            return AuthorityError(
                f"{action.name}: {status.holder or 'another application'} took over the authority; "
                "it comes back when they give it back",
                code="no_authority",
            )
        if status.state == "queued":
            return AuthorityError(
                f"{action.name}: {status.holder or 'another application'} holds the authority and this application "
                "waits in line",
                code="no_authority",
            )
        return AuthorityError(f"{action.name}: call request_authority() first", code="no_authority")


def _busy(status: AuthorityStatus, wait_s: float, declined: str) -> str:
    waited = f" and did not give it back within {wait_s:g} s" if wait_s > 0 else ""
    expected = status.expected_wait_s
    words = f" (number {status.position} in line, expected wait {expected:.0f} s)" if expected is not None else ""
    said = f"; {declined}" if declined else ""
    return (
        f"{status.holder or 'another application'} holds the authority{waited}{words}{said}: wait longer (wait_s), ask "
        'with a higher priority (a lower number, 0 is the highest), or look on with access="observe"'
    )
