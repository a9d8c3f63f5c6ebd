"""The autopilot from the moment it is switched on: its ports and the thread that serves them."""

from __future__ import annotations

import logging
from functools import partial

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.sim.camera import CameraModel
from skyloop.sim.firmware.ardrone.loop import Loop
from skyloop.sim.firmware.ardrone.vehicle import SimulatedVehicle
from skyloop.sim.firmware.ardrone.video import VideoEncoding
from skyloop.sim.firmware.mavlink.arducopter import ArduCopter
from skyloop.sim.firmware.mavlink.autopilot import Autopilot
from skyloop.sim.firmware.mavlink.links import Port, TcpPort, UdpPort
from skyloop.sim.firmware.mavlink.px4 import Px4
from skyloop.sim.firmware.mavlink.settings import Kind, Ports, Settings
from skyloop.sim.firmware.mavlink.streams import Streams
from skyloop.sim.firmware.mavlink.video import CAMERA, TransportStream, encoding
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence, OccurrenceKind

_log = logging.getLogger(__name__)
_KINDS: dict[Kind, type[Autopilot]] = {Kind.ARDUCOPTER: ArduCopter, Kind.PX4: Px4}


class RunningFirmware:
    """A passenger of the host, from its making until :meth:`stop`. The autopilot belongs to the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: Settings) -> None:
        self._host, self._drone = host, drone
        self._report: Report | None = None
        self._loop = Loop(f"skyloop-{settings.kind.value}")
        kind = _KINDS[settings.kind]
        self.autopilot = kind(SimulatedVehicle(host.simulation, drone), settings.system, settings.boot_s, settings.gps)
        self._open: list[Port] = []
        self._stream: TransportStream | None = None
        self._video: VideoEncoding | None = None
        try:
            udp = UdpPort(self._loop, settings, Streams(kind.RATES), self._heard)
            self._open.append(udp)
            tcp = None
            if settings.ports.tcp is not None:
                tcp = TcpPort(self._loop, settings, Streams(kind.RATES), self._heard)
                self._open.append(tcp)
            self.ports = Ports(udp.port, settings.ports.remote, tcp.port if tcp is not None else None)
            self.autopilot.ports = tuple(self._open)
            self._loop.start()
            if settings.video is not None:
                self._stream = TransportStream(*settings.video)
                self._video = encoding(self._stream)
                self._video.start()
            host.board(drone, self, self, [CAMERA] if self._video is not None else [])
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """When this returns the ports are free."""
        self._host.leave(self._drone, self)
        if self._video is not None:
            self._video.stop()
        if self._stream is not None:
            self._stream.close()
        self._loop.stop()
        for port in self._open:
            port.close()

    def _heard(self, port: Port, message: object) -> None:
        self.autopilot.heard(port, message, monotonic_ns())

    def _tick(self) -> None:
        report, self._report = self._report, None
        if report is not None:
            self.autopilot.tick(report)

    # Called by the host, on its threads ------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """What the drone believes now; what was not looked at yet is overtaken."""
        waiting, self._report = self._report, report
        if waiting is None:
            self._loop.post(self._tick)

    def happened(self, occurrence: Occurrence) -> None:
        """A crash stops the motors; the autopilot says so."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)
        if occurrence.kind is OccurrenceKind.EMERGENCY:
            self._loop.post(partial(self.autopilot.crashed, occurrence.text))

    def wants(self, camera: str) -> bool:
        """Pictures go out whether anybody looks or not, as such cameras do it."""
        return self._video is not None and self._video.wants(camera)

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """A picture is due."""
        if self._video is not None:
            self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """The simulation broke. Without reports nothing goes out, as from a drone that is dead."""
        _log.error("the simulation of drone %d failed: %r", self._drone, error)
