"""The process that listens to a motion capture system: ``python -m skyloop.motion_capture.worker KIND SETTINGS``.

The ``motioncapture`` package waits in native code, without a time-out and partly with the interpreter locked: in a
process of its own it can hold up nobody, and be ended whatever it waits for. Each frame goes to standard output as one
msgpack array with its length before it: when it came, and of each body that is seen its position and quaternion.
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
    """The next frame; None at the end. Raises ``msgspec.DecodeError`` for what is none."""
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (size,) = LENGTH.unpack(head)
    if size > MAX_FRAME:
        raise msgspec.DecodeError(f"a frame of {size} bytes")
    data = stream.read(size)
    return None if len(data) < size else msgspec.msgpack.decode(data, type=RawFrame)


def write(stream: BinaryIO, frame: RawFrame) -> None:
    data = msgspec.msgpack.encode(frame)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def seen(bodies: Any) -> dict[str, Seen]:
    """What the package gives of the bodies, as plain numbers."""
    found: dict[str, Seen] = {}
    for name, body in bodies.items():
        x, y, z = (float(value) for value in body.position)
        turn = body.rotation
        found[name] = ((x, y, z), (float(turn.x), float(turn.y), float(turn.z), float(turn.w)))
    return found


def open_output() -> BinaryIO:
    """Standard output, for frames alone: what the native code prints goes to standard error."""
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    return output


def main(kind: str, settings: str) -> int:
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
        return 0  # whoever listened is gone
    except Exception as error:  # noqa: BLE001  whatever the native code throws
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2]))
