"""The proxy's code kept warm while somebody flies: a second proxy, of no vehicle and for nobody, is flown meanwhile.

It is made of the same classes, so that the very instructions of commands, feedback and frames run, and of nothing that
a vehicle, an application, a file or the network could notice. See :mod:`skyloop.warmth`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from skyloop.clock import ManualClock, nanoseconds
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import LinkError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    AuthorityGranted,
    CameraInfo,
    Capabilities,
    Command,
    FrameHeader,
    Hello,
    LinkState,
    Reply,
    Request,
    RequestAuthority,
    Role,
    Velocity,
    decode,
    encode,
)
from skyloop.messages.feedback import typical_feedback
from skyloop.proxy.proxy import Proxy
from skyloop.transport.base import Peer, Pixels, ServerHandler, TransportServer
from skyloop.warmth import Pieces, Warmer

if TYPE_CHECKING:
    from skyloop.transport.local.frame_exchange import FrameExchange

_CAMERA: Final = "camera"
_SIDE: Final = 16  #: of its frames [pixels]
_ROUND_NS: Final = nanoseconds(1 / 32)  #: by which its clock goes on from round to round


def make_pieces() -> Pieces:
    """Make the second proxy, and return what gives it one command, one feedback and one frame.

    Raises:
        LinkError: It gave itself no authority: the code here is wrong.
    """
    clock, server, driver = ManualClock(), _Nowhere(), _Nothing()
    proxy = Proxy(driver, server, name="warm-up", clock=clock, ticker=False)
    peer = Peer(1, "nobody")
    proxy.handler.begin(clock())
    driver.open(proxy.publisher)
    driver.report(clock())
    proxy.peer_joined(peer)
    proxy.packet(peer, encode(Request(1, Hello("warm-up", Role.PILOT))))
    proxy.packet(peer, encode(Request(2, RequestAuthority(priority=0))))
    lease = server.lease
    if not lease:
        raise LinkError("the proxy that is flown for its code did not grant the authority")
    image = np.zeros((_SIDE, _SIDE, 3), np.uint8)
    rounds = 0

    def command() -> None:
        nonlocal rounds
        rounds += 1
        clock.now_ns += _ROUND_NS
        set_point = Velocity(forward=0.1, yaw_rate=0.1 if rounds % 2 else -0.1)
        proxy.packet(peer, encode(Command(rounds, lease, rounds, clock(), set_point)))

    return command, lambda: driver.report(clock()), lambda: driver.show(clock(), image)


#: That of this process: one keeps the code of all its proxies warm.
WARMER: Final = Warmer(make_pieces, "proxy")


def keep_warm(proxy: Proxy, unless: Callable[[], bool] = lambda: False) -> None:
    """Keep the code of this process's proxies warm while this one's vehicle is flown by a pilot.

    Args:
        proxy: Whose vehicle.
        unless: Whether to do without now.
    """
    proxy.keep_warm = lambda period_s: WARMER.keep(proxy, 0.0 if unless() else period_s)


class _Nothing(Driver):
    """A vehicle that is not there."""

    shared = False

    def __init__(self) -> None:
        super().__init__(VehicleUri("nothing"))

    def capabilities(self) -> Capabilities:
        return Capabilities("nothing", frozenset(ACTION_NAMES.values()), (CameraInfo(_CAMERA, _SIDE, _SIDE, 30.0),))

    def _open(self, sink: Sink) -> None:
        sink.link(LinkState.UP)

    def _close(self) -> None:
        """Nothing is open."""

    def _apply(self, action: AnyAction) -> AnyAction:
        return action

    def report(self, now_ns: int) -> None:
        """Report as much as a real vehicle does."""
        assert self._sink is not None
        self._sink.feedback(typical_feedback(now_ns))

    def show(self, now_ns: int, image: Pixels) -> None:
        """Give a frame."""
        assert self._sink is not None
        self._sink.frame(_CAMERA, image, now_ns, width=_SIDE, height=_SIDE)


class _Viewer:
    """Looks at the frames, and gives each back at once."""

    def transmit(self, packet: bytes) -> None:
        """Drop a packet."""

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        """Drop a packet with a descriptor."""


class _Nowhere(TransportServer):
    """Where nobody is connected, although the proxy believes that one application is."""

    def __init__(self) -> None:
        self.lease = 0
        self._viewer = _Viewer()
        self._exchange: FrameExchange | None = None
        if sys.platform == "linux":  # elsewhere there is no local transport, and no code of it to keep warm
            from skyloop.transport.local.frame_exchange import FrameExchange

            self._exchange = FrameExchange()
            self._exchange.subscribe(self._viewer, _CAMERA)

    def start(self, handler: ServerHandler) -> None:
        """Serve nobody."""

    def stop(self) -> None:
        """Nothing was started."""

    def send(self, peer: Peer, packet: bytes) -> bool:  # noqa: ARG002
        reply = decode(packet)
        if isinstance(reply, Reply) and isinstance(reply.body, AuthorityGranted):
            self.lease = reply.body.lease
        return True

    def publish(self, topic: str, packet: bytes) -> int:  # noqa: ARG002
        return 0

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        if self._exchange is None:
            return 0
        missed = self._exchange.publish(header, pixels)
        self._exchange.release(self._viewer, 1)
        return missed

    def subscribers(self, topic: str) -> int:
        return int(topic.startswith("video"))

    def disconnect(self, peer: Peer, reason: str) -> None:
        """Nobody is connected."""

    @property
    def address(self) -> str:
        return "nowhere"
