"""An emulated AR.Drone on the network, over a drone of a simulated world."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from skyloop.errors import UsageError
from skyloop.sim.firmware.ardrone.board import MainBoard
from skyloop.sim.firmware.ardrone.encoders import require_encoder
from skyloop.sim.firmware.ardrone.running import RunningFirmware
from skyloop.sim.firmware.ardrone.settings import NO_FAULTS, Settings
from skyloop.sim.host import SimHost
from skyloop.transport.faults import Faults
from skyloop.wire.ardrone.ports import STANDARD, Ports

VERSIONS: Final = (1, 2)


class ArdroneFirmware:
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
        if not 0 <= delay_s <= 10:
            raise UsageError(f"a delay is from 0 to 10 s, not {delay_s!r}")
        if version > 1:
            require_encoder()
        self.host = host
        self.drone = drone
        self.settings = Settings(version, bind, ports, faults, delay_s, header_size, torn_start)
        self._running: RunningFirmware | None = None

    def start(self) -> None:
        """Switch the drone on: its clock, its configuration and its link begin anew.

        Raises :class:`skyloop.errors.LinkError` if a port is taken, and :class:`UsageError` if it is started already
        or somebody else has this drone.
        """
        if self._running is not None:
            raise UsageError("this firmware is started already")
        self._running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, ports=self._running.ports)  # found again after a restart

    def stop(self) -> None:
        """Switch it off, in the middle of whatever it does; the vehicle goes on with what it was told last. When this
        returns the ports are free again. Does nothing if it is not started."""
        running, self._running = self._running, None
        if running is not None:
            running.stop()

    @property
    def ports(self) -> Ports:
        """The real ones. Raises :class:`UsageError` if it is not started."""
        if self._running is None:
            raise UsageError("firmware that is not started has no ports: call start() first")
        return self._running.ports

    @property
    def board(self) -> MainBoard:
        """For tests: the state of the running firmware, which belongs to its thread. Raises :class:`UsageError` if it
        is not started."""
        if self._running is None:
            raise UsageError("firmware that is not started has no state: call start() first")
        return self._running.board

    def __enter__(self) -> ArdroneFirmware:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
