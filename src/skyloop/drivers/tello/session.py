"""One drone, from the first datagram on: what its state means, and what it is told. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.notices import message
from skyloop.drivers.tello.conversation import Conversation, Done, Request
from skyloop.drivers.tello.feedback import feedback_of, native_of
from skyloop.drivers.tello.health import Health
from skyloop.drivers.tello.options import TelloOptions
from skyloop.drivers.tello.pilot import Pilot
from skyloop.drivers.vehicle_session import Patience, VehicleSession
from skyloop.errors import DecodeError
from skyloop.messages import AnyAction, LinkState, Severity, Value
from skyloop.wire.tello.commands import ENTER, Sdk, decoded, ports
from skyloop.wire.tello.replies import is_error
from skyloop.wire.tello.state import parse

TICK_NS: Final = nanoseconds(0.05)  #: the pace of ``rc``
HURRY_NS: Final = nanoseconds(0.02)  #: a new decision is not said sooner after the last ``rc`` than this
DEGRADED_NS: Final = nanoseconds(0.6)  #: of silence; states come ten times a second
LOST_NS: Final = nanoseconds(1.5)
FIRST_WORD_NS: Final = nanoseconds(2.0)  #: a drone that was never heard by then is told as lost
ENTER_NS: Final = nanoseconds(0.5)  #: pace of ``command`` while no state comes
ALIVE_NS: Final = nanoseconds(4.0)  #: pace of a question that keeps the drone from landing by itself after 15 s
DEAF: Final = 2  #: questions in a row without an answer: our commands are not heard
VIDEO_NS: Final = nanoseconds(2.0)  #: without video for so long it is asked for
ALIVE: Final = "wifi?"

_SDK: Final = {"20": Sdk.V2_0, "30": Sdk.V3_0}


class Session(VehicleSession):
    """The drone of one opened driver. Not thread-safe.

    ``extra`` gives telemetry of others for feedback's ``native``; ``video_ns`` when video came last.
    """

    PATIENCE = Patience(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)
    pilot: Pilot

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
        self.pilot = Pilot()
        self.conversation = Conversation()
        self.counts = Counter(dict.fromkeys(("received", "damaged"), 0))
        self.sdk: Sdk | None = None  #: None until the drone told it, by this or by not knowing the question
        self.serial = ""
        self.ready = False  #: whether state comes and commands are answered
        self.remembered: dict[str, str] = {}  #: what was configured, and by which command: said again after a loss
        self._extra = extra
        self._video_ns = video_ns
        self._health = Health()
        self._entered_ns = now_ns - ENTER_NS
        self._alive_ns = now_ns
        self._asked_video_ns = 0
        self._asking_version = False
        self._deaf = 0
        self._quality: int | None = None
        self._rc_ns = 0
        self._flips: list[str] = []
        self._told_ports = False
        self._answered = False  # while no state comes
        self._place = f"{options.host}, UDP port {options.port}"
        self._tell_link(LinkState.CONNECTING, f"waiting for the state of the Tello at {self._place}")
        if options.pads:
            self.remembered["tello.mission_pads"] = "mon"

    # From the driver -------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Decide, and say it soon. Returns what is really applied; raises what :meth:`Pilot.take` raises."""
        before = self.pilot.intent
        applied = self.pilot.take(action, now_ns)
        if self.pilot.intent != before:
            self.due_ns = min(self.due_ns, max(now_ns, self._rc_ns + HURRY_NS))
        return applied

    def ask(self, text: str, done: Done) -> None:
        """A command that is answered."""
        self.conversation.ask(Request(text, done))
        self.due_ns = 0

    def flip(self, direction: str) -> None:
        """Said once, as a repeat would flip it twice."""
        self._flips.append(f"flip {direction}")
        self.due_ns = 0

    def close(self) -> None:
        self.conversation.abandon()

    # From the sockets ------------------------------------------------------------------------------------------

    def state_heard(self, datagram: bytes, now_ns: int) -> None:
        """A datagram at the state's port, whatever it holds. Never raises."""
        try:
            state = parse(datagram)
        except DecodeError:
            self.counts["damaged"] += 1
            return
        self.counts["received"] += 1
        begins, self._heard_ns = self._heard_ns is None, now_ns
        self.pilot.watch.heard(state, now_ns)
        self.pilot.look(now_ns)
        if begins:
            self._begin(now_ns)
        elif self.link_state is LinkState.DEGRADED and self.ready:
            self._tell_link(LinkState.UP)
        for notice in self._health.notices(state):
            self._notice(notice)
        native = native_of(state)
        native.update(self._telemetry())
        feedback = feedback_of(state, self.pilot.state(), now_ns, self.options.velocity_axes, native)
        self._tellings.append(lambda sink: sink.feedback(feedback))

    def reply_heard(self, datagram: bytes, now_ns: int) -> None:
        """A datagram at the port that commands are sent from, whatever it holds. Never raises."""
        reply = decoded(datagram)
        if not reply:
            self.counts["damaged"] += 1
            return
        if self._heard_ns is None:
            self._answered = True
            self._look_at_refused_ports(reply)
            return
        motion = self.conversation.heard(reply)
        if motion is not None:
            self.pilot.answered(motion, reply, now_ns)
        self.due_ns = min(self.due_ns, max(now_ns, self._rc_ns + HURRY_NS))

    def _look_at_refused_ports(self, reply: str) -> None:
        if self.options.own_ports and is_error(reply) and not self._told_ports:
            self._told_ports = True
            text = (
                f"the drone answers {reply!r}: other ports than 8890 and 11111 need SDK 3.0; leave state_port and "
                "video_port out"
            )
            self._notice(message(text, "ports_refused", Severity.ERROR))

    def _telemetry(self) -> dict[str, Value]:
        told: dict[str, Value] = {f"state.{name}": count for name, count in self.counts.items()}
        told.update({f"replies.{name}": count for name, count in self.conversation.counts.items()})
        if self._quality is not None:
            told["wifi"] = self._quality
        told.update(self._extra())
        return told

    # Time ------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[bytes]:
        """The commands that are due now, each for a datagram of its own."""
        self._look_at_silence(now_ns)
        self.due_ns = now_ns + TICK_NS
        texts = []
        if self._heard_ns is None and now_ns - self._entered_ns >= ENTER_NS:
            self._entered_ns = now_ns
            texts.append(ENTER)
            if self.options.own_ports:
                texts.append(ports(self.options.state_port, self.options.video_port))
        flips, self._flips = self._flips, []
        for motion in [*self.pilot.motions(now_ns), *flips]:
            self.conversation.moved(motion, now_ns)
            texts.append(motion)
        stick = self.pilot.stick()
        if stick is not None and (now_ns - self._rc_ns >= HURRY_NS):
            self._rc_ns = now_ns
            texts.append(stick.text)
        if self._heard_ns is not None:
            self._keep_alive(now_ns)
            self._keep_video(now_ns)
            texts += self.conversation.messages(now_ns)
        return [text.encode("ascii") for text in texts]

    def _keep_alive(self, now_ns: int) -> None:
        """Ask something now and then: it keeps the drone up, and shows whether it hears us."""
        if self.ready and now_ns - self._alive_ns >= ALIVE_NS:
            self._alive_ns = now_ns
            self.conversation.ask(Request(ALIVE, self._alive))
        elif not self.ready and not self._asking_version:
            self._asking_version = True
            self.conversation.ask(Request("sdk?", self._version_told))

    def _alive(self, reply: str | None) -> None:
        if reply is None:
            self._deaf += 1
            if self._deaf >= DEAF:
                self.ready = False
                self._tell_link(LinkState.DEGRADED, "the drone tells its state, and answers no command")
            return
        self._deaf = 0
        if reply.isdecimal():
            self._quality = int(reply)

    def _keep_video(self, now_ns: int) -> None:
        last_ns = max(self._video_ns(), self._asked_video_ns)
        if self.options.video and self.ready and now_ns - last_ns >= VIDEO_NS and self.conversation.idle:
            self._asked_video_ns = now_ns
            self.conversation.ask(Request("streamon", _whatever))

    def _silence(self, since: str, why: str) -> str:
        if self._answered:
            why += f", though it answers: does a firewall of this host let UDP port {self.options.state_port} in?"
        return f"no state{since} from {self._place}{why}"

    # Losing and finding ----------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        self._heard_ns = None
        self.ready = self._asking_version = False
        self.conversation.abandon()
        self.pilot.lost(now_ns)
        self._tell_link(LinkState.LOST, reason)

    def _begin(self, now_ns: int) -> None:
        self._unreachable, self._answered = "", False
        self._deaf, self._alive_ns, self._asked_video_ns = 0, now_ns, 0
        self.due_ns = 0

    def _version_told(self, reply: str | None) -> None:
        self._asking_version = False
        if self._heard_ns is None:
            return
        if reply is None:
            self._tell_link(LinkState.DEGRADED, "the drone tells its state, and answers no command")
            return
        self.sdk = _SDK.get(reply, Sdk.V1_3 if is_error(reply) else Sdk.V3_0)
        self.ready, self._deaf = True, 0
        self.conversation.ask(Request("sn?", self._serial_told))
        for text in self.remembered.values():
            self.conversation.ask(Request(text, _whatever))
        self._tell_link(LinkState.UP)

    def _serial_told(self, reply: str | None) -> None:
        if reply is not None and not is_error(reply):
            self.serial = reply


def _whatever(_reply: str | None) -> None:
    """What became of it shows in the drone's state or video."""
