"""The process of a path: moves packets between the TUN devices of two hosts, delayed, reordered, or dropped."""

from __future__ import annotations

import ctypes
import fcntl
import gc
import os
import select
import struct
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

from benchmarks.hosts.impairments import Impairments, Way

_TUNSETIFF: Final = 0x400454CA  # linux/if_tun.h
_IFF_TUN: Final = 0x0001
_IFF_NO_PI: Final = 0x1000
_CLONE_NEWNET: Final = 0x40000000
_LARGEST: Final = 65536
_AT_ONCE: Final = 32  # maximum number of packets in one direction before the other gets a turn
_NICE: Final = -10  # a busy processor should not add to the requested delay


class Direction(NamedTuple):
    """The traffic of one direction since the last report."""

    packets: int  #: number of packets that arrived
    size: int  #: total size of those [bytes]
    lost: int  #: number of packets dropped on purpose
    late_ns: list[int]  #: delay that this process added to each, beyond the intended one


def device(pid: int, name: str) -> int:
    """Create a TUN device in the network namespace of a process; return its non-blocking descriptor."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/proc/{pid}/ns/net").open() as namespace:
        if libc.setns(namespace.fileno(), _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), f"cannot enter the network namespace of process {pid}")
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return descriptor


def relay(
    pipe: Connection,
    seed: int,
    ends: tuple[tuple[int, str], tuple[int, str]],
    impairments: tuple[Impairments, Impairments],
) -> None:
    """Relay packets until ``None`` arrives through the pipe.

    Two :class:`Impairments` received there, one each way, apply from then on, and are answered by ``"set"``; ``"tell"``
    is answered by two :class:`Direction`.

    Args:
        pipe: To the measuring process.
        seed: Determines the fate of each packet.
        ends: A process of each host, and the name of the host's device.
        impairments: The initial ones, each way.
    """
    descriptors = [device(*end) for end in ends]
    ways = [_Wire(descriptors[0], descriptors[1], f"{seed}/0", impairments[0])]
    ways.append(_Wire(descriptors[1], descriptors[0], f"{seed}/1", impairments[1]))
    os.nice(_NICE)
    gc.disable()  # nothing here creates cycles
    pipe.send("ready")
    control = pipe.fileno()
    while True:
        due = [wire.way.next_ns for wire in ways]
        next_ns = min((at for at in due if at is not None), default=None)
        wait_s = None if next_ns is None else max(0, next_ns - time.monotonic_ns()) / 1e9
        ready, _, _ = select.select([*descriptors, control], [], [], wait_s)
        for wire in ways:
            if wire.source in ready:
                wire.take()
            wire.give()
        if control in ready:
            wish = pipe.recv()
            if wish is None:
                return
            if isinstance(wish, tuple):
                for wire, wrong in zip(ways, wish, strict=True):
                    wire.way.impairments = wrong
                pipe.send("set")
            else:
                pipe.send([wire.tell() for wire in ways])


class _Wire:
    """One direction, from one device to the other."""

    def __init__(self, source: int, sink: int, seed: str, impairments: Impairments) -> None:
        self.source = source
        self.way = Way(seed, impairments)
        self._sink = sink
        self._size = 0
        self._late_ns: list[int] = []

    def take(self) -> None:
        """Take incoming packets."""
        for _ in range(_AT_ONCE):
            try:
                packet = os.read(self.source, _LARGEST)
            except BlockingIOError:
                return
            self.way.put(packet, time.monotonic_ns())

    def give(self) -> None:
        """Deliver packets that are due."""
        while (found := self.way.get(now_ns := time.monotonic_ns())) is not None:
            due_ns, packet = found
            try:
                os.write(self._sink, packet)
            except OSError:  # the device is down: the packet is lost, as on any path
                continue
            self._size += len(packet)
            self._late_ns.append(now_ns - due_ns)

    def tell(self) -> Direction:
        """Return the traffic since the last report."""
        told = Direction(len(self._late_ns), self._size, self.way.lost, self._late_ns)
        self._size, self.way.lost, self._late_ns = 0, 0, []
        return told
