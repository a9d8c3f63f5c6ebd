"""An emulated Tello on the network, over a drone of a simulated world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from skyloop.errors import UsageError
from skyloop.sim.firmware.encoders import require_encoder
from skyloop.sim.firmware.firmware import NO_FAULTS, Firmware, checked_delay
from skyloop.sim.firmware.tello.board import Board
from skyloop.sim.firmware.tello.pads import MOST
from skyloop.sim.firmware.tello.running import RunningFirmware
from skyloop.sim.firmware.tello.settings import Settings
from skyloop.sim.host import SimHost
from skyloop.transport.faults import Faults
from skyloop.wire.tello.commands import PORT, Sdk


class TelloFirmware(Firmware[RunningFirmware]):
    """The firmware of one drone of a host's world. Several may share a host, each with a drone and an address.

    ``sdk``: 1.3, 2.0 or 3.0. ``bind``: the address of this machine to listen on, at UDP ``port`` (0: any free one).
    ``faults`` befall all datagrams, each way, and all of them are ``delay_s`` late. ``pads``: mission pads that lie on
    the floor, by their number from 1 to 8, x and y in world axes.

    Make the host with :func:`with_tellos`. Raises :class:`UsageError` for settings that make no sense,
    :class:`skyloop.errors.MissingExtraError` without what draws and encodes pictures.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        sdk: str = Sdk.V3_0,
        bind: str = "127.0.0.1",
        port: int = PORT,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        pads: Mapping[int, tuple[float, float]] | None = None,
    ) -> None:
        if sdk not in list(Sdk):
            raise UsageError(f"there is SDK {', '.join(Sdk)} of the Tello, not {sdk!r}")
        for number in pads or {}:
            if not 1 <= number <= MOST:
                raise UsageError(f"mission pads are numbered from 1 to {MOST}, not {number!r}")
        require_encoder("the video of an emulated Tello")
        super().__init__(host, drone)
        self.settings = Settings(Sdk(sdk), bind, port, faults, checked_delay(delay_s), dict(pads or {}))

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, port=running.port)  # found again after a restart
        return running

    @property
    def port(self) -> int:
        """The real one. Raises :class:`UsageError` if it is not started."""
        return self._started.port

    @property
    def board(self) -> Board:
        """For tests: the state of the running firmware, which belongs to its thread. Raises :class:`UsageError` if it
        is not started."""
        return self._started.board
