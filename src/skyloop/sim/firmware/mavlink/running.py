"""The autopilot from the moment it is switched on: its ports and the thread that serves them."""

from __future__ import annotations

from functools import partial

from skyloop.clock import monotonic_ns
from skyloop.sim.firmware.mavlink.arducopter import ArduCopter
from skyloop.sim.firmware.mavlink.autopilot import Autopilot
from skyloop.sim.firmware.mavlink.links import Port, TcpPort, UdpPort
from skyloop.sim.firmware.mavlink.px4 import Px4
from skyloop.sim.firmware.mavlink.settings import Kind, Ports, Settings
from skyloop.sim.firmware.mavlink.streams import Streams
from skyloop.sim.firmware.mavlink.video import CAMERA, TransportStream, encoding
from skyloop.sim.firmware.running import Running
from skyloop.sim.firmware.vehicle import SimulatedVehicle
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence, OccurrenceKind

_KINDS: dict[Kind, type[Autopilot]] = {Kind.ARDUCOPTER: ArduCopter, Kind.PX4: Px4}


class RunningFirmware(Running):
    """The autopilot belongs to the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: Settings) -> None:
        super().__init__(host, drone, f"skyloop-{settings.kind.value}")
        kind = _KINDS[settings.kind]
        self.autopilot = kind(SimulatedVehicle(host.simulation, drone), settings.system, settings.boot_s, settings.gps)
        try:
            udp = UdpPort(self._loop, settings, Streams(kind.RATES), self._heard)
            self._open.append(udp)
            tcp = None
            if settings.ports.tcp is not None:
                tcp = TcpPort(self._loop, settings, Streams(kind.RATES), self._heard)
                self._open.append(tcp)
            self.ports = Ports(udp.port, settings.ports.remote, tcp.port if tcp is not None else None)
            self.autopilot.ports = (udp,) if tcp is None else (udp, tcp)
            self._loop.start()
            if settings.video is not None:
                stream = TransportStream(*settings.video)
                self._open.append(stream)
                self._video = encoding(stream)
                self._video.start()
            host.board(drone, self, self, [CAMERA] if self._video is not None else [])
        except BaseException:
            self.stop()
            raise

    def _heard(self, port: Port, message: object) -> None:
        self.autopilot.heard(port, message, monotonic_ns())

    def _tick(self, report: Report) -> None:
        self.autopilot.tick(report)

    # Called by the host, on its threads ------------------------------------------------------------------------

    def happened(self, occurrence: Occurrence) -> None:
        """A crash stops the motors; the autopilot says so."""
        super().happened(occurrence)
        if occurrence.kind is OccurrenceKind.EMERGENCY:
            self._loop.post(partial(self.autopilot.crashed, occurrence.text))
