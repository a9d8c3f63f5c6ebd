"""A connection's backlog: only the newest of the set-points, and everything else in order."""

from __future__ import annotations

import pytest

from skyloop.messages import (
    AnyAction,
    Command,
    EmergencyStop,
    Hover,
    Idle,
    Land,
    Ping,
    Position,
    Request,
    Takeoff,
    Velocity,
    encode,
)
from skyloop.transport.priority import MOST_BYTES, MOST_PACKETS, Lane, PacketBacklog

FLY, GO, IDLE, LAND = Velocity(forward=1.0), Position(1.0, 2.0, 3.0), Idle(), Land()
ASK = encode(Request(1, Ping(1)))


def command(seq: int, action: AnyAction, intent: int | None = None) -> bytes:
    return encode(Command(seq, 1, seq if intent is None else intent, seq, action))


def left(backlog: PacketBacklog) -> list[bytes]:
    found = []
    while backlog:
        found.append(backlog.get())
    return found


@pytest.mark.parametrize(
    ("came", "kept"),
    [
        ([FLY, FLY, FLY], [3]),
        ([FLY, GO], [2]),
        ([FLY, LAND, FLY], [2, 3]),
        ([FLY, FLY, LAND], [2, 3]),
        ([Takeoff(), FLY, Hover(), FLY, LAND, EmergencyStop()], [1, 3, 4, 5, 6]),
        ([IDLE, IDLE], [2]),
        ([IDLE, FLY], [2]),
        ([FLY, IDLE], [1, 2]),  # a keep-alive leaves the vehicle flying as it is
        ([FLY, IDLE, GO], [3]),
        ([LAND, LAND], [1, 2]),  # requested twice
    ],
)
def test_the_backlog_after_several_packets(came: list[AnyAction], kept: list[int]) -> None:
    backlog = PacketBacklog()
    packets = [command(seq, action) for seq, action in enumerate(came, 1)]
    superseded = sum(backlog.put(packet) for packet in packets)
    assert superseded == len(came) - len(kept)
    assert left(backlog) == [packets[seq - 1] for seq in kept]
    assert backlog.lane is None


def test_repeats_merge_into_the_newest() -> None:
    backlog = PacketBacklog()
    for seq in range(1, 6):
        backlog.put(command(seq, LAND, intent=7))
    backlog.put(command(6, FLY, intent=8))
    assert backlog.put(command(7, LAND, intent=7)) == 0  # not a sequence that the library sends, but nothing is lost
    assert left(backlog) == [command(5, LAND, 7), command(6, FLY, 8), command(7, LAND, 7)]


def test_a_reordered_command_never_replaces_a_newer_one() -> None:
    backlog = PacketBacklog()
    backlog.put(command(5, FLY))
    assert backlog.put(command(4, GO)) == 0
    assert len(left(backlog)) == 2


def test_a_removed_command_is_not_superseded() -> None:
    backlog = PacketBacklog()
    backlog.put(command(1, FLY))
    backlog.get()
    assert backlog.put(command(2, FLY)) == 0
    assert len(left(backlog)) == 1


def test_a_damaged_command_supersedes_nothing_and_is_left_to_the_handler() -> None:
    backlog = PacketBacklog()
    backlog.put(command(1, FLY))
    damaged = command(2, FLY)[:-1]
    assert backlog.put(damaged) == 0
    assert left(backlog) == [command(1, FLY), damaged]


def test_the_lane_is_that_of_the_commands_in_front() -> None:
    backlog = PacketBacklog()
    lanes = []
    for packet in (command(1, FLY), command(2, LAND)):
        backlog.put(packet)
        lanes.append(backlog.lane)
    assert lanes == [Lane.STEERING, Lane.URGENT]
    late = PacketBacklog()
    late.put(command(1, FLY))
    late.put(ASK)
    late.put(command(2, LAND))
    lanes = []
    while late:
        lanes.append(late.lane)
        late.get()
    assert lanes == [Lane.STEERING, Lane.OTHERS, Lane.URGENT], "packets before the landing are handled before it"


def test_the_backlog_is_bounded() -> None:
    backlog = PacketBacklog()
    for _ in range(MOST_PACKETS):
        assert not backlog.full
        backlog.put(ASK)
    assert backlog.full
    large = PacketBacklog()
    large.put(bytes(MOST_BYTES))
    assert large.full
    large.get()
    assert not large.full
