"""Assignment of slots to viewers, without sockets."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from skyloop.messages import Encoding, FrameHeader
from skyloop.transport.local import packets
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.frame_exchange import MAX_LEASES, FrameExchange
from skyloop.transport.testing import header, picture


class FakeConnection:
    """Accepts packets until it is full."""

    def __init__(self) -> None:
        self.full = False
        self.messages: list[packets.Message] = []

    def transmit(self, packet: bytes) -> None:
        if self.full:
            raise BlockingIOError
        self.messages.append(packets.parse(packet))

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        assert os.fstat(descriptor).st_size > 0
        self.transmit(packet)

    @property
    def frames(self) -> list[packets.Frame]:
        return [message for message in self.messages if isinstance(message, packets.Frame)]

    @property
    def slots(self) -> list[packets.Slot | packets.NamedSlot]:
        return [message for message in self.messages if isinstance(message, (packets.Slot, packets.NamedSlot))]


@pytest.fixture
def exchange(side: str) -> FrameExchange:
    return FrameExchange(find_directory().serving.new_slot)


@pytest.fixture
def viewer(exchange: FrameExchange) -> FakeConnection:
    connection = FakeConnection()
    exchange.subscribe(connection, "front")
    return connection


@pytest.fixture(autouse=True)
def memory_is_given_back(exchange: FrameExchange) -> Iterator[None]:
    before = shared_bytes()
    yield
    exchange.__init__(find_directory().serving.new_slot)  # type: ignore[misc]
    gc.collect()
    assert shared_bytes() == before


def shared_bytes() -> int:
    """Return the size of this process's mapped shared memory [bytes]."""
    total = 0
    for line in Path("/proc/self/maps").read_text().splitlines():
        if "/memfd:skyloop" in line or "/dev/shm/sky-" in line or "/memfd:as-on" in line:
            start, end = line.split()[0].split("-")
            total += int(end, 16) - int(start, 16)
    return total


def publish(exchange: FrameExchange, head: FrameHeader) -> int:
    return exchange.publish(head, picture(head))


def test_nothing_is_copied_without_viewers(exchange: FrameExchange) -> None:
    before = shared_bytes()
    assert publish(exchange, header(1)) == 0
    assert shared_bytes() == before


def test_a_slot_is_announced_once_and_reused_when_released(exchange: FrameExchange, viewer: FakeConnection) -> None:
    for seq in range(10):
        assert publish(exchange, header(seq)) == 0
        assert exchange.release(viewer, viewer.frames[-1].slot)
    assert len(viewer.slots) == 1
    assert [frame.header.seq for frame in viewer.frames] == list(range(10))


def test_leases_are_bounded_and_the_newest_waits(exchange: FrameExchange, viewer: FakeConnection) -> None:
    missed = [publish(exchange, header(seq)) for seq in range(10)]
    assert missed == [0] * MAX_LEASES + [1] * (10 - MAX_LEASES)
    assert len({frame.slot for frame in viewer.frames}) == MAX_LEASES
    assert exchange.release(viewer, viewer.frames[0].slot)
    assert viewer.frames[-1].header.seq == 9, "the newest follows a release at once"
    assert exchange.release(viewer, viewer.frames[1].slot)
    assert len(viewer.frames) == MAX_LEASES + 1, "and only once"


def test_one_viewers_leases_do_not_delay_others(exchange: FrameExchange, viewer: FakeConnection) -> None:
    fast = FakeConnection()
    exchange.subscribe(fast, "front")
    for seq in range(50):
        publish(exchange, header(seq))
        assert fast.frames[-1].header.seq == seq
        assert exchange.release(fast, fast.frames[-1].slot)
    held = {frame.slot for frame in viewer.frames}
    assert all(frame.slot not in held for frame in fast.frames[MAX_LEASES:])
    assert shared_bytes() <= (2 * MAX_LEASES + 2) * 4096


def test_a_full_socket_gets_the_newest_at_its_next_release(exchange: FrameExchange, viewer: FakeConnection) -> None:
    publish(exchange, header(0))
    viewer.full = True
    assert [publish(exchange, header(seq)) for seq in (1, 2)] == [1, 1]
    viewer.full = False
    assert exchange.release(viewer, viewer.frames[0].slot)
    assert [frame.header.seq for frame in viewer.frames] == [0, 2]


def test_a_full_socket_gets_the_newest_when_it_has_room_after_all_releases(
    exchange: FrameExchange, viewer: FakeConnection
) -> None:
    """TCP may have no room yet when the last release arrives: a stopped reader that continued never got the newest."""
    publish(exchange, header(0))
    viewer.full = True
    assert publish(exchange, header(1)) == 1
    assert exchange.release(viewer, viewer.frames[0].slot)
    viewer.full = False
    exchange.retry(viewer)
    exchange.retry(viewer)
    exchange.retry(FakeConnection())
    assert [frame.header.seq for frame in viewer.frames] == [0, 1]


def test_releasing_a_slot_not_held_changes_nothing(exchange: FrameExchange, viewer: FakeConnection) -> None:
    publish(exchange, header(0))
    slot = viewer.frames[0].slot
    assert not exchange.release(viewer, slot + 1)
    assert not exchange.release(FakeConnection(), slot)
    assert exchange.release(viewer, slot)
    assert not exchange.release(viewer, slot)


def test_memory_of_an_old_geometry_is_released(exchange: FrameExchange, viewer: FakeConnection) -> None:
    for seq in range(3):
        publish(exchange, header(seq, 640, 480))
    assert shared_bytes() >= 3 * 640 * 480 * 3
    for frame in viewer.frames:
        exchange.release(viewer, frame.slot)
    publish(exchange, header(3))
    assert shared_bytes() == 4096
    assert viewer.messages[-3] == packets.Retire(1, 4)
    assert viewer.frames[-1].slot == 4
    exchange.leave(viewer)
    assert shared_bytes() == 0


def test_a_frame_in_use_outlives_its_geometry(exchange: FrameExchange, viewer: FakeConnection) -> None:
    publish(exchange, header(0, 640, 480))
    publish(exchange, header(1))
    assert shared_bytes() > 640 * 480 * 3
    assert exchange.release(viewer, viewer.frames[0].slot)
    assert shared_bytes() == 4096


def test_unsubscribing_keeps_frames_in_use(exchange: FrameExchange, viewer: FakeConnection) -> None:
    publish(exchange, header(0))
    held = viewer.frames[0].slot
    exchange.unsubscribe(viewer, "front")
    assert viewer.messages[-1] == packets.Retire(1, held + 1)
    other = FakeConnection()
    exchange.subscribe(other, "front")
    for seq in range(10):
        publish(exchange, header(seq))
    assert held not in {frame.slot for frame in other.frames}
    assert len(viewer.frames) == 1
    exchange.subscribe(viewer, "front")
    publish(exchange, header(11))
    assert viewer.frames[-1].header.seq == 11
    assert exchange.release(viewer, held)


def test_compressed_frames_of_varying_size_do_not_churn(exchange: FrameExchange, viewer: FakeConnection) -> None:
    for seq in range(300):
        size = 30_000 + (seq * 7919) % 20_000
        head = FrameHeader("front", seq, seq, seq, 640, 480, Encoding.JPEG, size)
        exchange.publish(head, np.zeros(size, np.uint8))
        exchange.release(viewer, viewer.frames[-1].slot)
    assert len(viewer.slots) <= 4


def test_each_camera_has_its_own_leases(exchange: FrameExchange, viewer: FakeConnection) -> None:
    exchange.subscribe(viewer, "bottom")
    for seq in range(MAX_LEASES):
        assert publish(exchange, header(seq)) == 0
        assert publish(exchange, header(seq, camera="bottom")) == 0
    assert publish(exchange, header(9, camera="bottom")) == 1
    assert len({frame.slot for frame in viewer.frames}) == 2 * MAX_LEASES
