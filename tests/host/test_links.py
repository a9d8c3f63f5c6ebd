"""Links that share a thread: each is served when readable or due, and a failing one harms no other."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from skyloop.drivers.base import Sink
from skyloop.host.threads import LinkThread
from skyloop.transport.testing import wait_until
from tests.host.fleet import Hosting, Vehicle, closing_reason
from tests.support.systems import only_on

pytestmark = only_on("linux", "darwin", reason="each link has a thread of its own")

FAR_NS = 3600 * 10**9


class Link:
    """Counts how often it is served; :meth:`wake` makes it readable."""

    def __init__(self) -> None:
        self.far, self.near = socket.socketpair()
        self.near.setblocking(False)
        self.served = 0
        self.ended = threading.Event()
        self.stopping = False
        self.period_ns = FAR_NS
        self.raises = False
        self.hangs = threading.Event()
        self.hangs.set()

    def fileno(self) -> int:
        return self.near.fileno()

    def serve(self, *, readable: bool) -> int | None:
        if self.stopping:
            return None
        self.served += 1
        self.hangs.wait(10.0)
        if self.raises:
            raise ValueError("broken")
        with suppress(BlockingIOError):
            self.near.recv(100)
        return time.monotonic_ns() + self.period_ns

    def end(self) -> None:
        self.near.close()
        self.far.close()
        self.ended.set()

    def wake(self) -> None:
        self.far.send(b"x")


@contextmanager
def threads(*links: Link) -> Iterator[LinkThread]:
    thread = LinkThread({link: link for link in links})
    try:
        wait_until(lambda: all(link.served for link in links), "each is served once")
        yield thread
    finally:
        for link in links:
            link.raises, link.stopping = False, True
            link.hangs.set()
            if not link.ended.is_set():
                link.wake()
        wait_until(lambda: all(link.ended.is_set() for link in links), "all have ended")
        thread.close()


def test_a_link_is_served_when_readable_and_when_due() -> None:
    one, two = Link(), Link()
    two.period_ns = 1_000_000
    with threads(one, two):
        wait_until(lambda: two.served > 5, "the link due soon is served again")
        assert one.served == 1
        one.wake()
        wait_until(lambda: one.served == 2, "the readable link is served")


def test_a_link_that_ends_is_no_longer_served() -> None:
    one, two = Link(), Link()
    with threads(one, two):
        one.stopping = True
        one.wake()
        assert one.ended.wait(5.0)
        two.wake()
        wait_until(lambda: two.served == 2, "the other continues")


def test_a_failing_link_is_retried_after_pauses_beside_the_others() -> None:
    one, two = Link(), Link()
    with threads(one, two):
        one.raises = True
        begun = time.monotonic()
        one.wake()  # and never read it
        wait_until(lambda: one.served >= 5, "it is retried")
        assert time.monotonic() - begun > 0.05, "not continuously"
        two.wake()
        wait_until(lambda: two.served == 2, "the other is served")
        one.raises = False
        count = one.served
        wait_until(lambda: one.served > count, "it is served again")


def test_a_link_that_hangs_keeps_its_thread_and_the_others_get_a_new_one() -> None:
    one, two = Link(), Link()
    with threads(one, two) as thread:
        one.hangs.clear()
        one.wake()
        wait_until(lambda: one.served == 2, "it hangs")
        assert thread.inside is one
        new = thread.split(one)
        two.wake()
        wait_until(lambda: two.served >= 2, "the other is served by the new thread")
        count = two.served
        one.hangs.set()
        wait_until(lambda: thread.inside is None, "it returns")
        two.wake()
        wait_until(lambda: two.served > count, "the other is still the new thread's")
        two.stopping = True
        two.wake()
        assert two.ended.wait(5.0)
        new.close()


class Linked(Vehicle):
    """A vehicle whose link the host serves."""

    def __init__(self) -> None:
        super().__init__()
        self.own_link = Link()

    def _open(self, sink: Sink) -> None:
        super()._open(sink)
        assert self.serve_link is not None
        self.serve_link(self.own_link)


def test_a_vehicle_whose_link_hangs_ends_alone(hosting: Hosting) -> None:
    stuck, good = Linked(), Linked()
    hosting.drivers.update(stuck=stuck, good=good)
    hosting.add("stuck")
    hosting.add("good")
    witness = hosting.app("stuck")
    stuck.own_link.hangs.clear()
    stuck.own_link.wake()
    wait_until(lambda: hosting.condition("stuck") == "failed", "it was dropped")
    assert "its driver hangs" in closing_reason(witness)
    count = good.own_link.served
    good.own_link.wake()
    wait_until(lambda: good.own_link.served > count, "the other's link is served")
    assert hosting.condition("good") == "running"
    stuck.own_link.hangs.set()
    assert stuck.own_link.ended.wait(5.0), "its thread ends with it"
    hosting.host.close()
    assert good.own_link.ended.wait(5.0)
