"""``tf2_msgs/msg/TFMessage`` as bytes: there is no package of it to install without a distribution of ROS 2. Pure.

The bytes are OMG's Common Data Representation, version 1, little-endian, as DDS carries it: four bytes that say so,
then the fields in order, each number aligned to its size, counted from behind those four bytes; a text is its length
with the closing zero, the text, and the zero.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Final, NamedTuple

from skyloop.messages import Vector
from skyloop.vehicles.ros2.wire.conversions import Quaternion, stamp_of

TYPE_NAME: Final = "tf2_msgs/msg/TFMessage"
#: Of its definition, by REP 2011; ``tests/third_party/ros2_bag.py`` compares it with that of rosbags.
TYPE_HASH: Final = bytes.fromhex("e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
_LITTLE_ENDIAN_CDR: Final = b"\x00\x01\x00\x00"


class Transform(NamedTuple):
    """One ``geometry_msgs/TransformStamped``: the pose of ``child`` in the axes of ``parent``."""

    stamp_ns: int  #: ROS time
    parent: str
    child: str
    translation_m: Vector
    rotation: Quaternion


def encode_transforms(transforms: Iterable[Transform]) -> bytes:
    """Return a ``tf2_msgs/msg/TFMessage`` with these transforms."""
    known = list(transforms)
    packed = bytearray(struct.pack("<I", len(known)))
    for each in known:
        packed += bytes(-len(packed) % 4)
        packed += struct.pack("<iI", *stamp_of(each.stamp_ns))
        for text in (each.parent, each.child):
            encoded = text.encode() + b"\0"
            packed += bytes(-len(packed) % 4)
            packed += struct.pack("<I", len(encoded)) + encoded
        packed += bytes(-len(packed) % 8)
        packed += struct.pack("<7d", *each.translation_m, *each.rotation)
    return _LITTLE_ENDIAN_CDR + bytes(packed)
