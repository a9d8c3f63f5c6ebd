"""An application's code kept warm while it flies: a second drone, connected to nothing, is flown meanwhile.

It is made of the same classes, so that the very instructions of commands, feedback and frames run, and of nothing that
a proxy or the application could notice. See :mod:`skyloop.warmth`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from skyloop.client.channels import Notifier
from skyloop.client.connection import ConnectionSupervisor, Scheduler
from skyloop.client.core import DroneCore
from skyloop.client.drone import Drone
from skyloop.clock import ManualClock, nanoseconds
from skyloop.errors import UsageError
from skyloop.messages import (
    ACTION_NAMES,
    AnyReply,
    AuthorityGranted,
    CameraInfo,
    Capabilities,
    Encoding,
    FrameHeader,
    Hello,
    LinkState,
    Reply,
    Request,
    RequestAuthority,
    Welcome,
    decode,
    encode,
)
from skyloop.messages.feedback import typical_feedback
from skyloop.transport.base import ClientHandler, TransportClient
from skyloop.warmth import SHORTEST_S, Pieces, Warmer

_CAMERA: Final = "camera"
_SIDE: Final = 16  #: of its frames [pixels]
_ROUND_NS: Final = nanoseconds(1 / 32)  #: by which its clock goes on from round to round
_APP: Final = 1


def make_pieces() -> Pieces:
    """Make the second drone, and return what brings it one feedback, one frame, and sends one command.

    Raises:
        SkyloopError: It could not connect to itself: the code here is wrong.
    """
    clock = ManualClock()
    scheduler = _OwnTime(clock)
    ends: list[_Echo] = []

    def dial(handler: ClientHandler) -> _Echo:
        ends.append(_Echo(handler, clock))
        return ends[-1]

    core = DroneCore(dial, app="warm-up", scheduler=scheduler)
    core.open()
    (end,) = ends
    drone = Drone(core)
    session = core.connection.session
    assert session is not None
    inbox = core.inbox(frames=True)
    inbox.__enter__()
    pixels = np.zeros(_SIDE * _SIDE * 3, np.uint8)
    rounds = 1

    def feedback() -> None:
        nonlocal rounds
        rounds += 1
        clock.now_ns += _ROUND_NS
        session.packet(_feedback(rounds, clock()))
        inbox.feedback.take()

    def frame() -> None:
        now_ns = clock()
        header = FrameHeader(_CAMERA, rounds, now_ns, now_ns, _SIDE, _SIDE, Encoding.BGR8, pixels.size)
        end.coming = lambda: session.frame(header, pixels)
        inbox.notifier.wait_for(lambda: inbox.waiting, 1.0)
        inbox.frame()

    def command() -> None:
        drone.velocity(forward=0.1, yaw_rate=0.1 if rounds % 2 else -0.1)

    return feedback, frame, command


#: That of this process: one keeps the code of all its drones warm.
WARMER: Final = Warmer(make_pieces, "client")


def keeper(period_s: float) -> Callable[[bool], None]:
    """Return what one drone calls with whether it is flown from here.

    Args:
        period_s: How often the code is run while it is [s]; 0: never.

    Raises:
        UsageError: It is neither 0 nor from 0.001 to 1.
    """
    if not (period_s == 0.0 or SHORTEST_S <= period_s <= 1.0):
        raise UsageError(f"warm_s is {period_s!r} and must be from {SHORTEST_S:g} to 1 s, or 0 for never")
    who = object()
    return lambda flies: WARMER.keep(who, period_s if flies else 0.0)


def _feedback(seq: int, now_ns: int) -> bytes:
    state = typical_feedback(now_ns)
    ours = {"vehicle_link": LinkState.UP, "owner": "warm-up", "owner_id": _APP, "lease": 1}
    return encode(msgspec.structs.replace(state, seq=seq, published_ns=now_ns, **ours))


class _OwnTime(Scheduler):
    """Time that only the rounds make go on; whoever waits attends to the connection instead."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(clock)
        self._supervisor: ConnectionSupervisor | None = None

    def notifier(self) -> Notifier:
        return _Attending(self)

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        self._supervisor = supervisor

    def attend(self) -> None:
        """Do what the connection's thread does."""
        if self._supervisor is not None:
            self._supervisor.attend()


class _Attending(Notifier):
    """Attends to the connection in place of waiting."""

    __slots__ = ("_time",)

    def __init__(self, time: _OwnTime) -> None:
        super().__init__()
        self._time = time

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:  # noqa: ARG002
        if not ready():
            self._time.attend()
        return ready()


class _Echo(TransportClient):
    """Answers what a drone asks at first, and drops everything else."""

    def __init__(self, handler: ClientHandler, clock: ManualClock) -> None:
        self._handler = handler
        self._clock = clock
        self._open = False
        self.coming: Callable[[], None] = _nothing  #: what comes when somebody waits

    def send(self, packet: bytes) -> bool:
        if not self._open:
            sample = decode(packet)
            answer = self._answer(sample.body) if isinstance(sample, Request) else None
            if isinstance(sample, Request) and answer is not None:
                self._handler.packet(encode(Reply(sample.id, answer)))
        return True

    def _answer(self, asked: object) -> AnyReply | None:
        if isinstance(asked, Hello):
            actions = frozenset(ACTION_NAMES.values())
            cameras = (CameraInfo(_CAMERA, _SIDE, _SIDE, 30.0),)
            return Welcome(_APP, "warm-up", 1, 1, "nothing://", self._clock(), Capabilities("", actions, cameras))
        if isinstance(asked, RequestAuthority):
            self._open = True
            return AuthorityGranted(1)
        return None

    def subscribe(self, topic: str, on: bool = True) -> None:
        """Bring the first feedback when it is subscribed to."""
        if topic == "feedback" and on:
            self._handler.packet(_feedback(1, self._clock()))

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:  # noqa: ARG002
        self.coming()
        return ready()

    def close(self) -> None:
        """Nothing is open."""

    @property
    def same_clock(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return "nowhere"


def _nothing() -> None:
    """Nothing comes."""
