"""ZeroMQ: publish and subscribe over its inter-process sockets, frames without copies where possible."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import zmq

from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.measuring.waypoints import Setpoint

_PACKET = struct.Struct("<q11d")  # a stamp, and as many numbers as in feedback or a command
_FRAME = struct.Struct("<qqq")  # stamp, columns, rows
_KEPT = 2  # maximum number of queued messages, because only the newest counts


class _End:
    def __init__(self, address: str) -> None:
        self._address = address
        self._context = zmq.Context()
        self._threads: list[threading.Thread] = []
        self._outgoing: list[Any] = []

    def _publish(self, topic: str, *, binds: bool) -> Any:
        sock = self._open(zmq.PUB, topic, binds=binds)
        self._outgoing.append(sock)
        return sock

    def _subscribe(self, topic: str, take: Callable[[Any], None], *, binds: bool) -> None:
        sock = self._open(zmq.SUB, topic, binds=binds)
        sock.setsockopt(zmq.SUBSCRIBE, b"")
        thread = threading.Thread(target=_receive, args=(sock, take), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _open(self, kind: int, topic: str, *, binds: bool) -> Any:
        sock: Any = self._context.socket(kind)
        sock.set_hwm(_KEPT)
        sock.setsockopt(zmq.LINGER, 0)
        (sock.bind if binds else sock.connect)(f"ipc://{self._address}/{topic}")
        return sock

    def close(self) -> None:
        for sock in self._outgoing:
            sock.close()
        self._context.term()  # wakes blocked threads; each closes its own socket
        for thread in self._threads:
            thread.join()


def _receive(sock: Any, take: Callable[[Any], None]) -> None:
    try:
        while True:
            take(sock)
    except zmq.ContextTerminated:
        sock.close()


class Vehicle(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__(address)
        self._feedback = self._publish(FEEDBACK, binds=True)
        self._video = self._publish(VIDEO, binds=True)
        self._subscribe(COMMAND, lambda sock: received(COMMAND, _PACKET.unpack(sock.recv())[0]), binds=True)

    def feedback(self, sent_ns: int) -> None:
        self._feedback.send(_PACKET.pack(sent_ns, *[0.5] * 11))

    def frame(self, sent_ns: int, image: Image) -> None:
        height, width, _ = image.shape
        self._video.send(_FRAME.pack(sent_ns, width, height), zmq.SNDMORE)
        self._video.send(image, copy=False)


class Application(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__(address)
        self._commands = self._publish(COMMAND, binds=False)

        def show(sock: Any) -> None:
            sent_ns, width, height = _FRAME.unpack(sock.recv())
            np.frombuffer(sock.recv(copy=False).buffer, np.uint8).reshape(height, width, 3)
            received(VIDEO, sent_ns)

        self._subscribe(FEEDBACK, lambda sock: received(FEEDBACK, _PACKET.unpack(sock.recv())[0]), binds=False)
        self._subscribe(VIDEO, show, binds=False)

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        self._commands.send(_PACKET.pack(sent_ns, *setpoint, *[0.0] * 8))
