"""Addresses of this machine that no other test uses, so that a Tello's fixed ports are free there."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass

_COUNT = itertools.count(1)


@dataclass(frozen=True)
class Addresses:
    """The addresses of a drone and its pilot."""

    drone: str
    pilot: str

    @classmethod
    def free(cls) -> Addresses:
        """Return addresses in 127.0.0.0/8 derived from the process id and a counter."""
        pid, count = os.getpid(), next(_COUNT)
        base = f"127.{64 + (pid >> 8) % 64}.{pid & 0xFF}"
        return cls(f"{base}.{2 * count % 250 + 1}", f"{base}.{2 * count % 250 + 2}")

    def uri(self, **options: object) -> str:
        """Address for the driver."""
        more = "".join(f"&{name}={value}" for name, value in options.items())
        return f"tello://{self.drone}?local={self.pilot}{more}"
