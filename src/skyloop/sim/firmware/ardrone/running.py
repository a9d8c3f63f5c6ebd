"""The firmware from the moment it is switched on: the main board, its ports, its video."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.sim.camera import CameraModel
from skyloop.sim.firmware.ardrone.board import MainBoard
from skyloop.sim.firmware.ardrone.cameras import CAMERAS
from skyloop.sim.firmware.ardrone.clock import DroneClock
from skyloop.sim.firmware.ardrone.datagrams import Address, DatagramPort
from skyloop.sim.firmware.ardrone.listeners import Listeners
from skyloop.sim.firmware.ardrone.loop import Loop
from skyloop.sim.firmware.ardrone.settings import Settings
from skyloop.sim.firmware.ardrone.streams import Outlet, StreamPort
from skyloop.sim.firmware.ardrone.telemetry import Snapshot, options_of, tags_of
from skyloop.sim.firmware.ardrone.vehicle import SimulatedVehicle
from skyloop.sim.firmware.ardrone.video import Packer, PavePacker, Piece, UvlcPacker, VideoEncoding
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence
from skyloop.wire.ardrone import navdata
from skyloop.wire.ardrone.ports import Ports

if TYPE_CHECKING:
    from skyloop.sim.studio import Camera

DEMO_HZ: Final = 15.0

_log = logging.getLogger(__name__)


class RunningFirmware:
    """A passenger of the host, from its making until :meth:`stop`.

    The board, the ports and who listens belong to the loop's thread; the host's threads only leave their reports and
    pictures, and look at what is replaced as a whole.
    """

    def __init__(self, host: SimHost, drone: int, settings: Settings) -> None:
        self._host, self._drone, self._settings = host, drone, settings
        self._clock = DroneClock(monotonic_ns())
        self._report: Report | None = None
        self._posted = False
        self._demo_due_ns = 0
        self._stale = b""  # the picture sent last that needs others before it
        self._navdata_clients, self._video_clients = Listeners(), Listeners()
        self._most_thrust = host.simulation.parameters[drone].most_thrust
        self._loop = Loop("skyloop-ardrone")
        vehicle = SimulatedVehicle(host.simulation, drone)
        self.board = MainBoard(vehicle, self._send_text, monotonic_ns, version=settings.version)
        self._shown = self.board.video
        self._video = VideoEncoding(self._packer(), lambda: self._shown, self._encoded)
        self._cameras: tuple[Camera, ...] = ()
        self._open: list[DatagramPort | StreamPort] = []
        try:
            self._open_ports(settings.ports)
            self._video.start()
            self._loop.start()
            self._cameras = host.board(drone, self, self, list(CAMERAS[settings.version]))
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """When this returns the ports are free."""
        self._host.leave(self._drone, self)
        self._video.stop()
        self._loop.stop()
        for port in self._open:
            port.close()

    # Ports -----------------------------------------------------------------------------------------------------

    def _open_ports(self, wanted: Ports) -> None:
        self._navdata_port = self._datagrams("navdata", wanted.navdata, self._asked_for_navdata)
        self._at_port = self._datagrams("AT", wanted.at, self._heard_commands)
        self._control_port = self._stream("control", wanted.control)
        self._video_stream: StreamPort | None = None
        self._video_datagrams: DatagramPort | None = None
        if self._settings.version == 1:
            self._video_datagrams = self._datagrams("video", wanted.video, self._asked_for_video)
            video = self._video_datagrams.port
        else:
            self._video_stream = self._stream("video", wanted.video, self._joined_video)
            video = self._video_stream.port
        self.ports = Ports(self._navdata_port.port, video, self._at_port.port, self._control_port.port)

    def _datagrams(self, name: str, port: int, heard: Callable[[bytes, Address], None]) -> DatagramPort:
        settings = self._settings
        opened = DatagramPort(
            self._loop, (settings.bind, port), heard, name=name, faults=settings.faults, delay_s=settings.delay_s
        )
        self._open.append(opened)
        return opened

    def _stream(self, name: str, port: int, joined: Callable[[Outlet], None] | None = None) -> StreamPort:
        opened = StreamPort(self._loop, (self._settings.bind, port), name=name, joined=joined)
        self._open.append(opened)
        return opened

    # Commands and navdata, on the loop's thread ----------------------------------------------------------------

    def _heard_commands(self, datagram: bytes, _sender: Address) -> None:
        self.board.receive(datagram)
        self._look_at_video()

    def _send_text(self, text: bytes) -> None:
        self._control_port.accept()  # who connected just before the command belongs to those who are meant
        self._control_port.broadcast(text)

    def _asked_for_navdata(self, _datagram: bytes, sender: Address) -> None:
        if self._navdata_clients.heard(sender):
            self._demo_due_ns = 0

    def _tick(self) -> None:
        """There is a new report."""
        self._posted = False
        report = self._report
        if report is None:
            return
        self.board.supervise(report.believed)
        if self.board.lost:
            self._video_clients = Listeners()  # or an AR.Drone 1 would send pictures to nobody for ever
        self._look_at_video()
        now_ns = monotonic_ns()
        if self.board.demo or self.board.bootstrap:
            if now_ns < self._demo_due_ns:
                return
            period_ns = nanoseconds(1 / DEMO_HZ)
            self._demo_due_ns = max(self._demo_due_ns + period_ns, now_ns)
        self._send_navdata(report)

    def _send_navdata(self, report: Report) -> None:
        if not self._navdata_clients:
            return
        options = []
        board = self.board
        if not board.bootstrap:
            mask = int(board.configuration.number("general:navdata_options"))
            tags = tags_of(mask, demo=board.demo, version=self._settings.version)
            options = options_of(self._snapshot(report), tags)
        state = board.state(video=self._seen)
        vision = bool(state & navdata.State.VISION)
        for client, sequence in self._navdata_clients.next_sequences():
            self._navdata_port.send(navdata.encode(state, sequence, options, vision), client)

    def _snapshot(self, report: Report) -> Snapshot:
        flight = self.board.flight
        return Snapshot(
            believed=report.believed,
            state=report.believed.state,
            time=self._clock.navdata_time(report.captured_ns),
            thrust=report.truth.thrust,
            most_thrust=self._most_thrust,
            trim_rad=flight.trim_rad,
            progress=flight.progress,
            flipping=flight.flipping(monotonic_ns()),
            video=self._video.status,
            link_quality=round(100 * (1 - self._settings.faults.drop)),
        )

    # Video -----------------------------------------------------------------------------------------------------

    @property
    def _seen(self) -> bool:
        """Whether anybody receives pictures."""
        if self._video_stream is not None:
            return bool(self._video_stream.outlets)
        return bool(self._video_clients)

    def _packer(self) -> Packer:
        if self._settings.version == 1:
            return UvlcPacker()
        return PavePacker(self._clock, self._settings.header_size, self._attitude)

    def _attitude(self) -> tuple[float, float, float]:
        """Theta, phi and psi [rad]."""
        if self._report is None:
            return 0.0, 0.0, 0.0
        believed = self._report.believed
        return -believed.pitch_rad, believed.roll_rad, -believed.yaw_rad

    def _look_at_video(self) -> None:
        """Follow the configuration, on the loop's thread."""
        wanted = self.board.video
        if wanted == self._shown:
            return
        self._shown = wanted
        for camera in self._cameras:
            camera.model = replace(camera.model, fps=wanted.fps)

    def _joined_video(self, outlet: Outlet) -> None:
        if not self._settings.torn_start:
            outlet.skip_to_start()
        elif self._stale:
            outlet.offer(self._stale, starts=True)

    def _asked_for_video(self, _datagram: bytes, sender: Address) -> None:
        self._video_clients.heard(sender)

    def _encoded(self, piece: Piece) -> None:
        """On the encoder's thread."""
        self._loop.post(lambda: self._send_video(piece))

    def _send_video(self, piece: Piece) -> None:
        if self._video_stream is not None:
            self._video_stream.broadcast(piece.data, starts=piece.starts)
            if not piece.starts:
                self._stale = piece.data
        elif self._video_datagrams is not None:
            for client, _ in self._video_clients.next_sequences():
                self._video_datagrams.send(piece.data, client)

    # Called by the host, on its threads ------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """What the drone believes now; what was not looked at yet is overtaken."""
        self._report = report
        if not self._posted:
            self._posted = True
            self._loop.post(self._tick)

    def happened(self, occurrence: Occurrence) -> None:
        """Navdata shows what comes of it."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)

    def wants(self, camera: str) -> bool:
        """Whether a picture of this camera would be sent to anybody."""
        return self._seen and self._video.wants(camera)

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """A picture is due."""
        self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """The simulation or the drawing raised. Without reports no navdata goes out, as from a drone that is dead."""
        _log.error("the simulation of drone %d failed: %r", self._drone, error)
