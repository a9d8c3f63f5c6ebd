"""Messages of a robot."""

from __future__ import annotations

from types import SimpleNamespace as Message

import numpy as np

from skyloop.messages.geometry import quaternion_from_euler


def stamp(ns: int) -> Message:
    return Message(stamp=Message(sec=ns // 10**9, nanosec=ns % 10**9))


def vector(x: float, y: float, z: float) -> Message:
    return Message(x=x, y=y, z=z)


def odometry(ns: int, z: float = 0.0, pitch: float = 0.0, forward: float = 0.0) -> Message:
    x, y, qz, w = quaternion_from_euler(0.0, pitch, 0.5)
    pose = Message(position=vector(1.0, 2.0, z), orientation=Message(x=x, y=y, z=qz, w=w))
    twist = Message(linear=vector(forward, 0.0, 0.0), angular=vector(0.0, 0.0, 0.1))
    return Message(header=stamp(ns), pose=Message(pose=pose), twist=Message(twist=twist))


def image(ns: int, width: int = 4, height: int = 2, encoding: str = "bgr8") -> Message:
    data = np.zeros(width * height * 3, np.uint8)
    return Message(header=stamp(ns), width=width, height=height, step=3 * width, encoding=encoding, data=data)
