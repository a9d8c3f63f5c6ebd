"""A small OptiTrack server that replays a recorded session: ``python -m tests.motion_capture.natnet PORT``.

Reads the recording (pcapng) and answers as Motive did: a description of the server, its model definitions, then the
recorded frames, by multicast on the loopback interface. Layouts: https://docs.optitrack.com/developer-tools/natnet-sdk.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Iterator
from typing import Final, NamedTuple

from tests.support.recordings import recorded

SERVER_INFO, MODEL_DEFINITIONS, FRAME = 1, 5, 7  # messages of the server
CONNECT, REQUEST_MODELS = 0, 4  # requests of a client
SESSION: Final = "mocap/natnet3-motive2.1.pcapng"
BODY: Final = "RaceQuad"
_DATA_PORT_AT: Final = 4 + 256 + 4 + 4 + 8  # in the server's description: after name, versions and clock frequency


class Recorded(NamedTuple):
    """A rigid body in a frame: metres, and a quaternion x, y, z, w; y is up."""

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    tracked: bool


def datagrams() -> Iterator[bytes]:
    """Yield the payloads sent over UDP, in order."""
    data, at = recorded(SESSION).read_bytes(), 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind == 6:  # an enhanced packet block
            (captured,) = struct.unpack_from("<I", data, at + 20)
            packet = data[at + 28 : at + 28 + captured][14:]  # without Ethernet's header
            if packet[0] >> 4 == 4 and packet[9] == socket.IPPROTO_UDP:
                yield packet[(packet[0] & 15) * 4 + 8 :]
        at += size


def message(datagram: bytes) -> int:
    return int.from_bytes(datagram[:2], "little")


def frames() -> list[bytes]:
    return [datagram for datagram in datagrams() if message(datagram) == FRAME]


def rigid_body(frame: bytes) -> Recorded:
    """Return the only rigid body of a recorded frame (NatNet 3.0)."""
    at = 8  # message, size, number of the frame
    (sets,) = struct.unpack_from("<i", frame, at)
    at += 4
    for _ in range(sets):
        at = frame.index(b"\0", at) + 1
        (markers,) = struct.unpack_from("<i", frame, at)
        at += 4 + 12 * markers
    (markers,) = struct.unpack_from("<i", frame, at)
    at += 4 + 12 * markers
    (bodies,) = struct.unpack_from("<i", frame, at)
    assert bodies == 1
    _, x, y, z, qx, qy, qz, qw, _, flags = struct.unpack_from("<i8fh", frame, at + 4)
    return Recorded((x, y, z), (qx, qy, qz, qw), bool(flags & 1))


def serve(port: int, pause_s: float = 1 / 240) -> None:
    """Answer on a loopback port; after a request for the models, send the frames in a loop."""
    found = {message(datagram): datagram for datagram in datagrams()}
    recorded = frames()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as commands,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as data,
    ):
        commands.bind(("127.0.0.1", port))
        free.bind(("127.0.0.1", 0))
        data_port = free.getsockname()[1]
        free.close()
        info = bytearray(found[SERVER_INFO])
        struct.pack_into("<H", info, _DATA_PORT_AT, data_port)
        group = socket.inet_ntoa(info[_DATA_PORT_AT + 3 : _DATA_PORT_AT + 7])
        data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        print(f"ready {commands.getsockname()[1]}", flush=True)
        commands.settimeout(20.0)
        while True:
            asked, address = commands.recvfrom(2048)
            if message(asked) == CONNECT:
                commands.sendto(info, address)
            elif message(asked) == REQUEST_MODELS:
                commands.sendto(found[MODEL_DEFINITIONS], address)
                break
        commands.settimeout(0.0)
        while True:
            for frame in recorded:
                data.sendto(frame, (group, data_port))
                time.sleep(pause_s)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
