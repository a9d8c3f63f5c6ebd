"""Eclipse Zenoh: two peers on the loopback interface, connected by address; callbacks on its own threads."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.measuring.waypoints import Setpoint

_PACKET = struct.Struct("<q11d")  # a stamp, and as many numbers as in feedback or a command
_FRAME = struct.Struct("<qqq")  # stamp, columns, rows
_PORTS = range(17_600, 17_700)


class _End:
    _session: Any

    def _publisher(self, topic: str) -> Any:
        return self._session.declare_publisher(
            f"bench/{topic}", congestion_control=zenoh.CongestionControl.DROP, express=True
        )

    def _packets(self, topic: str, received: Received) -> None:
        def take(sample: Any) -> None:
            received(topic, _PACKET.unpack(sample.payload.to_bytes())[0])

        self._session.declare_subscriber(f"bench/{topic}", take)

    def close(self) -> None:
        self._session.close()


class Vehicle(_End):
    def __init__(self, address: str, received: Received) -> None:
        self._session, endpoint = _listen()
        (Path(address) / "zenoh").write_text(endpoint)
        self._packets(COMMAND, received)
        self._feedback = self._publisher(FEEDBACK)
        self._video = self._publisher(VIDEO)

    def feedback(self, sent_ns: int) -> None:
        self._feedback.put(_PACKET.pack(sent_ns, *[0.5] * 11))

    def frame(self, sent_ns: int, image: Image) -> None:
        height, width, _ = image.shape
        self._video.put(image.tobytes(), attachment=_FRAME.pack(sent_ns, width, height))


class Application(_End):
    def __init__(self, address: str, received: Received) -> None:
        self._session = _open("connect", (Path(address) / "zenoh").read_text())
        self._packets(FEEDBACK, received)

        def show(sample: Any) -> None:
            sent_ns, width, height = _FRAME.unpack(sample.attachment.to_bytes())
            np.frombuffer(sample.payload.to_bytes(), np.uint8).reshape(height, width, 3)
            received(VIDEO, sent_ns)

        self._session.declare_subscriber(f"bench/{VIDEO}", show)
        self._commands = self._publisher(COMMAND)
        time.sleep(0.1)

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        self._commands.put(_PACKET.pack(sent_ns, *setpoint, *[0.0] * 8))


def _listen() -> tuple[Any, str]:
    """Return a session on a free port, and its address."""
    for port in _PORTS:
        endpoint = f"tcp/127.0.0.1:{port}"
        try:
            return _open("listen", endpoint), endpoint
        except zenoh.ZError:
            continue  # the port is in use
    raise OSError(f"no port from {_PORTS[0]} to {_PORTS[-1]} is free on 127.0.0.1")


def _open(how: str, endpoint: str) -> Any:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5(f"{how}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)
