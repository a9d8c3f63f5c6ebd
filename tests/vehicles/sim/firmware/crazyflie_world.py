"""A world with a real Crazyflie's firmware and no driver, for a test that kills the proxy: ``crazyflie_world.py FILE``.

It prints its address, and ``flies`` once the firmware controls the rotors. The file gets the true height, line by line.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence
from skyloop.vehicles.sim.firmware.crazyflie import Crazyflie
from skyloop.vehicles.sim.firmware.program import FirmwareEvent, FirmwareEventKind
from skyloop.vehicles.sim.options import options_of


class Teller:
    """Writes the true height to a file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", buffering=1, encoding="ascii")

    def report(self, report: Report) -> None:
        self._file.write(f"{report.truth.position_m[2]:.3f}\n")

    def happened(self, occurrence: Occurrence) -> None:
        print(occurrence.text, flush=True)

    def wanted_fps(self, camera: str) -> float:
        return 0.0

    def failed(self, error: Exception) -> None:
        print(error, flush=True)


def _told(event: FirmwareEvent) -> None:
    print("flies" if event.kind is FirmwareEventKind.ANSWERS else event.text, flush=True)


def main() -> None:
    """Fly until killed."""
    host = SimHost(options_of(parse_uri("sim://?autopilot=crazyflie&world=empty&cameras=none&wind=0")))
    firmware = Crazyflie(_told)
    firmware.start()
    host.simulation.fly_by(0, firmware)
    print(f"address {firmware.address} ", flush=True)
    screen: Any = None
    host.attach(0, Teller(Path(sys.argv[1])), screen, [])
    threading.Event().wait()


if __name__ == "__main__":
    main()
