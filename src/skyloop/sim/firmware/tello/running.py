"""The firmware from the moment it is switched on: its board, its ports, its video."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.sim.firmware.datagrams import Address, DatagramPort
from skyloop.sim.firmware.encoders import Encoder, Format
from skyloop.sim.firmware.running import Running
from skyloop.sim.firmware.tello.board import Board
from skyloop.sim.firmware.tello.settings import BOTTOM, FRONT, LIMITS, Settings
from skyloop.sim.firmware.vehicle import SimulatedVehicle
from skyloop.sim.firmware.video import OneCamera, Piece, VideoEncoding
from skyloop.sim.host import Report, SimHost
from skyloop.wire.ardrone.pave import Codec
from skyloop.wire.tello.video import pieces

if TYPE_CHECKING:
    from skyloop.sim.studio import Camera

STATE_HZ: Final = 10.0
GROUP: Final = 30  #: pictures from one key to the next
FULL_KBPS: Final = 2500  #: pictures of 10 kB
LEAST_KBPS: Final = 300
BUFFER_S: Final = 0.1


def automatic_kbps(loss: float) -> int:
    """The bitrate for this share of lost datagrams. An estimate: that a Tello adapts is known, and not how."""
    return max(LEAST_KBPS, round(FULL_KBPS * (1 - 9 * loss)))


class TelloPacker:
    """Pictures to H.264 as a Tello sends it."""

    def __init__(self) -> None:
        self._made: tuple[tuple[int, int, float, int], Encoder] | None = None
        self.size = (FRONT.width, FRONT.height)

    def pack(self, picture: NDArray[np.uint8], settings: OneCamera, _captured_ns: int) -> Piece | None:
        width, height = self.size
        wanted = width, height, settings.fps, settings.bitrate_kbps
        if self._made is None or self._made[0] != wanted:
            form = Format(Codec.MPEG4_AVC, width, height, 0)
            encoder = Encoder(form, settings.fps, settings.bitrate_kbps, group=GROUP, profile="Main", buffer_s=BUFFER_S)
            self._made = wanted, encoder
        encoded = self._made[1].encode(picture)
        return None if encoded is None else Piece(encoded.payload, encoded.key)


class RunningFirmware(Running):
    """The board and the ports belong to the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: Settings) -> None:
        super().__init__(host, drone, "skyloop-tello")
        self._settings = settings
        self._state_due_ns = 0
        vehicle = SimulatedVehicle(host.simulation, drone)
        vehicle.set_limits(LIMITS)
        self.board = Board(
            vehicle,
            self._answer,
            monotonic_ns,
            sdk=settings.sdk,
            pads=settings.pads,
            link_quality=round(100 * (1 - settings.faults.drop)),
        )
        simulation = host.simulation
        self.board.supervise(Report(simulation.feedback(drone), simulation.truth(drone), (), monotonic_ns()))
        self._packer = TelloPacker()
        self._shown = self._wanted_video()
        self._video = VideoEncoding(self._packer, lambda: self._shown, self._encoded)
        self._cameras: tuple[Camera, ...] = ()
        try:
            self._commands = self._datagrams("command", settings.port)
            self._video_port = self._datagrams("video", 0)
            self._video.start()
            self._loop.start()
            self._cameras = host.board(drone, self, self, [FRONT, BOTTOM])
        except BaseException:
            self.stop()
            raise

    @property
    def port(self) -> int:
        return self._commands.port

    def _datagrams(self, name: str, port: int) -> DatagramPort:
        settings = self._settings
        heard = self._heard if name == "command" else lambda _datagram, _sender: None
        opened = DatagramPort(
            self._loop, (settings.bind, port), heard, name=name, faults=settings.faults, delay_s=settings.delay_s
        )
        self._open.append(opened)
        return opened

    # On the loop's thread ----------------------------------------------------------------------------------------

    def _heard(self, datagram: bytes, sender: Address) -> None:
        self.board.receive(datagram, sender)
        self._look_at_video()

    def _answer(self, text: str, to: Address) -> None:
        self._commands.send(text.encode("ascii"), to)

    def _tick(self, report: Report) -> None:
        self.board.supervise(report)
        now_ns = monotonic_ns()
        state, client = self.board.state_string(), self.board.client
        if state is None or client is None or now_ns < self._state_due_ns:
            return
        self._state_due_ns = max(self._state_due_ns + nanoseconds(1 / STATE_HZ), now_ns)
        self._commands.send(state, (client, self.board.state_port))

    def _wanted_video(self) -> OneCamera:
        board = self.board
        kbps = board.bitrate_mbps * 1000 or automatic_kbps(self._settings.faults.drop)
        return OneCamera("bottom" if board.looks_down else "front", board.fps, kbps)

    def _look_at_video(self) -> None:
        """Follow what was configured."""
        board, wanted = self.board, self._wanted_video()
        self._packer.size = (BOTTOM.width, BOTTOM.height) if board.looks_down else board.size
        if wanted == self._shown:
            return
        self._shown = wanted
        for camera in self._cameras:
            camera.model = replace(camera.model, fps=wanted.fps)

    def _encoded(self, piece: Piece) -> None:
        """On the encoder's thread."""
        self._loop.post(lambda: self._send_video(piece))

    def _send_video(self, piece: Piece) -> None:
        board = self.board
        if board.client is None or not board.streaming:
            return
        for datagram in pieces(piece.data):
            self._video_port.send(datagram, (board.client, board.video_port))

    # Called by the host, on its threads --------------------------------------------------------------------------

    def wants(self, camera: str) -> bool:
        """Whether a picture of this camera would be sent to anybody."""
        return self.board.streaming and self.board.client is not None and super().wants(camera)
