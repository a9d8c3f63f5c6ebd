"""The firmware of a name, imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from skyloop.sim.parameters import InstrumentParameters
from skyloop.vehicles.sim.firmware.coupling import CoupledFirmware
from skyloop.vehicles.sim.firmware.kinds import AutopilotKind
from skyloop.vehicles.sim.firmware.program import FirmwareEvent


def make_firmware(
    kind: AutopilotKind,
    on_event: Callable[[FirmwareEvent], None],
    *,
    instruments: InstrumentParameters,
    folder: Path | None = None,
) -> CoupledFirmware:
    """Return a firmware that is not yet started.

    Args:
        kind: Which.
        on_event: Called with each event, on the simulation's thread or one of the program; must return quickly.
        instruments: Of the vehicle that it is to fly.
        folder: Where it runs and keeps its settings; None: a new one, removed at the end.

    Raises:
        MissingExtraError: A package that it needs is not installed.
    """
    if kind is AutopilotKind.ARDUPILOT:
        from skyloop.vehicles.sim.firmware.ardupilot import ArduCopter

        return ArduCopter(on_event, folder=folder)
    if kind is AutopilotKind.PX4:
        from skyloop.vehicles.sim.firmware.px4 import Px4

        return Px4(on_event, folder=folder, instruments=instruments)
    from skyloop.vehicles.sim.firmware.betaflight import Betaflight

    return Betaflight(on_event, folder=folder)
