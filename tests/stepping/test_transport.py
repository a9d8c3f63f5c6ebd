"""The transport of stepped replays: everything on one thread, in order, each end notified once."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from skyloop.errors import LinkError, UsageError
from skyloop.messages import Encoding, FrameHeader
from skyloop.stepping.transport import StepExecutor, SteppedServer
from skyloop.transport.base import Peer, Pixels

PIXELS = np.arange(12, dtype=np.uint8)


class ServerSide:
    """A proxy that records its packets, and answers each one."""

    def __init__(self, server: SteppedServer) -> None:
        self.server = server
        self.heard: list[object] = []

    def peer_joined(self, peer: Peer) -> None:
        self.heard.append(("joined", peer.id, threading.current_thread().name))

    def packet(self, peer: Peer, packet: bytes) -> None:
        self.heard.append(packet)
        if packet == b"raise":
            raise ZeroDivisionError("a mistake")
        self.server.send(peer, b"re " + packet)

    def refused(self, peer: Peer, reason: str) -> None: ...

    def topic_problem(self, topic: str) -> str:
        return ""

    def malformed(self, peer: Peer, reason: str) -> None: ...

    def peer_left(self, peer: Peer, reason: str) -> None:
        self.heard.append(("left", reason))


class ClientSide:
    """An application that records its packets."""

    def __init__(self) -> None:
        self.heard: list[object] = []

    def packet(self, packet: bytes) -> None:
        self.heard.append(packet)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        self.heard.append((header.seq, pixels.tolist()))

    def closed(self, reason: str) -> None:
        self.heard.append(("closed", reason))


@pytest.fixture
def executor() -> Iterator[StepExecutor]:
    executor = StepExecutor("test-stepping")
    yield executor
    executor.close()
    executor.close()


@pytest.fixture
def server(executor: StepExecutor) -> SteppedServer:
    return SteppedServer(executor)


@pytest.fixture
def proxy(server: SteppedServer) -> ServerSide:
    proxy = ServerSide(server)
    server.start(proxy)
    return proxy


def settle(executor: StepExecutor) -> None:
    """Wait until all sent packets and their consequences are processed."""
    executor.call(executor.run_pending, lambda: None)


def frame(seq: int) -> FrameHeader:
    return FrameHeader("front", seq, 1, 2, 2, 2, Encoding.BGR8, 12)


def test_packets_and_answers_in_order_on_one_thread(
    executor: StepExecutor, server: SteppedServer, proxy: ServerSide
) -> None:
    application = ClientSide()
    end = server.dial(application)
    for number in range(3):
        assert end.send(b"%d" % number)
    settle(executor)
    assert proxy.heard == [("joined", 1, "test-stepping"), b"0", b"1", b"2"]
    assert application.heard == [b"re 0", b"re 1", b"re 2"]
    assert end.same_clock
    assert "one application" in end.address == server.address


def test_topics_and_frames(executor: StepExecutor, server: SteppedServer, proxy: ServerSide) -> None:
    application = ClientSide()
    assert server.publish("feedback", b"x") == 0  # no subscriber
    end = server.dial(application)
    server.publish("feedback", b"unwanted")
    server.publish_frame(frame(1), PIXELS)
    end.subscribe("feedback")
    end.subscribe("video/front")
    assert server.subscribers("feedback") == 1
    pixels = PIXELS.copy()
    server.publish("feedback", b"wanted")
    server.publish_frame(frame(2), pixels)
    pixels[:] = 0  # they may be reused at once
    end.subscribe("feedback", False)
    server.publish("feedback", b"no longer")
    settle(executor)
    assert application.heard == [b"wanted", (2, PIXELS.tolist())]
    with pytest.raises(UsageError):
        end.send(b"")
    with pytest.raises(UsageError):
        server.publish_frame(frame(3), PIXELS[:5])


def test_each_end_is_notified_once_when_the_application_leaves(
    executor: StepExecutor, server: SteppedServer, proxy: ServerSide
) -> None:
    application = ClientSide()
    end = server.dial(application)
    with pytest.raises(LinkError, match="in step with one application"):
        server.dial(ClientSide())
    end.send(b"last")
    end.close()
    end.close()
    assert not end.send(b"too late")
    settle(executor)
    assert proxy.heard[1:] == [b"last", ("left", "closed by the application")]
    assert application.heard == [("closed", "closed by the application")]
    assert not server.send(Peer(1, ""), b"gone")
    server.dial(ClientSide()).close()  # the next one may connect


def test_the_proxy_ends_a_connection_and_itself(
    executor: StepExecutor, server: SteppedServer, proxy: ServerSide
) -> None:
    application = ClientSide()
    server.dial(application)
    server.disconnect(Peer(7, "somebody else"), "no")
    server.disconnect(Peer(1, ""), "malformed")
    settle(executor)
    assert application.heard == [("closed", "malformed")]
    other = ClientSide()
    end = server.dial(other)
    server.stop()
    server.stop()
    settle(executor)
    assert other.heard == [("closed", "the replay has ended")]
    assert not end.send(b"x")
    with pytest.raises(LinkError, match="ended"):
        server.dial(ClientSide())


def test_started_twice(server: SteppedServer, proxy: ServerSide) -> None:
    with pytest.raises(UsageError, match="already being served"):
        server.start(proxy)


def test_a_handler_that_raises_does_not_end_the_world(
    executor: StepExecutor, server: SteppedServer, proxy: ServerSide, caplog: pytest.LogCaptureFixture
) -> None:
    application = ClientSide()
    end = server.dial(application)
    end.send(b"raise")
    end.send(b"go on")

    def wrong() -> None:
        raise ZeroDivisionError("another one")

    with pytest.raises(ZeroDivisionError, match="another one"):  # but the waiting caller gets the error
        executor.call(wrong, lambda: None)
    settle(executor)
    assert application.heard == [b"re go on"]
    assert "a step in simulated time failed" in caplog.text
