"""Workers over the network transport: each receives only the frames of its part."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from skyloop.client import Drone, Frame, Result
from skyloop.processing import Settings, Worker
from tests.support.nodes import WAIT_S, Node, far_node


class Number:
    def process(self, frame: Frame) -> int:
        return frame.seq


@pytest.fixture
def node() -> Iterator[Node]:
    pytest.importorskip("zenoh", reason="the network needs the extra 'network'")
    node = far_node()
    with node.proxy:
        yield node


@contextmanager
def working(node: Node) -> Iterator[tuple[Drone, Worker]]:
    with node.connected(access="observe") as drone:
        worker = Worker(drone, Number(), Settings("number", "Number 1"))
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            yield drone, worker
        finally:
            worker.stop()
            thread.join(WAIT_S)


def asked_for(drone: Drone) -> list[tuple[int, int] | None]:
    """Return the subscribed parts of the frames."""
    return [channel.request.part for channel in drone._state.video.by_topic.values() if channel.subscribed]


def test_only_the_frames_of_a_part_travel(node: Node) -> None:
    got: list[Result] = []
    with node.connected(access="observe") as eye, eye.on_result(got.append, "number", inline=True, max_age_s=WAIT_S):
        with working(node) as (near, one):
            eye.wait(lambda _: len(got) >= 3, WAIT_S)
            assert asked_for(near) == [None]
            with working(node) as (far, two):
                eye.wait(lambda _: one.status.parts == two.status.parts == 2, WAIT_S)
                eye.wait(lambda _: (asked_for(near), asked_for(far)) == ([(0, 2)], [(1, 2)]), WAIT_S)
                begin = got[-1].seq
                eye.wait(lambda _: len([result for result in got if result.seq > begin]) >= 10, WAIT_S)
            eye.wait(lambda _: asked_for(near) == [None], WAIT_S)
        assert asked_for(near) == []
    assert all(result.value == result.seq for result in got)
    workers = {parity: {result.worker for result in got if result.seq % 2 == parity} for parity in (0, 1)}
    assert len(workers[0] | workers[1]) == 2
