"""The firmware from the moment it is switched on: the main board, its ports, its video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.sim.firmware.ardrone.board import MainBoard, VideoSettings
from skyloop.sim.firmware.ardrone.cameras import CAMERAS
from skyloop.sim.firmware.ardrone.clock import DroneClock
from skyloop.sim.firmware.ardrone.listeners import Listeners
from skyloop.sim.firmware.ardrone.packers import PavePacker, UvlcPacker
from skyloop.sim.firmware.ardrone.settings import Settings
from skyloop.sim.firmware.ardrone.streams import Outlet, StreamPort
from skyloop.sim.firmware.ardrone.telemetry import Snapshot, options_of, tags_of
from skyloop.sim.firmware.datagrams import Address, DatagramPort
from skyloop.sim.firmware.running import Running
from skyloop.sim.firmware.vehicle import SimulatedVehicle
from skyloop.sim.firmware.video import Packer, Piece, VideoEncoding
from skyloop.sim.host import Report, SimHost
from skyloop.wire.ardrone import navdata
from skyloop.wire.ardrone.ports import Ports

if TYPE_CHECKING:
    from skyloop.sim.studio import Camera

DEMO_HZ: Final = 15.0


class RunningFirmware(Running):
    """The board, the ports and who listens belong to the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: Settings) -> None:
        super().__init__(host, drone, "skyloop-ardrone")
        self._settings = settings
        self._clock = DroneClock(monotonic_ns())
        self._demo_due_ns = 0
        self._stale = b""  # the picture sent last that needs others before it
        self._navdata_clients, self._video_clients = Listeners(), Listeners()
        self._most_thrust = host.simulation.parameters[drone].most_thrust
        vehicle = SimulatedVehicle(host.simulation, drone)
        self.board = MainBoard(vehicle, self._send_text, monotonic_ns, version=settings.version)
        self._shown = self.board.video
        self._video = self._encoding = VideoEncoding(self._packer(), lambda: self._shown, self._encoded)
        self._cameras: tuple[Camera, ...] = ()
        try:
            self._open_ports(settings.ports)
            self._encoding.start()
            self._loop.start()
            self._cameras = host.board(drone, self, self, list(CAMERAS[settings.version]))
        except BaseException:
            self.stop()
            raise

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

    def _tick(self, report: Report) -> None:
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
            video=self._encoding.status,
            channel=self._shown.channel,
            link_quality=round(100 * (1 - self._settings.faults.drop)),
        )

    # Video -----------------------------------------------------------------------------------------------------

    @property
    def _seen(self) -> bool:
        """Whether anybody receives pictures."""
        if self._video_stream is not None:
            return bool(self._video_stream.outlets)
        return bool(self._video_clients)

    def _packer(self) -> Packer[VideoSettings]:
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

    def wants(self, camera: str) -> bool:
        """Whether a picture of this camera would be sent to anybody."""
        return self._seen and super().wants(camera)
