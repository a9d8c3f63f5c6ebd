"""A small VRPN server: ``python -m tests.motion_capture.vrpn PORT [SENSOR...]``.

Written from the protocol's public description (``Format_Of_Protocol.txt`` and ``vrpn_Connection.C`` of
https://github.com/vrpn/vrpn, Boost licence): a client connects by TCP, or announces by UDP where it listens and the
server connects there; both identify themselves, and the server names its senders and types and sends poses. All big
endian, padded to eight bytes.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import sys
import threading
import time
from typing import Final

from skyloop.motion_capture.vrpn import (
    COOKIE,
    HEADER,
    NAME_LENGTH,
    POS_QUAT,
    POSE,
    SENDER_DESCRIPTION,
    TYPE_DESCRIPTION,
)
from tests.motion_capture.moving import BODIES, PERIOD_S, pose

SENDERS: Final = ("VRPN Control", *BODIES)
TYPES: Final = ("vrpn_Base ping_message", "vrpn_Base pong_message", POS_QUAT)
APART_M: Final = 10.0  #: distance along x from one sensor to the next


def encode_message(sender: int, kind: int, payload: bytes, *, seconds: int = 0, microseconds: int = 0) -> bytes:
    """Encode a message with its padding. The time is that of the report, since 1970."""
    head = HEADER.pack(HEADER.size + len(payload), seconds, microseconds, sender, kind, 0)
    return head + payload + bytes(-len(payload) % 8)


def encode_description(kind: int, number: int, name: str) -> bytes:
    """Encode the name of the sender (``SENDER_DESCRIPTION``) or type (``TYPE_DESCRIPTION``) with this number."""
    text = name.encode() + b"\0"
    return encode_message(number, kind, NAME_LENGTH.pack(len(text)) + text)


def encode_pose(
    sender: int,
    kind: int,
    sensor: int,
    position: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
    *,
    seconds: int = 0,
    microseconds: int = 0,
) -> bytes:
    """Encode a pose, where ``kind`` is the number described as ``vrpn_Tracker Pos_Quat``."""
    payload = POSE.pack(sensor, sensor, *position, *quaternion)  # the sensor twice, because the reference pads with it
    return encode_message(sender, kind, payload, seconds=seconds, microseconds=microseconds)


def frame(number: int, sensor: int = 0) -> bytes:
    """Encode the pose of a sensor of the first body; nothing is sent for the hidden body."""
    (x, y, z), yaw = pose(number)
    turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    seconds, fraction = divmod(time.time(), 1.0)
    return encode_pose(
        SENDERS.index(BODIES[0]),
        TYPES.index(POS_QUAT),
        sensor,
        (x + APART_M * sensor, y, z),
        turn,
        seconds=int(seconds),
        microseconds=int(fraction * 1e6),
    )


def descriptions() -> bytes:
    """Encode the names of the senders and types."""
    return b"".join(
        encode_description(kind, number, name)
        for kind, names in ((SENDER_DESCRIPTION, SENDERS), (TYPE_DESCRIPTION, TYPES))
        for number, name in enumerate(names)
    )


def stream(client: socket.socket, sensors: list[int], ended: threading.Event) -> None:
    """Greet a client and send it poses as long as it reads them."""
    with contextlib.suppress(OSError), client:
        client.sendall(COOKIE)
        if client.recv(len(COOKIE), socket.MSG_WAITALL)[:11] != COOKIE[:11]:
            return
        client.sendall(descriptions())
        for number in itertools.count(1):
            if ended.wait(PERIOD_S):
                return
            client.sendall(b"".join(frame(number, sensor) for sensor in sensors))


def serve(port: int, sensors: list[int]) -> None:
    """Serve any client until killed. A client that calls by UDP again has abandoned its last try."""
    with socket.create_server(("127.0.0.1", port)) as server, socket.socket(type=socket.SOCK_DGRAM) as knock:
        knock.bind(server.getsockname())
        threading.Thread(target=accept, args=(server, sensors), daemon=True).start()
        print(f"ready {server.getsockname()[1]}", flush=True)
        last: tuple[tuple[str, int], threading.Event] | None = None
        while True:
            host, theirs = knock.recv(1024).rstrip(b"\0").decode().split()[:2]
            place = (host, int(theirs))
            if last is not None:
                if last[0] == place:
                    continue
                last[1].set()
            ended = threading.Event()
            last = place, ended
            with contextlib.suppress(OSError):
                client = socket.create_connection(place)
                threading.Thread(target=stream, args=(client, sensors, ended), daemon=True).start()


def accept(server: socket.socket, sensors: list[int]) -> None:
    while True:
        client, _ = server.accept()
        threading.Thread(target=stream, args=(client, sensors, threading.Event()), daemon=True).start()


if __name__ == "__main__":
    serve(int(sys.argv[1]), [int(text) for text in sys.argv[2:]] or [0])
