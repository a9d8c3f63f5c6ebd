"""An emulated AR.Drone on the network, over a drone of a simulated world."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from skyloop.errors import UsageError
from skyloop.sim.firmware.ardrone.board import MainBoard
from skyloop.sim.firmware.ardrone.running import RunningFirmware
from skyloop.sim.firmware.ardrone.settings import Settings
from skyloop.sim.firmware.encoders import require_encoder
from skyloop.sim.firmware.firmware import NO_FAULTS, Firmware, checked_delay
from skyloop.sim.host import SimHost
from skyloop.transport.faults import Faults
from skyloop.wire.ardrone.ports import STANDARD, Ports

VERSIONS: Final = (1, 2)


class ArdroneFirmware(Firmware[RunningFirmware]):
    """The firmware of one drone of a host's world. Several may share a host, each with a drone and ports of its own.

    ``version``: 1 or 2. ``bind``: the address of this machine to listen on. ``faults`` befall the datagrams of AT
    commands, navdata and an AR.Drone 1's video, each way, and all of them are ``delay_s`` late. ``header_size``: of
    the PaVE headers, 68 bytes or, as early firmware has it, 64. ``torn_start``: who connects to an AR.Drone 2's video
    gets the last picture that was sent to somebody before, however old, and then what comes, key frame or not, as from
    a real drone; otherwise the stream begins with the next key frame.

    Make the host with :func:`with_ardrones`. Full navdata is sent as often as the host reports
    (:attr:`skyloop.sim.options.SimOptions.rate_hz`), and at most 125 times a second; real drones send 200.

    Raises :class:`UsageError` for a version or header that does not exist, :class:`skyloop.errors.MissingExtraError`
    without what draws and encodes pictures.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        version: int = 2,
        bind: str = "127.0.0.1",
        ports: Ports = STANDARD,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        header_size: int = 68,
        torn_start: bool = True,
    ) -> None:
        if version not in VERSIONS:
            raise UsageError(f"there is an AR.Drone 1 and an AR.Drone 2, and none of version {version!r}")
        if header_size not in (64, 68):
            raise UsageError(f"a PaVE header has 64 or 68 bytes, not {header_size!r}")
        if version > 1:
            require_encoder()
        super().__init__(host, drone)
        self.settings = Settings(version, bind, ports, faults, checked_delay(delay_s), header_size, torn_start)

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, ports=running.ports)  # found again after a restart
        return running

    @property
    def ports(self) -> Ports:
        """The real ones. Raises :class:`UsageError` if it is not started."""
        return self._started.ports

    @property
    def board(self) -> MainBoard:
        """For tests: the state of the running firmware, which belongs to its thread. Raises :class:`UsageError` if it
        is not started."""
        return self._started.board
