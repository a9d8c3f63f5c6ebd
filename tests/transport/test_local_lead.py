"""An application's own thread receives while it waits; otherwise the receiving thread does."""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
import warnings
from collections.abc import Iterator

import pytest

from skyloop.transport.base import FEEDBACK, video
from skyloop.transport.local import LocalServer, dial
from skyloop.transport.local.client import LocalClient
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture, wait_until
from tests.support.systems import only_on

pytestmark = pytest.mark.usefixtures("side")
_names = (f"lead-{number}" for number in itertools.count())


class Pair:
    """A server, and a client whose log notes the thread that received each packet."""

    def __init__(self) -> None:
        name = next(_names)
        self.server, self.there, self.here = LocalServer(name), ServerLog(), ClientLog()
        self.threads: list[str] = []
        self.here.on_packet = lambda _: self.threads.append(threading.current_thread().name)
        self.server.start(self.there)
        client = dial(name)(self.here)
        assert isinstance(client, LocalClient)
        self.client = client
        client.subscribe(FEEDBACK)
        wait_until(lambda: self.server.subscribers(FEEDBACK), "it has subscribed")

    def send(self, packet: bytes) -> None:
        assert self.server.publish(FEEDBACK, packet) == 0

    def lead(self, count: int, timeout_s: float = 10.0) -> None:
        """Wait on this thread for ``count`` packets, as a notifier does."""
        offered = threading.Event()
        deadline = time.monotonic() + timeout_s
        while len(self.here.packets) < count and time.monotonic() < deadline:
            if not self.client.lead(lambda: len(self.here.packets) >= count, offered.set, 1.0):
                offered.wait(0.01)
                offered.clear()


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    try:
        yield pair
    finally:
        pair.client.close()
        pair.server.stop()


def make_it_lead(pair: Pair) -> threading.Thread:
    """Start a thread that leads from the first packet on, until there are three."""
    thread = threading.Thread(target=pair.lead, args=(3,), name="waiting")
    thread.start()
    wait_until(lambda: pair.client._candidate, "it is ready to lead")
    pair.send(b"one")
    wait_until(lambda: pair.client._receiver == thread.ident, "it leads")
    return thread


def test_a_waiting_thread_receives_its_own_packets(pair: Pair) -> None:
    thread = make_it_lead(pair)
    pair.send(b"two")
    pair.send(b"three")
    thread.join(10.0)
    assert pair.here.packets == [b"one", b"two", b"three"]
    assert pair.threads[1:] == ["waiting", "waiting"]
    assert pair.threads[0] != "waiting"


def test_the_receiving_thread_continues_when_the_other_is_busy(pair: Pair) -> None:
    make_it_lead(pair)
    pair.send(b"two")
    pair.send(b"three")
    wait_until(lambda: len(pair.here.packets) == 3, "its wait is over")
    wait_until(lambda: pair.client._receiver == pair.client._thread.ident, "the receiving thread has its turn again")
    pair.send(b"four")
    wait_until(lambda: len(pair.here.packets) == 4, "the packet arrived nevertheless")
    assert pair.threads[3] == pair.client._thread.name


def test_a_wait_that_ends_without_a_packet_returns(pair: Pair) -> None:
    thread = make_it_lead(pair)
    pair.here.packets += [b"from elsewhere"] * 2
    thread.join(10.0)
    assert not thread.is_alive()


def test_the_connection_also_ends_for_a_leading_thread(pair: Pair) -> None:
    thread = make_it_lead(pair)
    pair.server.stop()
    wait_until(lambda: pair.here.closings, "the client is notified")
    assert pair.here.closings == ["the proxy stopped"]
    assert not pair.client.lead(lambda: False, lambda: None, 1.0)
    pair.here.packets += [b"nothing", b"more"]
    thread.join(10.0)
    assert not thread.is_alive()


def test_a_leading_thread_may_close_the_connection(pair: Pair) -> None:
    thread = make_it_lead(pair)
    closed = threading.Event()

    def close(_: bytes) -> None:
        assert pair.client.receiving
        pair.client.close()
        closed.set()

    pair.here.on_packet = close
    pair.send(b"two")
    assert closed.wait(10.0)
    wait_until(lambda: pair.here.closings == ["closed by the application"], "the client is notified")
    pair.here.packets += [b"nothing", b"more"]
    thread.join(10.0)
    assert not thread.is_alive()


def test_a_failing_handler_ends_the_connection_but_not_the_leading_thread(pair: Pair) -> None:
    thread = make_it_lead(pair)

    def fail(_: bytes) -> None:
        raise RuntimeError("the application is broken")

    pair.here.on_packet = fail
    pair.send(b"two")
    wait_until(lambda: pair.here.closings, "the client is notified")
    assert "the application is broken" in pair.here.closings[0]
    assert thread.is_alive()
    pair.here.packets += [b"nothing", b"more"]
    thread.join(10.0)
    assert not thread.is_alive()


def test_a_frame_dropped_during_a_delivery_is_released_after_it(pair: Pair) -> None:
    pair.client.subscribe(video(FRONT))
    wait_until(lambda: pair.server.subscribers(video(FRONT)), "it has subscribed")
    pair.here.keep = False
    for seq in range(1, 40):
        head = header(seq)
        wait_until(lambda head=head: pair.server.publish_frame(head, picture(head)) == 0, "sent")  # type: ignore[misc]
        wait_until(lambda seq=seq: pair.here.saw(seq), "the frame arrived")  # type: ignore[misc]
    assert pair.here.torn == []


@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="signals run on the main thread")
@pytest.mark.parametrize("error", [TimeoutError, KeyboardInterrupt, ValueError])
def test_a_signal_handlers_exception_reaches_the_waiting_thread_and_the_connection_survives(
    pair: Pair, error: type[BaseException]
) -> None:
    def raise_it(*_: object) -> None:
        raise error("time is up")

    main = threading.main_thread()
    assert main.ident is not None

    def interrupt() -> None:
        wait_until(lambda: pair.client._candidate, "it is ready to lead")
        pair.send(b"one")
        wait_until(lambda: pair.client._receiver == main.ident, "it leads")
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, raise_it)
    helper = threading.Thread(target=interrupt)
    try:
        helper.start()
        with pytest.raises(error, match="time is up"):
            pair.lead(3)
    finally:
        helper.join(10.0)
        signal.signal(signal.SIGUSR1, before)
    pair.send(b"two")
    wait_until(lambda: pair.here.packets == [b"one", b"two"], "the receiving thread continues")
    assert pair.here.closings == []


@only_on("linux", "darwin", reason="no process forks")
def test_the_end_of_a_fork_leaves_the_connection_to_the_parent(pair: Pair) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about forks beside threads, from Python 3.12
        child = os.fork()
    if child == 0:
        sent = pair.client.send(b"from a fork")
        pair.client.close()
        os._exit(int(sent))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, "the fork can send nothing"
    pair.send(b"still there")
    wait_until(lambda: pair.here.packets == [b"still there"], "the parent's connection still works")
    assert pair.there.left == []
