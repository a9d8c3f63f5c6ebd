"""A proxy on a bench: a vehicle that follows commands at once, applications over the memory transport, and a manual
clock. The reply to a Ping shows that everything sent before it was handled and everything published was received."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Iterable
from typing import Any

from skyloop.clock import Clock, ManualClock
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    AnyReply,
    AnyRequest,
    Applied,
    Attitude,
    AuthorityGranted,
    CameraInfo,
    Capabilities,
    Command,
    EmergencyStop,
    Event,
    EventKind,
    Feedback,
    FlightState,
    FrameHeader,
    Hello,
    Hover,
    Land,
    LinkState,
    Parameter,
    Ping,
    Pong,
    Position,
    Reply,
    Request,
    RequestAuthority,
    ResetEmergency,
    Role,
    Sample,
    SetParameter,
    Takeoff,
    Value,
    Velocity,
    Welcome,
    decode,
    encode,
)
from skyloop.proxy import Proxy
from skyloop.transport.base import (
    ANNOTATIONS,
    COMMANDS,
    EVENTS,
    FEEDBACK,
    Dialer,
    Pixels,
    TransportClient,
    TransportServer,
)
from skyloop.transport.memory import MemoryServer

WAIT_S = 10.0
ALL = frozenset(ACTION_NAMES.values())
_NEXT = {
    Takeoff: FlightState.TAKING_OFF,
    Hover: FlightState.HOVERING,
    Land: FlightState.LANDING,
    Attitude: FlightState.FLYING,
    Velocity: FlightState.FLYING,
    Position: FlightState.FLYING,
    EmergencyStop: FlightState.EMERGENCY,
    ResetEmergency: FlightState.LANDED,
}


class FakeDriver(Driver):
    """Records its commands, and shows their effect in feedback before the call returns."""

    def __init__(self, clock: Clock, actions: Iterable[str] = ALL, parameters: Iterable[Parameter] = ()) -> None:
        super().__init__(VehicleUri("fake", text="fake://"))
        self.clock = clock
        self.sink: Sink | None = None
        self.told: list[AnyAction] = []
        self.now = Feedback(captured_ns=0, state=FlightState.LANDED, battery=0.9, altitude_m=1.0)
        self.fail: set[str] = set()  #: calls that raise
        self.native = list(parameters)
        self.while_setting: Callable[[], None] = lambda: None
        self.closed = False
        self.left = ""  #: what others made the vehicle do
        self.refuses = ""  #: why the software autopilot must not start, which ``apply`` raises
        self.repeats = 0
        self.answers = True  #: whether feedback follows a command
        self._actions = frozenset(actions)

    def capabilities(self) -> Capabilities:
        why = "" if self._actions else "it is a picture"
        return Capabilities("fake", self._actions, (CameraInfo("front", 4, 3, 15.0),), why_not=why)

    def parameters(self) -> list[Parameter]:
        self._may_fail("parameters")
        return self.native

    def set_parameter(self, name: str, value: Value) -> Value:
        self.while_setting()
        self._may_fail("set_parameter")
        return value

    def report(self, **changes: Any) -> None:
        """Report feedback with these changes."""
        fields = {name: getattr(self.now, name) for name in self.now.__struct_fields__} | changes
        self.now = Feedback(**fields | {"captured_ns": self.clock()})
        assert self.sink is not None
        self.sink.feedback(self.now)

    def link(self, state: LinkState, reason: str = "") -> None:
        assert self.sink is not None
        self.sink.link(state, reason)

    def _open(self, sink: Sink) -> None:
        self._may_fail("open")
        self.sink = sink
        sink.link(LinkState.UP)
        self.report()

    def _close(self) -> None:
        self.closed = True

    def check(self, action: AnyAction) -> None:
        if self.refuses:
            raise DriverError(f"{action.name}: {self.refuses}")

    def left_to(self) -> str:
        self._may_fail("left_to")
        return self.left

    def _repeat(self, action: AnyAction) -> AnyAction:
        self.repeats += 1
        return self._apply(action)

    def _apply(self, action: AnyAction) -> AnyAction:
        self._may_fail("apply")
        self.check(action)
        self.told.append(action)
        self.left = ""
        if self.answers and type(action) in _NEXT:
            self.report(state=_NEXT[type(action)])
        return action

    def _may_fail(self, call: str) -> None:
        if call in self.fail:
            raise RuntimeError(f"{call} is broken")


class App:
    """One application, subscribed to everything."""

    def __init__(self, dial: Dialer, clock: Clock) -> None:
        self.clock = clock
        self.events: list[Event] = []
        self.feedback: list[Feedback] = []
        self.applied: list[Applied] = []
        self.others: list[Sample] = []
        self.frames: list[tuple[FrameHeader, bytes]] = []
        self.closed_by: queue.Queue[str] = queue.Queue()
        self.app_id = 0
        self.name = ""
        self.lease = 0
        self.seq = 0
        self.intent = 0
        self._replies: queue.Queue[Reply] = queue.Queue()
        self._ids = 0
        self._asked_again: set[int] = set()
        self.end: TransportClient = dial(self)
        for topic in (FEEDBACK, EVENTS, COMMANDS, ANNOTATIONS):
            self.end.subscribe(topic)

    # ClientHandler

    def packet(self, packet: bytes) -> None:
        sample = decode(packet)
        if isinstance(sample, Reply):
            self._replies.put(sample)
        elif isinstance(sample, Event):
            self.events.append(sample)
        elif isinstance(sample, Feedback):
            self.feedback.append(sample)
        elif isinstance(sample, Applied):
            self.applied.append(sample)
        else:
            self.others.append(sample)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        self.frames.append((header, pixels.tobytes()))

    def closed(self, reason: str) -> None:
        self.closed_by.put(reason)

    # For tests

    def ask(self, body: AnyRequest) -> AnyReply:
        """Send a request and return the answer, by when everything published before it has been received."""
        return self.answer(self.post(body))

    def post(self, body: AnyRequest) -> int:
        self._ids += 1
        assert self.end.send(encode(Request(self._ids, body)))
        return self._ids

    def reserve(self) -> int:
        """Return the number of a request that was lost on the way."""
        self._ids += 1
        return self._ids

    def repeat(self, number: int, body: AnyRequest) -> None:
        """Send a request again under its number, as the library does while no answer arrives."""
        assert self.end.send(encode(Request(number, body)))

    def answer(self, number: int) -> AnyReply:
        reply = self._replies.get(timeout=WAIT_S)
        while reply.id in self._asked_again and reply.id < number:  # both answers arrived
            reply = self._replies.get(timeout=WAIT_S)
        assert reply.id == number
        return reply.body

    def sync(self) -> None:
        """Wait until the proxy has handled everything sent; ask twice, as the library does if a packet is lost."""
        number = self.post(Ping(1))
        with self._replies.not_empty:
            answered = self._replies.queue or self._replies.not_empty.wait(1.0)
        if not answered:  # a burst of feedback filled the connection, and the answer was dropped
            self.repeat(number, Ping(1))
            self._asked_again.add(number)
        assert isinstance(self.answer(number), Pong)

    def hello(self, name: str, role: Role = Role.PILOT) -> Welcome:
        welcome = self.ask(Hello(name, role))
        assert isinstance(welcome, Welcome)
        self.app_id, self.name = welcome.app_id, name
        return welcome

    def take_authority(self, priority: int = 16) -> int:
        granted = self.ask(RequestAuthority(priority))
        assert isinstance(granted, AuthorityGranted), granted
        self.lease = granted.lease
        return self.lease

    def command(self, action: AnyAction, *, repeat: bool = False, sync: bool = True, **changes: Any) -> Command:
        """Send a command; ``repeat`` keeps the intent, ``changes`` replaces fields."""
        self.seq += 1
        self.intent += not repeat
        fields = {"seq": self.seq, "lease": self.lease, "intent": self.intent, "sent_ns": self.clock()} | changes
        command = Command(action=action, **fields)
        assert self.end.send(encode(command))
        if sync:
            self.sync()
        return command

    def told(self, kind: EventKind) -> list[Event]:
        """Return the events of a kind so far."""
        self.sync()
        return [event for event in self.events if event.kind is kind]

    def refusals(self) -> list[str]:
        """Return the reported reasons why commands of this application were refused."""
        told = self.told(EventKind.COMMAND_REFUSED)
        return [str(event.data["reason"]) for event in told if event.app == self.name]

    def last_feedback(self) -> Feedback:
        self.sync()
        return self.feedback[-1]


class Bench:
    """A proxy with a fake vehicle, stepped by hand."""

    def __init__(
        self,
        actions: Iterable[str] = ALL,
        parameters: Iterable[Parameter] = (),
        transport: tuple[TransportServer, Dialer] | None = None,
    ) -> None:
        self.clock = ManualClock(1000 * 10**9)
        if transport is None:
            memory = MemoryServer("bench")
            transport = memory, memory.dial
        self.server, self.dial = transport
        self.driver = FakeDriver(self.clock, actions, parameters)
        self.slept_ns = 0  #: how long the computer has slept
        self.proxy = Proxy(
            self.driver, self.server, name="bench", clock=self.clock, ticker=False, slept=lambda: self.slept_ns
        )
        self.apps: list[App] = []
        self.events: list[Event] = []  #: all published events, even those that no one receives
        self._publish, self.proxy.events._publish = self.proxy.events._publish, self._publish_event

    def _publish_event(self, topic: str, packet: bytes) -> int:
        event = decode(packet)
        assert isinstance(event, Event)
        self.events.append(event)
        return self._publish(topic, packet)

    def published(self, kind: EventKind) -> list[Event]:
        """Return the events of a kind so far."""
        return [event for event in self.events if event.kind is kind]

    def __enter__(self) -> Bench:
        self.proxy.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.proxy.end()
        for app in self.apps:
            app.end.close()

    def stranger(self) -> App:
        """Return a connection without Hello."""
        app = App(self.dial, self.clock)
        self.apps.append(app)
        return app

    def join(self, name: str, role: Role = Role.PILOT) -> App:
        app = self.stranger()
        app.hello(name, role)
        return app

    def pilot(self, name: str = "pilot", priority: int = 16) -> App:
        app = self.join(name)
        app.take_authority(priority)
        return app

    def airborne(self, name: str = "pilot", priority: int = 16) -> App:
        """Return a pilot whose vehicle hovers, and clear the driver's record."""
        app = self.pilot(name, priority)
        self.take_off(app)
        return app

    def take_off(self, app: App) -> None:
        """Take off with this pilot until the vehicle hovers, and clear the driver's record."""
        app.command(Takeoff())
        deadline = time.monotonic() + WAIT_S
        while Takeoff() not in self.driver.told:  # a datagram may be lost
            assert time.monotonic() < deadline, "the take-off was never executed"
            time.sleep(0.01)
            app.command(Takeoff())
        self.driver.report(state=FlightState.HOVERING)
        self.driver.told.clear()

    def move(self, position_m: tuple[float, float, float], **more: Any) -> None:
        """Report the vehicle at another position, after positions on the way, so that it does not jump."""
        start = self.driver.now.position_m or position_m
        steps = math.ceil(math.dist(start, position_m) / 0.9)
        for step in range(1, steps + 1):
            between = [a + step / steps * (b - a) for a, b in zip(start, position_m, strict=True)]
            self.driver.report(position_m=tuple(between), **more)
            self.tick()

    def run(self, seconds: float, each: Callable[[], object] = lambda: None) -> None:
        """Advance time in steps of 20 ms, each followed by the proxy's tick and ``each``."""
        for _ in range(round(seconds / 0.02)):
            self.clock.advance(0.02)
            self.proxy.tick(self.clock())
            each()

    def tick(self) -> None:
        self.proxy.tick(self.clock())


def write(bench: Bench, pilot: App, name: str, value: float | str) -> None:
    pilot.ask(SetParameter(name, value, pilot.lease))
    bench.driver.report()


def steps(app: App) -> list[tuple[object, object]]:
    return [(event.data["step"], event.data["reason"]) for event in app.told(EventKind.FAILSAFE)]


def messages(app: App, reason: str) -> list[str]:
    return [event.text for event in app.told(EventKind.VEHICLE_MESSAGE) if event.data["reason"] == reason]
