"""A small Qualisys server: ``python -m tests.motion_capture.qualisys PORT``.

Written from the public source of Qualisys' own client (https://github.com/qualisys/qualisys_cpp_sdk, MIT licence):
packets preceded by length and type, little endian, on the base port plus one. Commands are texts, settings are XML, and
frames arrive by UDP on the port that the client names. Places are in millimetres; the angles, in degrees, are about the
body's axes x, y and z in turn.
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

TEXT, XML, DATA, EVENT = 1, 2, 3, 6
POINTS_UNLABELLED, BODIES_EULER = 2, 6
CONNECTED: Final = b"\1"  #: the state event
HEADER: Final = struct.Struct("<II")


def packet(kind: int, data: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(data), kind) + data


def text(words: str, kind: int = TEXT) -> bytes:
    return packet(kind, words.encode() + b"\0")


def settings(version: str) -> str:
    bodies = "".join(f"<Body><Name>{name}</Name><RGBColor>255</RGBColor></Body>" for name in BODIES)
    angles = "<Euler><First>Roll</First><Second>Pitch</Second><Third>Yaw</Third></Euler>"
    root = f"QTM_Parameters_Ver_{version}"
    return f"<{root}><The_6D><Bodies>{len(BODIES)}</Bodies>{bodies}{angles}</The_6D></{root}>"


def component(kind: int, count: int, data: bytes) -> bytes:
    return struct.pack("<IIIHH", 16 + len(data), kind, count, 0, 0) + data


def frame(number: int) -> bytes:
    """Encode both bodies; a hidden one is NaN."""
    place, yaw = pose(number)
    seen = struct.pack("<6f", *(1000.0 * value for value in place), 0.0, 0.0, math.degrees(yaw))
    hidden = struct.pack("<6f", *[math.nan] * 6)
    parts = component(POINTS_UNLABELLED, 0, b"") + component(BODIES_EULER, 2, seen + hidden)
    return packet(DATA, struct.pack("<QII", round(number * PERIOD_S * 1e6), number, 2) + parts)


def talk(client: socket.socket) -> int:
    """Answer until the client has identified the server and requests frames; return the port for them."""
    client.sendall(text("QTM RT Interface connected"))
    version, port, known = "", 0, False
    with client.makefile("rb") as stream:
        while not (port and known):
            size, _ = HEADER.unpack(stream.read(HEADER.size))
            asked = stream.read(size - HEADER.size).rstrip(b"\0").decode()
            word, _, rest = asked.partition(" ")
            if word == "Version":
                version = rest
                client.sendall(text(f"Version set to {version}"))
            elif word == "GetState":
                client.sendall(packet(EVENT, CONNECTED))
            elif word == "GetParameters":
                client.sendall(text(settings(version), XML))
            elif word == "StreamFrames":
                port = int(asked.partition("UDP:")[2].split()[0])
            elif word == "QTMVersion":
                known = True
                client.sendall(text("QTM Version is 2.16 (build 3600)"))
            else:
                raise AssertionError(f"not expected: {asked}")
    return port


def serve(port: int) -> None:
    """Serve one client until it leaves. ``port`` 0: a free one; the announced base port is one less."""
    with (
        socket.create_server(("127.0.0.1", port + 1 if port else 0)) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as frames,
    ):
        print(f"ready {server.getsockname()[1] - 1}", flush=True)
        client, _ = server.accept()
        with client, contextlib.suppress(ConnectionError, struct.error):
            to = ("127.0.0.1", talk(client))
            for number in itertools.count(1):
                frames.sendto(frame(number), to)
                time.sleep(PERIOD_S)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
