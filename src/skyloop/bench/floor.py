"""The floor: the bare hand-over in Python, without Skyloop.

Two processes, one ``SOCK_SEQPACKET`` socket. A packet is 100 bytes that carry the time of sending. A frame is copied
into memory that both map, and a packet of 24 bytes announces it; the receiver makes an array over the memory. This is
the least that any library in Python must do to bring the same bytes over, asleep between samples as Skyloop is.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
import time
from multiprocessing.context import SpawnContext

import numpy as np

from skyloop.bench.rounds import PACKET_BYTES, VIDEO_LARGE, Channel, Pipe, Workers, paced

STAMP = struct.Struct("<qqq")  #: time of sending, columns, rows
END = b"end"
MEMORY_BYTES = VIDEO_LARGE.frame_bytes


class Floor:
    """The pair of processes. :meth:`measure` may be called again and again."""

    def __init__(self, context: SpawnContext) -> None:
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with near, far:
            self._workers = Workers(context)
            self._sender = self._workers.start(send, near)
            self._receiver = self._workers.start(receive, far)

    def measure(self, channel: Channel, count: int) -> list[int]:
        """Delays in ns of ``count`` samples, from just before sending (or copying) to in the receiver's hands."""
        self._sender.send((channel, count))
        delays: list[int] = self._receiver.recv()
        return delays

    def close(self) -> None:
        self._workers.close()


def send(pipe: Pipe, sock: socket.socket) -> None:
    """The sending process: does each turn that comes over the pipe."""
    descriptor = os.memfd_create("skyloop-bench-floor")
    os.ftruncate(descriptor, MEMORY_BYTES)
    memory = np.frombuffer(mmap.mmap(descriptor, MEMORY_BYTES), np.uint8)
    memory[:] = 1  # the pages are there before the first turn, as Skyloop's slots are after their first use
    socket.send_fds(sock, [END], [descriptor])
    padding = bytes(PACKET_BYTES - STAMP.size)
    pipe.send("ready")
    while (turn := pipe.recv()) is not None:
        channel, count = turn
        image = np.random.default_rng(1).integers(0, 255, channel.frame_bytes, np.uint8)
        slot = memory[: channel.frame_bytes]
        for _ in paced(count, channel.period_s):
            now = time.monotonic_ns()
            if channel.width:
                np.copyto(slot, image)
                sock.send(STAMP.pack(now, channel.width, channel.height))
            else:
                sock.send(STAMP.pack(now, 0, 0) + padding)
        sock.send(END)


def receive(pipe: Pipe, sock: socket.socket) -> None:
    """The receiving process: answers each turn with its delays."""
    _, (descriptor, *_), _, _ = socket.recv_fds(sock, 16, 1)
    memory = mmap.mmap(descriptor, MEMORY_BYTES, prot=mmap.PROT_READ)
    pipe.send("ready")
    delays: list[int] = []
    while packet := sock.recv(256):
        if packet == END:
            pipe.send(delays)
            delays = []
            continue
        sent, width, height = STAMP.unpack_from(packet)
        if width:
            np.frombuffer(memory, np.uint8, width * height * 3).reshape(height, width, 3)
        delays.append(time.monotonic_ns() - sent)
