"""Streams never wait: what finds no room is dropped, what was sent in part is an error, a slow line is paced."""

from __future__ import annotations

import os
import select
import tty
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from skyloop.clock import ManualClock
from skyloop.drivers.byte_stream import STUCK_NS, LinePace, Rank, SerialStream, line_speed


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A serial line: its far end, and the device at this one."""
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    yield far, os.ttyname(near)
    os.close(near)
    os.close(far)


def read_all(far: int) -> int:
    """Return how many bytes could be read."""
    count = 0
    with suppress(BlockingIOError):
        while True:
            count += len(os.read(far, 65_536))
    return count


def fill(stream: SerialStream) -> None:
    """Leave no room at all, as when the other end hangs. The system may make some more a moment later."""
    while select.select([], [stream], [], 0.05)[1]:
        with suppress(BlockingIOError):
            while True:
                os.write(stream.fileno(), b"x")


def test_a_serial_port_whose_other_end_does_not_read_drops_and_never_waits(line: tuple[int, str]) -> None:
    """The output buffer is full: writing returns, and what stays so for half a second is an error."""
    pytest.importorskip("serial")
    far, device = line
    clock = ManualClock()
    with closing(SerialStream(device, 10_000_000, "x", "mavlink", clock)) as stream:
        fill(stream)
        stream.write(b"set-point")
        assert stream.dropped == 1
        clock.advance(STUCK_NS / 1e9 - 0.01)
        stream.write(b"set-point")
        read_all(far)
        stream.write(b"set-point")
        fill(stream)
        stream.write(b"set-point")
        assert stream.dropped == 3, "it had room in between"
        clock.advance(STUCK_NS / 1e9)
        with pytest.raises(OSError, match="no longer reads"):
            stream.write(b"set-point")


def test_a_serial_port_that_takes_half_a_frame_says_so(line: tuple[int, str]) -> None:
    """What follows half a frame would be noise to the vehicle."""
    pytest.importorskip("serial")
    with closing(SerialStream(line[1], 10_000_000, "x", "mavlink")) as stream, pytest.raises(OSError, match="reads"):
        stream.write(bytes(1 << 20))


def test_a_slow_line_carries_set_points_before_poses_and_commands_before_all() -> None:
    """57,600 baud, a set-point each 20 ms, a pose each 10 ms: far more than fits, and nothing waits for long."""
    pace, sent, latest_s = LinePace(5760.0), dict.fromkeys(Rank, 0), 0.0
    free_s = 0.0
    for step in range(1000):
        now_s = step * 0.01
        packets = [(Rank.POSE, 244), (Rank.SETPOINT, 65)] if step % 2 else [(Rank.POSE, 244)]
        if step % 100 == 0:
            packets += [(Rank.COMMAND, 45), (Rank.QUERY, 32)]
        for rank, size in sorted(packets):
            if pace.admits(rank, round(now_s * 1e9)):
                pace.on_written(size, round(now_s * 1e9))
                free_s = max(free_s, now_s) + size / 5760.0
                sent[rank] += 1
                if rank <= Rank.SETPOINT:
                    latest_s = max(latest_s, free_s - now_s)
    assert sent[Rank.COMMAND] == 10, "never held back"
    assert sent[Rank.SETPOINT] == 500
    assert sent[Rank.POSE] > 60, "they get the rest"
    assert latest_s < 0.12


def test_a_line_over_usb_has_no_pace(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    assert line_speed(str(tmp_path / "by-id"), 57600) is None
    assert line_speed("/dev/cu.usbmodem14201", 57600) is None
    assert line_speed("/dev/ttyUSB0", 57600) == 5760.0
