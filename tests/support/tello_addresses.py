"""Addresses of this machine that no other test has, so that a Tello's fixed ports are free there."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass

_COUNT = itertools.count(1)


@dataclass(frozen=True)
class Addresses:
    """Of a drone and of who flies it."""

    drone: str
    pilot: str

    @classmethod
    def free(cls) -> Addresses:
        """In 127.0.0.0/8: by this process and how many were given before."""
        pid, count = os.getpid(), next(_COUNT)
        base = f"127.{64 + (pid >> 8) % 64}.{pid & 0xFF}"
        return cls(f"{base}.{2 * count % 250 + 1}", f"{base}.{2 * count % 250 + 2}")

    def uri(self, **options: object) -> str:
        """To fly it by."""
        more = "".join(f"&{name}={value}" for name, value in options.items())
        return f"tello://{self.drone}?local={self.pilot}{more}"
