"""Alternatives to Skyloop, where installed: one file each, measured by the same contract.

``python -m benchmarks.peers`` measures them in turns with Skyloop and a bare transfer; ``--peers none`` measures only
those two.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from benchmarks.measuring.contenders import NETWORK, PORTABLE, Contender
from skyloop.errors import UnknownNameError

ROS_PYTHON_VARIABLE: Final = "SKYLOOP_ROS_PYTHON"
_LOOKS_WITHIN_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class Peer:
    """Another library: its required imports, and the package whose version is reported."""

    title: str
    imports: str
    package: str
    install: str
    module: str = ""  #: module with the two ends, if not in this package


PEERS: Final = {
    "ros2": Peer(
        "ROS 2 (rclpy)",
        "rclpy, sensor_msgs.msg, geometry_msgs.msg, numpy",
        "rclpy",
        "pip install ros-rclpy ros-rmw-fastrtps-cpp ros-sensor-msgs, in a separate environment, "
        "whose interpreter --ros-python names",
    ),
    "portable": Peer(PORTABLE.title, "skyloop", "skyloop", "pip install skyloop", PORTABLE.module),
    "fabric": Peer(NETWORK.title, "zenoh", "eclipse-zenoh", "skyloop install network", NETWORK.module),
    "zenoh": Peer("Zenoh", "zenoh", "eclipse-zenoh", "pip install eclipse-zenoh"),
    "zeromq": Peer("ZeroMQ", "zmq", "pyzmq", "pip install pyzmq"),
}


def chosen(text: str) -> list[str]:
    """Parse names of peers, separated by commas; ``all`` and ``none`` stand alone.

    Raises:
        UnknownNameError: No peer has this name.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if names == ["all"]:
        return list(PEERS)
    if names == ["none"]:
        return []
    for name in names:
        if name not in PEERS:
            raise UnknownNameError("peer", name, [*PEERS, "all", "none"])
    return list(dict.fromkeys(names))


def find(names: Iterable[str], ros_python: str | None = None) -> tuple[list[Contender], dict[str, str]]:
    """Return the peers that can be measured here, and why the others can't.

    Args:
        names: The peers' names.
        ros_python: The interpreter with ``rclpy``; None for that in ``SKYLOOP_ROS_PYTHON``, or this one.
    """
    found: list[Contender] = []
    skipped: dict[str, str] = {}
    for name in names:
        peer = PEERS[name]
        python = sys.executable
        if name == "ros2":
            python = ros_python or os.environ.get(ROS_PYTHON_VARIABLE) or python
        version, problem = _look(python, peer)
        if problem:
            skipped[name] = f"{problem}: {peer.install}"
        else:
            found.append(Contender(name, peer.title, peer.module or f"benchmarks.peers.{name}", python, version))
    return found, skipped


def _look(python: str, peer: Peer) -> tuple[str, str]:
    """Return the version and the problem, one of which is empty."""
    code = f"import {peer.imports}; from importlib.metadata import version; print(version({peer.package!r}))"
    try:
        ended = subprocess.run(
            [python, "-c", code], capture_output=True, text=True, timeout=_LOOKS_WITHIN_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return "", f"{python} does not run ({type(error).__name__})"
    if ended.returncode:
        return "", (ended.stderr.strip().splitlines() or ["it can't be imported"])[-1]
    return ended.stdout.strip().splitlines()[-1], ""
