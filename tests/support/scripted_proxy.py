"""A proxy scripted by a test: it gives the configured answers, and records what it receives."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

import numpy as np

from skyloop.client import Authority
from skyloop.client.channels import Notifier
from skyloop.client.connection import RedialPolicy
from skyloop.client.drone import Drone, open_drone
from skyloop.client.monitoring import Thresholds
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    AnyReply,
    AnyRequest,
    Applied,
    AuthorityGranted,
    AuthorityQueued,
    CameraInfo,
    Capabilities,
    Command,
    Done,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FlightState,
    FrameHeader,
    GetParameter,
    Hello,
    ListParameters,
    Parameter,
    ParameterPage,
    ParameterType,
    ParameterValue,
    Ping,
    Pong,
    ProcessorResult,
    Refusal,
    Refused,
    ReleaseAuthority,
    Reply,
    Request,
    RequestAuthority,
    Sample,
    SetParameter,
    Severity,
    Value,
    Welcome,
    decode,
    encode,
)
from skyloop.messages.relayed import pack
from skyloop.transport.base import EVENTS, FEEDBACK, RESULTS, Peer, results
from skyloop.transport.memory import Faults, MemoryServer

WAIT_S = 10.0
CAMERAS = (CameraInfo("front", 8, 6, 30.0), CameraInfo("bottom", 8, 6, 30.0))

#: Short time limits, so that tests of lost links are quick.
QUICK = RedialPolicy(first_s=0.005, cap_s=0.05, hello_s=0.3, thresholds=Thresholds(late_s=0.1, silent_s=0.3))


class ScriptedProxy:
    """Serves one or more applications over the memory transport, with feedback every 10 ms."""

    def __init__(self, *, faults: Faults | None = None, can_fly: bool = True) -> None:
        self.server = MemoryServer("scripted", faults=faults)
        self.notifier = Notifier()
        self.commands: list[Command] = []
        self.requests: list[AnyRequest] = []
        self.others: list[Sample] = []
        self.answers: dict[type[AnyRequest], AnyReply | None] = {}  #: replace the usual answers; None for no answer
        self.parameters = {"limits.tilt": 0.35, "limits.speed": 2.0}
        self.state = FlightState.LANDED
        self.owner: tuple[int, str, int] | None = None  #: application id, name, lease
        self.more: dict[str, Any] = {}  #: further fields of feedback
        self.beating = threading.Event()
        self.capabilities = Capabilities(
            "scripted",
            frozenset(ACTION_NAMES.values()) if can_fly else frozenset(),
            CAMERAS,
            why_not="" if can_fly else "it has no motors",
        )
        self.run_id = random.getrandbits(40)  # so that sessions of other tests' proxies are not mistaken for this one's
        self.momentary: set[str] = set()  #: parameters for which each write triggers an action
        self.forgets = True  #: whether an application that leaves loses the authority at once
        self._peers: dict[int, tuple[Peer, str]] = {}
        self._lock = threading.Lock()
        self.first_lease = 1  #: first lease of the next run; higher if others held the authority in it before
        self._leases = 0
        self._seq = 0
        self._event_seq = 0
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> Self:
        self._ended.clear()
        self.run_id += 1
        self._seq = self._event_seq = 0
        self._leases = self.first_lease - 1
        self.owner = None
        self.server.start(self)
        self.beating.set()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="scripted-beat")
        self._thread.start()
        return self

    def stop(self) -> None:
        """End everything, as after a SIGKILL."""
        self._ended.set()
        self.beating.set()
        if self._thread is not None:
            self._thread.join()
        self.server.stop()

    # For tests: observing --------------------------------------------------------------------------------------

    def actions(self) -> list[AnyAction]:
        return [command.action for command in list(self.commands)]

    def until(self, ready: Callable[[], bool], what: str = "what was waited for") -> None:
        assert self.notifier.wait_for(ready, WAIT_S), f"{what} did not happen"

    def until_commanded(self, action: AnyAction, after: int = 0) -> Command:
        """Wait for this action after the first ``after`` commands; return its command."""
        self.until(lambda: action in self.actions()[after:], f"{action!r}")
        return next(command for command in self.commands[after:] if command.action == action)

    def from_now_on(self, action: AnyAction, times: int = 4) -> list[Command]:
        """Wait for this many commands with the action; return all from the first of them on."""
        after = len(self.commands)
        self.until(lambda: self.actions()[after:].count(action) >= times, f"{action!r}, repeatedly")
        later = self.commands[after:]
        return later[[command.action for command in later].index(action) :]

    # For tests: controlling --------------------------------------------------------------------------------------

    def publish(self, sample: Feedback | Event | Applied, topic: str) -> None:
        self.server.publish(topic, encode(sample))

    def event(self, kind: EventKind, text: str = "", app: str | None = None, **data: Value) -> None:
        self._event_seq += 1
        now_ns = time.monotonic_ns()
        self.publish(Event(kind, text, now_ns, Severity.INFO, self._event_seq, app, data), EVENTS)

    def feedback(self, **fields: Any) -> Feedback:
        """Publish one sample and return it."""
        with self._lock:
            return self._feedback(fields)

    def _feedback(self, fields: dict[str, Any]) -> Feedback:
        self._seq += fields.pop("skip", 0) + 1
        now_ns = time.monotonic_ns()
        owner_id, owner, lease = self.owner or (0, None, 0)
        known: dict[str, Any] = {
            "captured_ns": now_ns,
            "published_ns": now_ns,
            "state": self.state,
            "vehicle_link": "up",
        }
        known |= {"owner_id": owner_id, "owner": owner, "lease": lease, "seq": self._seq} | self.more | fields
        sample = Feedback(**known)
        self.publish(sample, FEEDBACK)
        return sample

    def frame(self, seq: int, camera: str = "front", *, value: int = 0, **fields: Any) -> None:
        now_ns = time.monotonic_ns()
        size = fields.pop("size", 144)
        header = FrameHeader(camera, seq, now_ns, now_ns, 8, 6, fields.pop("encoding", Encoding.BGR8), size, **fields)
        self.server.publish_frame(header, np.full(size, value, np.uint8))

    def grant(self, app_id: int, name: str) -> int:
        self._leases += 1
        self.owner = (app_id, name, self._leases)
        return self._leases

    def take_over(self, by: str = "boss") -> None:
        """Let another application pre-empt the holder."""
        assert self.owner is not None
        app_id, name, lease = self.owner
        self.grant(99, by)
        self.event(EventKind.AUTHORITY_PREEMPTED, "", name, app_id=app_id, lease=lease, by=by, by_id=99, by_priority=0)

    def give_back(self, app_id: int, name: str) -> None:
        lease = self.grant(app_id, name)
        self.event(EventKind.AUTHORITY_GRANTED, "", name, app_id=app_id, priority=16, lease=lease)

    def hang_up(self) -> None:
        """End all connections."""
        for peer, _ in list(self._peers.values()):
            self.server.disconnect(peer, "hung up")

    def garbage(self) -> None:
        for peer, _ in list(self._peers.values()):
            self.server.send(peer, b"garbage")

    # Transport -------------------------------------------------------------------------------------------------

    def peer_joined(self, peer: Peer) -> None:
        self._peers[peer.id] = (peer, "")

    def refused(self, peer: Peer, reason: str) -> None: ...

    def topic_problem(self, topic: str) -> str:
        return ""

    def malformed(self, peer: Peer, reason: str) -> None: ...

    def peer_left(self, peer: Peer, reason: str) -> None:
        self._peers.pop(peer.id, None)
        if self.forgets and self.owner is not None and self.owner[0] == peer.id:
            self.owner = None
        self.notifier.notify()

    def packet(self, peer: Peer, packet: bytes) -> None:
        sample = decode(packet)
        if isinstance(sample, Command):
            self.commands.append(sample)
        elif isinstance(sample, Request):
            self.requests.append(sample.body)
            answer = self._answer(peer, sample.body)
            if answer is not None:
                self.server.send(peer, encode(Reply(sample.id, answer)))
        else:
            self.others.append(sample)
        self.notifier.notify()

    def _answer(self, peer: Peer, body: AnyRequest) -> AnyReply | None:
        if isinstance(body, Hello):
            self._peers[peer.id] = (peer, body.name)
        if type(body) in self.answers:
            return self.answers[type(body)]
        if isinstance(body, Hello):
            now_ns = time.monotonic_ns()
            return Welcome(peer.id, "scripted", self.run_id, 1, "scripted://", now_ns, self.capabilities)
        if isinstance(body, Ping):
            return Pong(body.sent_ns, time.monotonic_ns())
        if isinstance(body, RequestAuthority):
            if self.owner is not None and self.owner[0] != peer.id:
                return AuthorityQueued(1, self.owner[1], 0)
            return AuthorityGranted(self.grant(peer.id, self._peers[peer.id][1]))
        if isinstance(body, ReleaseAuthority):
            if self.owner is not None and self.owner[0] == peer.id:
                self.owner = None
            return Done()
        return self._answer_parameters(body)

    def _answer_parameters(self, body: AnyRequest) -> AnyReply:
        if isinstance(body, ListParameters):
            names = sorted(self.parameters)
            page = tuple(self._parameter(name) for name in names[body.first : body.first + 1])
            return ParameterPage(len(names), body.first, page)
        if not isinstance(body, GetParameter | SetParameter):
            return Refused(Refusal.PROTOCOL, "what?")
        if body.name not in self.parameters:
            return Refused(Refusal.UNKNOWN_PARAMETER, f"no {body.name}")
        if isinstance(body, SetParameter):
            if self.owner is None or body.lease != self.owner[2]:
                return Refused(Refusal.FOREIGN_LEASE, "not yours")
            if not isinstance(body.value, float):
                return Refused(Refusal.WRONG_TYPE, "takes a float")
            self.parameters[body.name] = body.value
        return ParameterValue(self._parameter(body.name))

    def _parameter(self, name: str) -> Parameter:
        return Parameter(name, ParameterType.FLOAT, self.parameters[name], "rad", momentary=name in self.momentary)

    def _beat(self) -> None:
        while not self._ended.wait(0.01):
            self.beating.wait(WAIT_S)
            if not self._ended.is_set():
                self.feedback()


@contextmanager
def scripted(**options: Any) -> Iterator[ScriptedProxy]:
    """Provide a started proxy."""
    proxy = ScriptedProxy(**options).start()
    try:
        yield proxy
    finally:
        proxy.stop()


@contextmanager
def flown(proxy: ScriptedProxy, *, app: str = "me", wait_s: float = 0.0, **options: Any) -> Iterator[Drone]:
    """Return a drone connected to it, which is closed at the end without landing."""
    options.setdefault("policy", QUICK)
    drone = open_drone(proxy.server.dial, app=app, **options, authority=Authority(wait_s=wait_s), timeout_s=WAIT_S)
    try:
        yield drone
    finally:
        drone.close()


def background(*steps: Callable[[], object]) -> threading.Thread:
    """Provide a function that runs others in turn on another thread."""

    def run() -> None:
        for step in steps:
            step()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


class Sender:
    """A worker scripted by the test; its frames are numbered, and a tenth of a second apart."""

    def __init__(self, proxy: ScriptedProxy, processor: str = "detector", worker: int = 7) -> None:
        self.proxy = proxy
        self.processor = processor
        self.worker = worker
        self.number = 0

    def send(
        self, seq: int, value: Any = None, *, age_s: float = 0.0, payload: bytes | None = None, **changes: Any
    ) -> ProcessorResult:
        self.number = changes.pop("number", self.number + 1)
        now_ns = time.monotonic_ns()
        captured_ns = now_ns - round(age_s * 1e9)
        data = pack(value) if payload is None else payload
        result = ProcessorResult(
            self.processor, "front", seq, captured_ns, now_ns, 20_000_000, self.number, data, self.worker
        )
        for topic in (RESULTS, results(self.processor)):
            self.proxy.server.publish(topic, encode(result))
        return result
