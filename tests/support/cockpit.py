"""Fake drones: one that passes a test's samples to the cockpit through the client's own types, and a vehicle behind a
real proxy that follows its commands."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from skyloop.client import Authority, Drone
from skyloop.client.drone import open_drone
from skyloop.client.frame import FeedbackHistory, Frame, ReceivedFrame
from skyloop.client.monitoring import ChannelStats, Distribution
from skyloop.clock import monotonic_ns
from skyloop.cockpit.access import Gate, OpenGate, Person, Scope
from skyloop.cockpit.alarms import PARAMETERS, USUAL
from skyloop.cockpit.app import create_app
from skyloop.cockpit.discovery import FoundProxy
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.recordings import Recordings
from skyloop.cockpit.security import own_names
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import LinkError, NoAnswerError
from skyloop.messages import (
    ACTION_NAMES,
    Annotation,
    AnyAction,
    Applied,
    CameraInfo,
    Capabilities,
    Command,
    EmergencyStop,
    EncodedFrame,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FlightState,
    FrameHeader,
    Hover,
    Intrinsics,
    Land,
    LinkState,
    LogEntry,
    Role,
    Takeoff,
    Value,
    Velocity,
    VideoRequest,
    decode,
)
from skyloop.proxy.proxy import Proxy
from skyloop.recording.options import RecorderState, Status
from skyloop.transport.base import ClientHandler, TransportClient
from skyloop.transport.memory import MemoryServer
from tests.support.fake_vehicle import NEXT
from tests.support.systems import PLATFORM
from tests.support.testclient import TestClient, WebSocketTestSession

OWN = "http://127.0.0.1:8123"
SOCKETS = "ws://127.0.0.1:8123/ws"
ORIGIN = {"origin": OWN}
PATIENCE_S = 30.0


class Listening:
    """A registered callback, which can be cancelled."""

    def __init__(self, where: list[Any], function: Callable[[Any], None]) -> None:
        self._where = where
        self._function = function
        where.append(function)

    def cancel(self) -> None:
        if self._function in self._where:
            self._where.remove(self._function)


class FakeStream:
    """A camera's H.264 in one format, controlled by the test."""

    def __init__(self, request: VideoRequest) -> None:
        self.request = request
        self.consumers: list[Any] = []
        self.reports: list[tuple[int, bool]] = []  #: reports to the proxy: the newest picture, whether a key is needed
        self.seq = 100

    def add(self, consumer: Callable[[EncodedFrame], None], dropped: Callable[[], int]) -> None:
        self.consumers.append(consumer)

    def remove(self, consumer: Callable[[EncodedFrame], None]) -> None:
        self.consumers.remove(consumer)

    def report(self, seq: int, *, wants_key: bool = False) -> None:
        self.reports.append((seq, wants_key))

    def encode(self, *, key: bool = False, lost: int = 0, captured_ns: int | None = None) -> EncodedFrame:
        """Deliver the next picture, after losing some on the way."""
        self.seq += 1 + lost
        now = monotonic_ns()
        size = (round(64 * self.request.scale), round(48 * self.request.scale))
        data = b"\0\0\1key" if key else b"\0\0\1"
        picture = EncodedFrame(self.request.camera, self.seq, captured_ns or now, now, *size, "h264", key, data)
        for consumer in list(self.consumers):
            consumer(picture)
        return picture


class FakeDrone:
    """The parts of a drone that the cockpit uses."""

    name = "alpha"
    uri = "sim://?seed=1"

    def __init__(self, width: int = 64, height: int = 48) -> None:
        cameras = (CameraInfo("front", width, height, 15.0), CameraInfo("bottom", width, height, 15.0))
        self.capabilities = Capabilities("sim", frozenset({"velocity"}), cameras, "simulated quadrotor")
        self.link = SimpleNamespace(application=LinkState.UP, vehicle=LinkState.UP, reason="", remedy="")
        delay = Distribution(0.0002, 0.0009, 0.002, 0.0003, 100)
        self.stats = {"feedback": ChannelStats(count=100, rate_hz=32.0, delay_s=delay, age_s=0.01)}
        self.config: dict[str, Value] = {name: getattr(USUAL, field) for field, name in PARAMETERS.items()}
        self.newest: Feedback | None = None
        self.told: list[Event] = []
        self.processors: dict[str, list[Any]] = {"front": [], "bottom": []}
        self.event_listeners: list[Any] = []
        self.annotation_listeners: list[Any] = []
        self.feedback_listeners: list[Any] = []
        self.command_listeners: list[Any] = []
        self.log_listeners: list[Any] = []
        self.requests: list[tuple[str, dict[str, Any]]] = []  #: subscribed cameras, with their options
        self.streams: list[FakeStream] = []  #: H.264 streams in the order of their first request
        self._state = SimpleNamespace(video=SimpleNamespace(stream=self._stream))
        self.clock_offset_ns = 0
        self.closed = False
        self._size = width, height
        self._seq = 0
        self._shown_ns = 0

    def feedback(self, *, max_hz: float | None = None) -> Feedback:
        if self.newest is None:
            raise NoAnswerError("no feedback yet")
        return self.newest

    def on_feedback(self, function: Callable[[Feedback], None], inline: bool, max_hz: float | None = None) -> Listening:
        return Listening(self.feedback_listeners, function)

    def recent_events(self) -> list[Event]:
        return list(self.told)

    def on_event(self, function: Callable[[Event], None]) -> Listening:
        return Listening(self.event_listeners, function)

    def on_annotation(self, function: Callable[[Annotation], None]) -> Listening:
        return Listening(self.annotation_listeners, function)

    def on_command(self, function: Callable[[Applied], None], inline: bool) -> Listening:
        return Listening(self.command_listeners, function)

    def on_log(self, function: Callable[[LogEntry], None], inline: bool) -> Listening:
        return Listening(self.log_listeners, function)

    def close(self) -> None:
        self.closed = True

    def on_frame(self, function: Callable[[Frame], None], camera: str, **how: Any) -> Listening:
        self.requests.append((camera, how))
        return Listening(self.processors[camera], function)

    def _stream(self, camera: str, **how: Any) -> FakeStream:
        request = VideoRequest(camera, encoding="h264", **how)
        known = next((stream for stream in self.streams if stream.request == request), None)
        if known is None:
            known = FakeStream(request)
            self.streams.append(known)
        return known

    # For tests -------------------------------------------------------------------------------------------------

    def show(
        self,
        shade: int = 0,
        camera: str = "front",
        image: np.ndarray | None = None,
        captured_ns: int | None = None,
    ) -> Frame:
        """Take a picture with the camera, of a single shade unless an image is given."""
        width, height = self._size
        pixels = np.full((height, width, 3), shade, np.uint8) if image is None else image
        self._seq += 1
        now = self._shown_ns = max(monotonic_ns(), self._shown_ns + 1)  # no two within a step of a coarse clock
        header = FrameHeader(camera, self._seq, captured_ns or now, now, width, height, Encoding.BGR8, pixels.size)
        frame = ReceivedFrame(header, pixels.reshape(-1), now, 0, FeedbackHistory()).frame()
        for function in list(self.processors[camera]):
            function(frame)
        return frame

    def tell(self, text: str, kind: EventKind = EventKind.VEHICLE_MESSAGE, **values: Any) -> None:
        event = Event(kind, text, monotonic_ns(), **values)
        self.told.append(event)
        for function in list(self.event_listeners):
            function(event)

    def draw(self, annotation: Annotation) -> None:
        for function in list(self.annotation_listeners):
            function(annotation)


def flying(**values: Any) -> Feedback:
    """Return the feedback of a vehicle in the air."""
    known: dict[str, Any] = {
        "captured_ns": monotonic_ns(),
        "state": FlightState.FLYING,
        "battery": 0.8,
        "roll_rad": 0.1,
        "pitch_rad": -0.05,
        "yaw_rad": 1.0,
        "altitude_m": 1.25,
        "velocity_m_s": (0.3, -0.1, 0.0),
        "vehicle_link": LinkState.UP,
        "owner": "demo",
        "owner_id": 1,
        "owner_priority": 16,
        "lease": 3,
    }
    return Feedback(**(known | values))


class Flyer(Driver):
    """A vehicle with a camera ``front`` that follows each command at once and knows its position."""

    PERIOD_S = 0.02

    def __init__(self, *, position: bool = True, uri: str = "fake://flyer") -> None:
        super().__init__(VehicleUri("fake", text=uri))
        self.state = FlightState.LANDED
        self.applied: list[AnyAction] = []
        self.deaf = False  #: ignores all commands
        self.others = ""  #: the mode that someone else chose, until the vehicle is steered from here again
        self.taken: list[AnyAction] = []  #: actions that took it back
        self.battery = 0.9
        self.place = [0.0, 0.0, 0.0]
        self.yaw = 0.0
        self._velocity = Velocity()
        self._knows_position = position
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        actions = frozenset(ACTION_NAMES.values()) - {"position"}  # which the proxy emulates
        return Capabilities("fake", actions, (CameraInfo("front", 32, 24, 50.0),))

    def _open(self, sink: Sink) -> None:
        self._ended.clear()
        sink.link(LinkState.UP)
        self._thread = threading.Thread(target=self._run, args=(sink,), daemon=True, name="flyer")
        self._thread.start()

    def link(self, state: LinkState) -> None:
        """Report this state of the vehicle's link."""
        assert self._sink is not None
        self._sink.link(state, "told so")

    def _close(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _apply(self, action: AnyAction) -> AnyAction:
        self.applied.append(action)
        if self.deaf:
            return action
        if self.others and isinstance(action, Hover | Land | Takeoff):
            self.taken.append(action)
            self.others = ""
        self.state = NEXT.get(type(action), self.state)
        if ACTION_NAMES[type(action)] != "idle":
            self._velocity = action if isinstance(action, Velocity) else Velocity()
        return action

    def left_to(self) -> str:
        return self.others

    def _run(self, sink: Sink) -> None:
        while not self._ended.wait(self.PERIOD_S):
            v, c, s = self._velocity, math.cos(self.yaw), math.sin(self.yaw)
            moved = (c * v.forward - s * v.left, s * v.forward + c * v.left, v.up)
            self.place = [at + step * self.PERIOD_S for at, step in zip(self.place, moved, strict=True)]
            self.yaw += v.yaw_rate * self.PERIOD_S
            now_ns = monotonic_ns()
            sink.feedback(
                Feedback(
                    captured_ns=now_ns,
                    state=self.state,
                    battery=self.battery,
                    yaw_rad=self.yaw,
                    velocity_m_s=(v.forward, v.left, v.up),
                    position_m=(self.place[0], self.place[1], self.place[2]) if self._knows_position else None,
                )
            )
            if sink.wants("front"):
                picture = np.zeros((24, 32, 3), np.uint8)
                sink.frame("front", picture, now_ns, width=32, height=24, intrinsics=Intrinsics(30, 30, 16, 12))


class Node:
    """A proxy in this process that can be killed and started again."""

    def __init__(self, name: str = "alpha", **options: Any) -> None:
        self.name = name
        self.flyer = Flyer(**options)
        self.stops_lost = 0  #: number of emergency stop packets to lose on the way
        self._server = MemoryServer(name)
        self._proxy = Proxy(self.flyer, self._server, name=name)
        self._proxy.start()
        self.up = True

    def dial(self, handler: ClientHandler) -> TransportClient:
        client = self._server.dial(handler)
        send = client.send
        client.send = lambda packet: self._loses(packet) or send(packet)  # type: ignore[method-assign]
        return client

    def _loses(self, packet: bytes) -> bool:
        message = decode(packet) if self.stops_lost else None
        if not isinstance(message, Command) or not isinstance(message.action, EmergencyStop):
            return False
        self.stops_lost -= 1
        return True

    def connect(self, app: str, priority: int = 16, **options: Any) -> Drone:
        return open_drone(self.dial, app=app, **options, authority=Authority(priority=priority))

    def stop(self) -> None:
        if self.up:
            self.up = False
            self._proxy.end()

    def restart(self) -> None:
        self._proxy = Proxy(self.flyer, self._server, name=self.name)
        self._proxy.start()
        self.up = True


class Nodes:
    """A finder that finds the running nodes."""

    def __init__(self, *nodes: Node) -> None:
        self.nodes = list(nodes)
        self.wanted: list[str] = []

    def __call__(self) -> list[FoundProxy]:
        return [FoundProxy(node.name, "memory", node.dial) for node in self.nodes if node.up]

    def add_name(self, name: str) -> None:
        self.wanted.append(name)

    def close(self) -> None: ...


class FakeRecorder:
    """Writes a small file and reports that it is recording."""

    def __init__(self, drones: Sequence[str], folder: Path) -> None:
        self.path = folder / f"{'-'.join(drones)}.mcap"
        self.path.write_bytes(b"")
        self.closed = False

    @property
    def status(self) -> Status:
        state = RecorderState.CLOSED if self.closed else RecorderState.RECORDING
        dropped = {"alpha": {"video.front": 2}}
        return Status(state, path=str(self.path), files=(str(self.path),), seconds=1.5, bytes=1000, dropped=dropped)

    def close(self) -> None:
        self.closed = True


class EveryoneGate(OpenGate):
    """Admits every caller, where :class:`OpenGate` admits none: Windows has no user ids."""

    def person(self, scope: Scope) -> Person:
        return self._person


def this_user(role: Role = Role.PILOT) -> OpenGate:
    """Treat every caller as this user."""
    return EveryoneGate(role) if PLATFORM == "win32" else OpenGate(role, uid_of=lambda *_: os.geteuid())


def fake_fleet(drones: Mapping[str, FakeDrone]) -> CockpitFleet:
    """Return a fleet of drones that are found at once and never lost."""

    def dial(_: ClientHandler) -> TransportClient:
        raise LinkError("nobody flies this one")

    class Finder:
        def __call__(self) -> list[FoundProxy]:
            return [FoundProxy(name, "memory", dial) for name in drones]

        def add_name(self, name: str) -> None: ...

        def close(self) -> None: ...

    return CockpitFleet(Finder(), lambda found: drones[found.name])  # type: ignore[arg-type,return-value]


@contextmanager
def cockpit(
    fleet: CockpitFleet, gate: Gate | None = None, recordings: Recordings | None = None, **options: Any
) -> Iterator[TestClient]:
    """Return the cockpit's pages without a server."""
    names = own_names("127.0.0.1", 8123)
    app = create_app(fleet, recordings or Recordings(Path("nowhere")), names, gate or this_user(), **options)
    with TestClient(app, base_url=OWN) as client:
        yield client


def open_socket(client: TestClient, path: str, **headers: str) -> WebSocketTestSession:
    return client.websocket_connect(f"{SOCKETS}/{path}", headers={**ORIGIN, **headers})


def until(condition: Callable[[], Any], what: str = "it happened") -> None:
    """Wait for a condition that nothing signals."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s, still not true: {what}"
        time.sleep(0.002)
