"""The floor: the bare hand-over in Python, without Skyloop.

One ``SOCK_SEQPACKET`` socket. A packet is 100 bytes that carry the time of sending. A frame is copied into memory that
both processes map, and a packet of 24 bytes announces it; the receiver makes an array over the memory. This is the
least that any library in Python must do to bring the same bytes over, with a thread at each end that waits.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
import threading
from pathlib import Path

import numpy as np

from skyloop.bench.contract import Image, Received
from skyloop.bench.schedule import COMMAND, FEEDBACK, LARGE, VIDEO
from skyloop.bench.waypoints import Setpoint

PACKET_BYTES = 100  #: about what a command or feedback packet takes
STAMP = struct.Struct("<qqq")  #: time of sending, columns, rows
PACKET = struct.Struct("<qqq3d52x")  #: the same, zeros for the size, and three numbers
assert PACKET.size == PACKET_BYTES
MEMORY_BYTES = LARGE.frame_bytes


class Vehicle:
    """The vehicle's end; see :class:`skyloop.bench.contract.VehicleEnd`."""

    def __init__(self, address: str, received: Received) -> None:
        self._path = Path(address) / "floor"
        descriptor = os.memfd_create("skyloop-bench-floor")
        os.ftruncate(descriptor, MEMORY_BYTES)
        self._descriptor = descriptor
        self._memory = np.frombuffer(mmap.mmap(descriptor, MEMORY_BYTES), np.uint8)
        self._memory[:] = 1  # the pages are there before the first frame, as Skyloop's slots are after their first use
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(self._path))
        self._listener.listen(1)
        self._received = received
        self._socket: socket.socket
        self._thread = threading.Thread(target=self._receive, name="floor-receive", daemon=True)
        self._thread.start()

    def feedback(self, sent_ns: int) -> None:
        self._socket.send(PACKET.pack(sent_ns, 0, 0, 0.1, 0.2, 0.3))

    def frame(self, sent_ns: int, image: Image) -> None:
        height, width, _ = image.shape
        np.copyto(self._memory[: image.size], image.reshape(-1))
        self._socket.send(STAMP.pack(sent_ns, width, height))

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread, should nobody have come
        self._thread.join()
        self._listener.close()
        self._path.unlink()
        os.close(self._descriptor)

    def _receive(self) -> None:
        try:
            self._socket, _ = self._listener.accept()
        except OSError:
            return  # closed before anybody came
        with self._socket as sock:
            socket.send_fds(sock, [b"memory"], [self._descriptor])
            while packet := sock.recv(256):
                self._received(COMMAND, STAMP.unpack_from(packet)[0])


class Application:
    """The application's end; see :class:`skyloop.bench.contract.ApplicationEnd`."""

    def __init__(self, address: str, received: Received) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(Path(address) / "floor"))
        _, (descriptor, *_), _, _ = socket.recv_fds(self._socket, 16, 1)
        self._memory = mmap.mmap(descriptor, MEMORY_BYTES, prot=mmap.PROT_READ)
        os.close(descriptor)
        self._received = received
        self._thread = threading.Thread(target=self._receive, name="floor-receive", daemon=True)
        self._thread.start()

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        self._socket.send(PACKET.pack(sent_ns, 0, 0, *setpoint))

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _receive(self) -> None:
        sock, memory, received = self._socket, self._memory, self._received
        while packet := sock.recv(256):
            sent_ns, width, height = STAMP.unpack_from(packet)
            if width:
                np.frombuffer(memory, np.uint8, width * height * 3).reshape(height, width, 3)
                received(VIDEO, sent_ns)
            else:
                received(FEEDBACK, sent_ns)
