"""A small VRPN server: ``python -m tests.motion_capture.vrpn PORT``.

Written from the protocol's public description (``Format_Of_Protocol.txt`` and ``vrpn_Connection.C`` of
https://github.com/vrpn/vrpn, Boost licence): the client tells by UDP where it listens, the server connects there, both
say who they are, and the server names its senders and types and sends poses. All big endian, padded to eight bytes.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import struct
import sys
import time
from typing import Final

from tests.motion_capture.moving import BODIES, PERIOD_S, pose

COOKIE: Final = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
SENDER_DESCRIPTION, TYPE_DESCRIPTION = -1, -2  #: types of messages that describe
SENDERS: Final = ("VRPN Control", *BODIES)
TYPES: Final = ("vrpn_Base ping_message", "vrpn_Base pong_message", "vrpn_Tracker Pos_Quat")


def message(sender: int, kind: int, payload: bytes) -> bytes:
    """The length leaves out the padding at the end; the sixth number, after the header, is not looked at."""
    seconds, fraction = divmod(time.time(), 1.0)
    head = struct.pack(">IIIiiI", 24 + len(payload), int(seconds), int(fraction * 1e6), sender, kind, 0)
    return head + payload + bytes(-len(payload) % 8)


def description(kind: int, number: int, name: str) -> bytes:
    words = name.encode() + b"\0"
    return message(number, kind, struct.pack(">I", len(words)) + words)


def frame(number: int) -> bytes:
    """The pose of the first body; nothing is sent of one that is hidden."""
    place, yaw = pose(number)
    turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return message(SENDERS.index(BODIES[0]), 2, struct.pack(">ii7d", 0, 0, *place, *turn))


def serve(port: int) -> None:
    """One client after the other, until it is killed. One that calls again from elsewhere has given up the last try."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as knock:
        knock.bind(("127.0.0.1", port))
        print(f"ready {knock.getsockname()[1]}", flush=True)
        place = heard(knock)
        while True:
            newest = place
            with contextlib.suppress(OSError), socket.create_connection(place) as client:
                greet(client)
                knock.setblocking(False)
                for number in itertools.count(1):
                    with contextlib.suppress(BlockingIOError):
                        newest = heard(knock)
                    if newest != place:
                        break
                    client.sendall(frame(number))
                    time.sleep(PERIOD_S)
            knock.setblocking(True)
            place = newest if newest != place else heard(knock)


def heard(knock: socket.socket) -> tuple[str, int]:
    """Where a client listens."""
    host, port = knock.recv(1024).rstrip(b"\0").decode().split()[:2]
    return host, int(port)


def greet(client: socket.socket) -> None:
    """Say who is here, and what the senders and types are called."""
    client.sendall(COOKIE)
    if client.recv(len(COOKIE), socket.MSG_WAITALL)[:11] != COOKIE[:11]:
        raise ConnectionError("that is no client, or it is gone")
    for number, name in enumerate(SENDERS):
        client.sendall(description(SENDER_DESCRIPTION, number, name))
    for number, name in enumerate(TYPES):
        client.sendall(description(TYPE_DESCRIPTION, number, name))


if __name__ == "__main__":
    serve(int(sys.argv[1]))
