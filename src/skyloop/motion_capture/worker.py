"""The process that receives from a motion capture system: :func:`main` with its kind and settings.

The ``motioncapture`` package waits in native code, without a timeout and partly with the interpreter locked. In its own
process it can block nobody, and can be killed whatever it waits for. Each frame is written to standard output as a
msgpack array, preceded by its length: when it was received, and position and quaternion of each body that is seen.
"""

from __future__ import annotations

import os
import struct
import sys
import time
from typing import Any, BinaryIO, Final

import msgspec

LENGTH: Final = struct.Struct("<I")
MAX_FRAME: Final = 1 << 20  #: bytes; a system with thousands of bodies stays below
MISSING: Final = 3  #: exit code where the package is missing

Seen = tuple[tuple[float, float, float], tuple[float, float, float, float]]


class RawFrame(msgspec.Struct, frozen=True, array_like=True):
    """What a system saw at one time, in its own axes."""

    received_ns: int  #: ``time.monotonic_ns`` of this host
    bodies: dict[str, Seen]  #: position [m] and quaternion (x, y, z, w) of each body that is tracked


def read(stream: BinaryIO) -> RawFrame | None:
    """Read the next frame.

    Returns:
        The frame; None at the end of the stream.

    Raises:
        msgspec.DecodeError: The data are no frame.
    """
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (size,) = LENGTH.unpack(head)
    if size > MAX_FRAME:
        raise msgspec.DecodeError(f"a frame of {size} bytes")
    data = stream.read(size)
    return None if len(data) < size else msgspec.msgpack.decode(data, type=RawFrame)


def write(stream: BinaryIO, frame: RawFrame) -> None:
    """Write a frame and flush."""
    data = msgspec.msgpack.encode(frame)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def seen(bodies: Any) -> dict[str, Seen]:
    """Convert the package's bodies to plain numbers."""
    found: dict[str, Seen] = {}
    for name, body in bodies.items():
        x, y, z = (float(value) for value in body.position)
        turn = body.rotation
        found[name] = ((x, y, z), (float(turn.x), float(turn.y), float(turn.z), float(turn.w)))
    return found


def open_output() -> BinaryIO:
    """Return standard output for frames alone, and redirect what native code prints to standard error."""
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    return output


def main(kind: str, settings: str) -> int:
    """Connect and write frames until the reader is gone.

    Args:
        kind: The system's name in the ``motioncapture`` package.
        settings: JSON object of strings, for its ``connect``.

    Returns:
        The exit code: 0 when the reader is gone, :data:`MISSING` without the package, 1 for any other error.
    """
    try:
        import motioncapture
    except ImportError as error:
        print(error, file=sys.stderr)
        return MISSING
    output = open_output()
    try:
        system = motioncapture.connect(kind, msgspec.json.decode(settings, type=dict[str, str]))
        while True:
            system.waitForNextFrame()
            write(output, RawFrame(time.monotonic_ns(), seen(system.rigidBodies)))
    except BrokenPipeError:
        return 0  # the reader is gone
    except Exception as error:  # noqa: BLE001  whatever the native code throws
        print(error, file=sys.stderr)
        return 1
