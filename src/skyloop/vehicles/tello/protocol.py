"""The protocol with one drone from the first datagram onwards: state and replies in, commands out. No I/O, no clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import (
    KEPT_NS,
    LinkTimeouts,
    PacketOrder,
    RestartWatch,
    VehicleEvent,
    VehicleSession,
    message,
)
from skyloop.errors import DecodeError
from skyloop.messages import AnyAction, EmergencyStop, Hover, LinkState, Severity, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.tello.options import TelloOptions
from skyloop.vehicles.tello.setpoints import TelloSetpoints
from skyloop.vehicles.tello.telemetry import TelloHealth, feedback_of
from skyloop.vehicles.tello.wire import ENTER, HOST, Sdk, Shape, answers, decoded, is_error, parse, ports, shape_of

PATIENCE_NS: Final = nanoseconds(0.3)  #: time allowed for a reply; real drones take at most 29 ms over a good link
TRIES: Final = 3  #: number of times a request is sent before it fails
MOTION_NS: Final = nanoseconds(20.0)  #: time allowed for the reply to a take-off or landing

#: Called with the reply, or None if there was none.
Done = Callable[[str | None], None]


@dataclass(slots=True)
class TelloRequest:
    """A command to which a reply is expected."""

    text: str
    done: Done
    tries: int = TRIES  #: number of tries left, including the current one
    sent_ns: int | None = None  #: when the command was last sent


class Conversation:
    """Sends one request at a time.

    *Motions* such as a take-off are sent elsewhere, but their replies arrive here seconds later. Until then, requests
    with the same possible replies are not sent.

    ``counts`` has ``answered`` and ``unanswered`` requests, and ``stray`` replies that match nothing.
    """

    def __init__(self) -> None:
        self.counts = Counter(dict.fromkeys(("answered", "unanswered", "stray"), 0))
        self._queue: deque[TelloRequest] = deque()
        self._asked: TelloRequest | None = None
        self._motions: dict[str, int] = {}  # when each motion that awaits its reply was last sent

    @property
    def idle(self) -> bool:
        return self._asked is None and not self._queue

    def ask(self, request: TelloRequest) -> None:
        self._queue.append(request)

    def moved(self, text: str, now_ns: int) -> None:
        """Record that a motion was sent."""
        self._motions[text] = now_ns

    def abandon(self) -> None:
        """Fail all requests after a link loss."""
        waiting = [self._asked] if self._asked is not None else []
        waiting += self._queue
        self._queue.clear()
        self._asked = None
        self._motions.clear()
        for request in waiting:
            request.done(None)

    def on_reply(self, reply: str) -> str | None:
        """Handle a reply; return the motion to which it belongs, or None."""
        asked = self._asked
        plain_error = is_error(reply) and ":" not in reply
        if asked is not None and answers(reply, asked.text) and not (plain_error and self._motions):
            self._asked = None
            self.counts["answered"] += 1
            asked.done(reply)
            return None
        for motion in self._motions:
            if answers(reply, motion):
                del self._motions[motion]
                return motion
        self.counts["stray"] += 1
        return None

    def messages(self, now_ns: int) -> list[str]:
        """Return the commands to send now."""
        self._motions = {text: at for text, at in self._motions.items() if now_ns - at < MOTION_NS}
        asked = self._asked
        if asked is not None and asked.sent_ns is not None:
            if now_ns - asked.sent_ns < PATIENCE_NS:
                return []
            asked.tries -= 1
            if asked.tries <= 0:
                self._asked = None
                self.counts["unanswered"] += 1
                asked.done(None)
        if self._asked is None:
            self._asked = self._next()
        if self._asked is None:
            return []
        self._asked.sent_ns = now_ns
        return [self._asked.text]

    def _next(self) -> TelloRequest | None:
        for request in self._queue:
            if not self._motions or shape_of(request.text) is not Shape.OK:
                self._queue.remove(request)
                return request
        return None


TICK_NS: Final = nanoseconds(0.05)  #: time between two ``rc`` commands
HURRY_NS: Final = nanoseconds(0.02)  #: minimum time between two ``rc`` commands
DEGRADED_NS: Final = nanoseconds(0.6)  #: time without state after which the link is DEGRADED; state arrives at 10 Hz
LOST_NS: Final = nanoseconds(1.5)  #: time without state after which the link is LOST
FIRST_WORD_NS: Final = nanoseconds(2.0)  #: time after which a drone that has sent nothing is reported as lost
ENTER_NS: Final = nanoseconds(0.5)  #: time between two ``command`` commands while no state arrives
ALIVE_NS: Final = nanoseconds(4.0)  #: time between the requests that prevent automatic landing after 15 s
ALONE_NS: Final = nanoseconds(30.0)  #: time within which a drone without commands has landed; landing begins after 15 s
ASK_NS: Final = nanoseconds(5.0)  #: time allowed for asking a drone flown by another program for its version
DEAF: Final = 2  #: this many consecutive unanswered requests mean that our commands are not received
VIDEO_NS: Final = nanoseconds(2.0)  #: time without usable video after which video is requested
ALIVE: Final = "wifi?"  #: the periodic request, which every SDK version has
_TELLOS_NETWORK: Final = HOST.removesuffix("1")

_SDK: Final = {"20": Sdk.V2_0, "30": Sdk.V3_0}


class TelloSession(VehicleSession):
    """The protocol between an open driver and its drone. Not thread-safe.

    ``extra`` returns further telemetry for ``Feedback.native``. ``video_ns`` returns the time when usable video or a
    key frame last arrived (0 if never).
    """

    TIMEOUTS = LinkTimeouts(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)

    def __init__(
        self,
        options: TelloOptions,
        now_ns: int,
        *,
        extra: Callable[[], Mapping[str, Value]] = dict,
        video_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        super().__init__(now_ns)
        self.options = options
        self.setpoints = TelloSetpoints()
        self.conversation = Conversation()
        self.counts = Counter(dict.fromkeys(("received", "damaged", "late"), 0))
        self._watch = RestartWatch()  # watches the count of seconds for which the motors have run
        self.sdk: Sdk | None = None  #: None until there is a reply to ``sdk?``; SDK 1.3 replies with an error
        self.serial = ""
        self.ready = False  #: whether state arrives and commands are answered
        self.remembered: dict[str, str] = {}  #: last command for each parameter, to be resent after a link loss
        self._extra = extra
        self._video_ns = video_ns
        self._health = TelloHealth()
        self._entered_ns = now_ns - ENTER_NS
        self._lost_ns = self._sent_ns = now_ns  # time of the link loss or of a later hover request; last datagram
        self._alive_ns = self._found_ns = now_ns  # time of the last periodic request; of the first state
        self._asked_video_ns = 0
        self._asking_version = False
        self._deaf = 0  # number of consecutive unanswered requests
        self._quality: int | None = None  # reply to the periodic request: the quality of the Wi-Fi link
        self._rc_ns = 0
        self._flips: list[str] = []
        self._reported_ports = False
        self._answered = False  # whether there has been a reply since state last arrived
        self.local = ""  #: this host's address on the route to the drone
        self._place = f"{options.host}, UDP port {options.port}"
        self._set_link_state(LinkState.CONNECTING, f"waiting for the state of the Tello at {self._place}")
        if options.pads:
            self.remembered["tello.mission_pads"] = "mon"

    # From the driver -------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Accept an action and send it as soon as allowed; see :meth:`TelloSetpoints.apply`."""
        before = self.setpoints.intent
        applied = self.setpoints.apply(action, now_ns, new=new)
        self._keep(action, now_ns)
        if new and isinstance(action, Hover):
            self._lost_ns = now_ns
        if isinstance(action, EmergencyStop):
            self._flips.clear()
            self.due_ns = now_ns
        elif self.setpoints.intent != before:
            self.due_ns = min(self.due_ns, max(now_ns, self._rc_ns + HURRY_NS))
        return applied

    def ask(self, text: str, done: Done) -> None:
        """Send a command; ``done`` is called with the reply, or None if there is none."""
        self.conversation.ask(TelloRequest(text, done))
        self.due_ns = 0

    def flip(self, direction: str) -> None:
        """Send a flip only once, because a repeat would flip the drone twice."""
        self._flips.append(f"flip {direction}")
        self.due_ns = 0

    def _new_events(self) -> list[VehicleEvent]:
        return self.setpoints.pop_events()

    def _forget_landing(self) -> bool:
        return self.setpoints.forget_landing()

    def close(self) -> None:
        """End the session; queued requests stay unanswered."""
        self.conversation.abandon()

    # From the sockets ------------------------------------------------------------------------------------------

    def on_state(self, datagram: bytes, now_ns: int) -> None:
        """Handle a datagram from the state port. Never raises, regardless of content."""
        try:
            state = parse(datagram)
        except DecodeError:
            self.counts["damaged"] += 1
            return
        if state.motor_s is not None and self._watch.update(state.motor_s, now_ns) is PacketOrder.LATE:
            self.counts["late"] += 1
            return
        self.counts["received"] += 1
        begins, self._received_ns = self._received_ns is None, now_ns
        self.setpoints.watch.update(state, now_ns)
        self.setpoints.on_state(now_ns)
        if begins:
            self._begin(now_ns)
        elif self.link_state is LinkState.DEGRADED and self.ready:
            self._set_link_state(LinkState.UP)
        for event in self._health.changes(state):
            self._publish_event(event)
        native: dict[str, Value] = {**dict(state.fields), **self._telemetry()}  # names and units are the drone's own
        feedback = feedback_of(state, self.setpoints.flight_state(), now_ns, self.options.velocity_axes, native)
        self._pending.append(lambda sink: sink.feedback(feedback))

    def diagnose(self) -> list[Diagnostic]:
        return self._health.diagnose()

    def on_reply(self, datagram: bytes, now_ns: int) -> None:
        """Handle a datagram from the command port. Never raises, regardless of content."""
        reply = decoded(datagram)
        if not reply:
            self.counts["damaged"] += 1
            return
        if self._received_ns is None:
            self._answered = True
            self._report_refused_ports(reply)
            return
        motion = self.conversation.on_reply(reply)
        if motion is not None:
            self.setpoints.on_answer(motion, reply, now_ns)
        self.due_ns = min(self.due_ns, max(now_ns, self._rc_ns + HURRY_NS))

    def _report_refused_ports(self, reply: str) -> None:
        if self.options.own_ports and is_error(reply) and not self._reported_ports:
            self._reported_ports = True
            text = (
                f"the drone answers {reply!r}: other ports than 8890 and 11111 need SDK 3.0; leave state_port and "
                "video_port out"
            )
            self._publish_event(message(text, "ports_refused", Severity.ERROR))

    def _telemetry(self) -> dict[str, Value]:
        native: dict[str, Value] = {f"state.{name}": count for name, count in self.counts.items()}
        native.update({f"replies.{name}": count for name, count in self.conversation.counts.items()})
        if self._quality is not None:
            native["wifi"] = self._quality
        native.update(self._extra())
        return native

    # Time ------------------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> list[bytes]:
        """Return the commands to send now, one per datagram."""
        self._check_silence(now_ns)
        self.due_ns = now_ns + TICK_NS
        texts = []
        alone = self._left_to_land(now_ns)
        if self._received_ns is None and not alone and now_ns - self._entered_ns >= ENTER_NS:
            self._entered_ns = now_ns
            texts.append(ENTER)
            if self.options.own_ports:
                texts.append(ports(self.options.state_port, self.options.video_port))
        flips, self._flips = self._flips, []
        for motion in [*self.setpoints.motions(now_ns), *flips]:
            self.conversation.moved(motion, now_ns)
            texts.append(motion)
        stick = None if alone else self.setpoints.stick()
        if stick is not None and (now_ns - self._rc_ns >= HURRY_NS):
            self._rc_ns = now_ns
            texts.append(stick.text)
        if self._received_ns is not None:
            self._keep_alive(now_ns)
            self._keep_video(now_ns)
            texts += self.conversation.messages(now_ns)
        if texts:
            self._sent_ns = now_ns
        return [text.encode("ascii") for text in texts]

    def _left_to_land(self, now_ns: int) -> bool:
        """Return whether to send only landings and stops: without other commands, a lost drone lands automatically."""
        if not self.setpoints.flies_unheard or now_ns - self._lost_ns < KEPT_NS:
            return False
        if now_ns - self._sent_ns >= ALONE_NS:
            self.setpoints.forget_flight()
        return self.setpoints.flies_unheard

    def _keep_alive(self, now_ns: int) -> None:
        """Send a periodic request, which keeps the drone awake and reveals whether it receives our commands."""
        if self._is_silent(now_ns):
            return
        if self.ready and now_ns - self._alive_ns >= ALIVE_NS:
            self._alive_ns = now_ns
            self.conversation.ask(TelloRequest(ALIVE, self._alive))
        elif not self.ready and not self._asking_version:
            self._asking_version = True
            self.conversation.ask(TelloRequest("sdk?", self._on_version))

    def _is_silent(self, now_ns: int) -> bool:
        """Return whether to withhold requests, because each one delays the automatic landing of a pilotless drone."""
        asked = self.ready or self.setpoints.left_alone or now_ns - self._found_ns >= ASK_NS
        return asked and self.setpoints.flown_by_others

    def _alive(self, reply: str | None) -> None:
        if reply is None:
            self._deaf += 1
            if self._deaf >= DEAF:
                self.ready = False
                self._set_link_state(LinkState.DEGRADED, "the drone sends its state, but answers no command")
            return
        self._deaf = 0
        if reply.isdecimal():
            self._quality = int(reply)

    def _keep_video(self, now_ns: int) -> None:
        last_ns = max(self._video_ns(), self._asked_video_ns)
        missing = self.options.video and self.ready and now_ns - last_ns >= VIDEO_NS
        if missing and self.conversation.idle and not self._is_silent(now_ns):
            self._asked_video_ns = now_ns
            self.conversation.ask(TelloRequest("streamon", _ignore_reply))

    def _describe_silence(self, since: str, why: str) -> str:
        if self._answered:
            why += f", though it answers: does a firewall of this host block UDP port {self.options.state_port}?"
        if self.options.host == HOST and self.local and not self.local.startswith(_TELLOS_NETWORK):
            why += f"; this computer is in no network of a Tello, its address is {self.local}"
        return f"no state{since} from {self._place}{why}"

    def _advice(self) -> str:
        if self._answered:
            return f"allow incoming UDP port {self.options.state_port} in this computer's firewall"
        if self.options.host.startswith("127."):
            return "start the emulated drone: skyloop sim --firmware tello"
        return "switch the Tello on and join its Wi-Fi network, TELLO-…; or correct the host in the address"

    # Link loss and recovery ------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        self._received_ns, self._lost_ns = None, now_ns
        self._watch.forget()
        self.ready = self._asking_version = False
        self.conversation.abandon()
        self.setpoints.lost(now_ns)
        self._set_link_state(LinkState.LOST, reason)

    def _begin(self, now_ns: int) -> None:
        self._unreachable, self._answered = "", False
        self._deaf, self._alive_ns, self._found_ns, self._asked_video_ns = 0, now_ns, now_ns, 0
        if self.setpoints.left_alone:
            self._set_link_state(LinkState.DEGRADED, "it lands automatically: nothing is sent until a command")
        self.due_ns = 0

    def _on_version(self, reply: str | None) -> None:
        self._asking_version = False
        if self._received_ns is None:
            return
        if reply is None:
            self._set_link_state(LinkState.DEGRADED, "the drone sends its state, but answers no command")
            return
        self.sdk = _SDK.get(reply, Sdk.V1_3 if is_error(reply) else Sdk.V3_0)
        self.ready, self._deaf = True, 0
        self.conversation.ask(TelloRequest("sn?", self._on_serial))
        for text in self.remembered.values():
            self.conversation.ask(TelloRequest(text, _ignore_reply))
        self._set_link_state(LinkState.UP)

    def _on_serial(self, reply: str | None) -> None:
        if reply is not None and not is_error(reply):
            self.serial = reply


def _ignore_reply(_reply: str | None) -> None:
    """Stop waiting for the reply, because the drone's state or video already shows that the command took effect."""
