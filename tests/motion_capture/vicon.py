"""A small Vicon server: ``python -m tests.motion_capture.vicon PORT``.

Written from the public source of Vicon's own client (DataStream SDK, MIT licence, in the headers of
https://github.com/whoenig/vicon-datastream-sdk): over TCP, little endian, packets of objects, each with type, length
and content. The server first lists its objects; the client answers with those that it wants, and requests frames. A
vector, a set and a text start with their length. Places are in millimetres, rotations matrices by rows.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Final

from tests.motion_capture.moving import BODIES, PERIOD_S, pose

PACKET: Final = 0x1A2B0001
OBJECTS, REQUEST_FRAME, CONTENTS = 100001, 100002, 100004
STREAM_INFO, SUBJECT_INFO, FRAME_INFO, LOCAL_SEGMENTS, GLOBAL_SEGMENTS = 1, 2, 5, 8, 9
SUPPORTED: Final = (STREAM_INFO, SUBJECT_INFO, FRAME_INFO, LOCAL_SEGMENTS, GLOBAL_SEGMENTS, CONTENTS, REQUEST_FRAME)
HEADER: Final = struct.Struct("<II")
_FREQUENCY: Final = 27_000_000  # ticks per second of the frames' clock

Matrix = tuple[float, ...]


def turned(yaw: float) -> Matrix:
    c, s = math.cos(yaw), math.sin(yaw)
    return c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0


def item(kind: int, data: bytes) -> bytes:
    return HEADER.pack(kind, len(data)) + data


def packet(*items: bytes) -> bytes:
    return item(PACKET, b"".join(items))


def numbers(values: Sequence[int]) -> bytes:
    return struct.pack(f"<{len(values) + 1}I", len(values), *values)


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def subject(number: int, name: str) -> bytes:
    """Encode a body of one segment with the same name, like Tracker's, without markers."""
    segment = struct.pack("<II6f", number, number, *[0.0] * 6) + text(name)
    return item(SUBJECT_INFO, struct.pack("<I", number) + text(name) + struct.pack("<I", 1) + segment + bytes(8))


def segment(kind: int, number: int, place_mm: Sequence[float], matrix: Matrix) -> bytes:
    return item(kind, struct.pack("<III3d9d", number, 1, number, *place_mm, *matrix))


def frame(number: int, wanted: set[int]) -> bytes:
    """Encode the objects that the client wants. The second body is hidden: its segment is not sent."""
    place, yaw = pose(number)
    place_mm = [1000.0 * value for value in place]
    items = [(STREAM_INFO, item(STREAM_INFO, struct.pack("<q", int(PERIOD_S * _FREQUENCY))))]
    items += [(SUBJECT_INFO, subject(index, name)) for index, name in enumerate(BODIES, 1)]
    items += [(FRAME_INFO, item(FRAME_INFO, struct.pack("<I", number)))]
    items += [(kind, segment(kind, 1, place_mm, turned(yaw))) for kind in (LOCAL_SEGMENTS, GLOBAL_SEGMENTS)]
    return packet(*(data for kind, data in items if kind in wanted))


def packets(client: socket.socket) -> Iterator[list[tuple[int, bytes]]]:
    """Yield a client's packets as objects."""
    with client.makefile("rb") as stream:
        while len(head := stream.read(HEADER.size)) == HEADER.size:
            kind, size = HEADER.unpack(head)
            assert kind == PACKET, hex(kind)
            data, at, found = stream.read(size), 0, []
            while at < size:
                one, length = HEADER.unpack_from(data, at)
                found.append((one, data[at + HEADER.size : at + HEADER.size + length]))
                at += HEADER.size + length
            yield found


class Wishes:
    """A client's requests so far, read on a separate thread."""

    def __init__(self, client: socket.socket) -> None:
        self.objects: set[int] = set()
        self.streaming = threading.Event()
        self._client = client
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for found in packets(self._client):
            for kind, data in found:
                if kind == OBJECTS:
                    self.objects = set(struct.unpack(f"<{len(data) // 4}I", data)[1:])
                elif kind == REQUEST_FRAME and data == b"\1":
                    self.streaming.set()


def serve(port: int) -> None:
    """Serve one client until it leaves."""
    with socket.create_server(("127.0.0.1", port)) as server:
        print(f"ready {server.getsockname()[1]}", flush=True)
        client, _ = server.accept()
        with client, contextlib.suppress(ConnectionError):
            client.sendall(packet(item(OBJECTS, numbers(SUPPORTED))))
            wishes = Wishes(client)
            wishes.streaming.wait(20.0)
            for number in itertools.count(1):
                client.sendall(frame(number, wishes.objects))
                time.sleep(PERIOD_S)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
