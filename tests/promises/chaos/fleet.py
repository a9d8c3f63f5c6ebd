"""``skyloop host`` with one MAVLink vehicle: ``python -m tests.promises.chaos.fleet NAME FOLDER ADDRESS``.

The failsafes of its proxy are journalled.
"""

from __future__ import annotations

import sys
from pathlib import Path

from skyloop.drivers.base import Sink
from skyloop.drivers.uri import parse_uri
from skyloop.host.fleet import Defaults, Fleet, VehicleSettings
from skyloop.host.serve import serve
from skyloop.messages import Hover, Land
from skyloop.vehicles.mavlink.driver import MavlinkDriver
from tests.promises.chaos.journal import Journal


def main() -> None:
    """Serve until killed."""
    name, folder, uri = sys.argv[1], Path(sys.argv[2]), parse_uri(sys.argv[3])
    journal = Journal(folder / f"{name}.vehicle")
    opening, acting = MavlinkDriver._open, MavlinkDriver.failsafe

    def open_it(driver: MavlinkDriver, sink: Sink) -> None:
        if driver.uri == uri:
            journal.write("open")
        opening(driver, sink)

    def failsafe(driver: MavlinkDriver, action: Hover | Land) -> bool:
        done = acting(driver, action)
        if driver.uri == uri:
            journal.write(f"failsafe:{action.name}")  # from here on no older command is sent
        return done

    setattr(MavlinkDriver, "_open", open_it)  # noqa: B010  (which mypy would not let be assigned)
    setattr(MavlinkDriver, "failsafe", failsafe)  # noqa: B010
    serve(Fleet(name, (VehicleSettings(name, uri),), Defaults()))


if __name__ == "__main__":
    main()
