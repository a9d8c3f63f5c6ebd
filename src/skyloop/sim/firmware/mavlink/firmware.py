"""An emulated autopilot on the network, over a drone of a simulated world."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from skyloop.errors import UsageError
from skyloop.sim.firmware.firmware import NO_FAULTS, Firmware, checked_delay
from skyloop.sim.firmware.mavlink.autopilot import Autopilot
from skyloop.sim.firmware.mavlink.running import RunningFirmware
from skyloop.sim.firmware.mavlink.settings import Kind, Ports, Settings
from skyloop.sim.host import SimHost
from skyloop.transport.faults import Faults

BOOT_S: Final = 2.0


class MavlinkFirmware(Firmware[RunningFirmware]):
    """The autopilot of one drone of a host's world. Several may share a host, each with a drone and ports of its own.

    ``system``: its MAVLink system id, the drone's number plus one by default. ``boot_s``: from the start until it lets
    itself be armed, in seconds of the simulation (real ones take 5 to 40). ``gps``: without it the autopilot is not
    ready before poses come from outside. ``version`` 1: it speaks the old MAVLink, and answers in nothing else.
    ``key``: 32 bytes that sign everything. ``faults`` befall UDP datagrams, each way, and they are ``delay_s`` late.

    ``video``: host and port to which the front camera's pictures are sent over UDP.

    Make the host with :func:`with_multirotors`. Raises :class:`UsageError` for what can't be, and
    :class:`skyloop.errors.MissingExtraError` without pymavlink.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        kind: Kind,
        bind: str = "127.0.0.1",
        ports: Ports | None = None,
        system: int | None = None,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        boot_s: float = BOOT_S,
        gps: bool = True,
        version: int = 2,
        key: bytes | None = None,
        video: tuple[str, int] | None = None,
    ) -> None:
        number = drone + 1 if system is None else system
        if not 1 <= number <= 255:
            raise UsageError(f"a system id is from 1 to 255, not {number!r}")
        if version not in (1, 2):
            raise UsageError(f"there is MAVLink 1 and MAVLink 2, not {version!r}")
        super().__init__(host, drone)
        delay_s = checked_delay(delay_s)
        ports = ports or Ports.standard(kind, drone)
        self.settings = Settings(kind, bind, ports, number, faults, delay_s, boot_s, gps, version, key, video)

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, ports=running.ports)  # found again after a restart
        return running

    @property
    def autopilot(self) -> Autopilot:
        """For tests: the running autopilot, which belongs to its thread. Raises :class:`UsageError` if it is not
        started."""
        return self._started.autopilot

    @property
    def address(self) -> str:
        """What a driver on this machine calls it by, over UDP."""
        return f"mavlink://udpin:{self.settings.bind}:{self.settings.ports.remote}"

    @property
    def tcp_address(self) -> str:
        """The same over TCP. Raises :class:`UsageError` for a kind that has no such port."""
        if self.settings.ports.tcp is None:
            raise UsageError(f"an emulated {self.settings.kind.value} has no TCP port")
        return f"mavlink://tcp:{self.settings.bind}:{self.settings.ports.tcp}"

    @property
    def description(self) -> str:
        """One line: where it is."""
        settings = self.settings
        tcp = f", {self.tcp_address}" if settings.ports.tcp is not None else ""
        return (
            f"{settings.kind.value} drone {self.drone}, system {settings.system}, "
            f"from udp {settings.ports.udp}: {self.address}{tcp}"
        )
