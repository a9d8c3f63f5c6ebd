"""The link between an emulated autopilot and its proxy: UDP or a serial line that loses and delays frames."""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from skyloop.clock import monotonic_ns

ATTITUDE: Final = 30
COMMAND_LONG: Final = 76
DISARM: Final = 400
FORCE: Final = 21196.0
_V2: Final = 0xFD
_HEADER: Final = 10
STALLED_S: Final = 0.08  #: a turn this long means that the process was not scheduled
_TURN_S: Final = 0.02
_FULL_TURN_S: Final = 0.002  #: a reopened port is full at once
_MOST: Final = 65_536
_STAMP: Final = struct.Struct("qq")  #: the kernel's time stamp of a datagram
_STAMPED: Final = getattr(socket, "SO_TIMESTAMPNS", 35)


def kind_of(frame: bytes) -> int:
    """The message number of a MAVLink 2 frame; −1 for anything else."""
    whole = len(frame) > _HEADER and frame[0] == _V2
    return int.from_bytes(frame[7:10], "little") if whole else -1


def is_stop(frame: bytes) -> bool:
    """Whether it disarms even in flight."""
    if kind_of(frame) != COMMAND_LONG or len(frame) < _HEADER + 30:
        return False
    first, second = struct.unpack_from("<ff", frame, _HEADER)
    return (first, second, *struct.unpack_from("<H", frame, _HEADER + 28)) == (0.0, FORCE, DISARM)


def frames_of(buffer: bytearray) -> Iterator[bytes]:
    """Take whole MAVLink 2 frames from the beginning of a stream, and discard other bytes."""
    while (begin := buffer.find(_V2)) >= 0:
        del buffer[:begin]
        if len(buffer) < _HEADER:
            return
        size = _HEADER + buffer[1] + 2 + (13 if buffer[2] & 1 else 0)
        if len(buffer) < size:
            return
        yield bytes(buffer[:size])
        del buffer[:size]
    buffer.clear()


class Radio:
    """Carries frames, on a separate thread.

    Args:
        autopilot: Port of the autopilot.
        ground: Port to which it sends.
        proxy: UDP port of the proxy, or a path at which a serial port for it appears.
        note: Called with each thing done to a frame.
    """

    def __init__(self, autopilot: int, ground: int, proxy: int | Path, note: Callable[[str, int], None]) -> None:
        self._autopilot = ("127.0.0.1", autopilot)
        self._near = _socket(ground)
        self._note = note
        self._far: socket.socket | None = None
        self._proxy = ("127.0.0.1", 0)
        self._serial = self._device = -1
        if isinstance(proxy, int):
            self._far, self._proxy = _socket(0), ("127.0.0.1", proxy)
        else:
            import tty

            self._serial, self._device = os.openpty()
            tty.setraw(self._device)
            for end in (self._serial, self._device):
                os.set_blocking(end, False)
            proxy.symlink_to(os.ttyname(self._device))
        self._received = bytearray()
        self._left_ns = 0
        #: When frames left the proxy, by sequence number; correct even if this process was stalled.
        self.left_ns: dict[int, int] = {}
        self._late: list[tuple[float, bytes]] = []
        self._delay_s = 0.0
        self.lost_stops = 0  #: how many of the next stops are lost
        self.full_until_s = 0.0  #: until then the serial port is not read, and accepts no more data
        self.moving = False  #: to another UDP port
        threading.Thread(target=self._run, name="radio", daemon=True).start()

    def delay(self, seconds: float) -> None:
        """Delay the next ATTITUDE by this many seconds."""
        self._delay_s = seconds

    def _run(self) -> None:
        looked_s, full = time.monotonic(), False
        while True:
            now_s = time.monotonic()
            if self._far is None and now_s - looked_s > STALLED_S:  # for datagrams, the kernel's time stamps are used
                self._note("stalled", round((now_s - looked_s) * 1000))
            looked_s = now_s
            if now_s < self.full_until_s and not full:  # data already here has been received: no port can recall it
                for frame in self._came():
                    self._up(frame)
            full = now_s < self.full_until_s
            if self.moving and self._far is not None:
                self.moving = False
                self._far.close()
                self._far = _socket(0)
            if full:
                self._fill()
            ends = [self._near.fileno(), self._serial if self._far is None else self._far.fileno()]
            ready, _, _ = select.select(ends[: 1 if full else 2], [], [], _FULL_TURN_S if full else _TURN_S)
            if ends[0] in ready:
                self._down(self._near.recv(_MOST))
            if ends[1] in ready:
                for frame in self._came():
                    self._up(frame)
            now_s = time.monotonic()
            for due_s, frame in list(self._late):
                if now_s >= due_s:
                    self._late.remove((due_s, frame))
                    self._send(frame)

    def _came(self) -> list[bytes]:
        self._left_ns = monotonic_ns()
        if self._far is not None:
            with suppress(OSError):  # the proxy may be away
                frame, more, _, _ = self._far.recvmsg(_MOST, socket.CMSG_SPACE(_STAMP.size))
                for _, _, stamp in more:
                    self._left_ns = _monotonic(*_STAMP.unpack(stamp))
                return [frame]
            return []
        with suppress(BlockingIOError):
            self._received += os.read(self._serial, _MOST)
        self._left_ns = monotonic_ns()  # not earlier: until it reads, this process may be suspended while more arrives
        return list(frames_of(self._received))

    def _up(self, frame: bytes) -> None:
        if self.lost_stops and is_stop(frame):
            self.lost_stops -= 1
            self._note("stop_lost", 0)
            return
        if kind_of(frame) >= 0:
            self.left_ns[frame[4]] = self._left_ns
        self._near.sendto(frame, self._autopilot)

    def _down(self, frame: bytes) -> None:
        if self._delay_s and kind_of(frame) == ATTITUDE:
            self._late.append((time.monotonic() + self._delay_s, frame))
            self._delay_s = 0.0
            self._note("delayed", 0)
        else:
            self._send(frame)

    def _send(self, frame: bytes) -> None:
        with suppress(OSError):  # the proxy is away, or does not read
            if self._far is not None:
                self._far.sendto(frame, self._proxy)
            else:
                os.write(self._serial, frame)

    def _fill(self) -> None:
        """Leave no room in the serial port's output buffer."""
        for size in (4096, 1):
            with suppress(OSError):
                while True:
                    os.write(self._device, bytes(size))


def _monotonic(seconds: int, nanoseconds: int) -> int:
    """Convert a time of the wall clock to the monotonic clock; any error makes it later."""
    best, found_ns = 1 << 62, 0
    for _ in range(5):  # this process may be suspended between the two clocks
        before_ns, wall_ns, after_ns = monotonic_ns(), time.time_ns(), monotonic_ns()
        if after_ns - before_ns < best:
            best, found_ns = after_ns - before_ns, after_ns - (wall_ns - seconds * 10**9 - nanoseconds)
    return found_ns


def _socket(port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, _STAMPED, 1)
    made.bind(("127.0.0.1", port))
    return made
