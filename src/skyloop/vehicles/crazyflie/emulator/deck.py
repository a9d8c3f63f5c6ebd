"""An emulated AI-deck: sends a simulated camera's images over TCP, as either of Bitcraze's streaming programs does.

It serves one client at a time. Faults can be injected, each with a probability per image; the same seed gives the same
faults.
"""

from __future__ import annotations

import random
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.errors import DecodeError, MissingExtraError, UsageError
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.vehicles.crazyflie.wire.cpx import (
    PORT,
    Counting,
    Function,
    Packet,
    PacketParser,
    Target,
    encode,
    restart_camera,
)
from skyloop.vehicles.crazyflie.wire.pictures import DeckState, Format, Picture, newer_packets, older_packets
from skyloop.vehicles.emulation.emulator import Loop, bound
from skyloop.vehicles.emulation.video import OneCamera, Piece, VideoEncoding

#: The camera for images of the older program. The sensor's data sheet gives its size; the lens and its place are
#: estimates.
CAMERA: Final = replace(
    FRONT_CAMERA,
    width=324,
    height=244,
    fps=20.0,
    fx=185.0,
    fy=185.0,
    cx=161.5,
    cy=121.5,
    distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    position_m=(0.02, 0.0, 0.01),
)
#: The camera for images of the newer program, which joins two by two of 324 × 324 pixels.
SMALL_CAMERA: Final = replace(CAMERA, width=162, height=162, fps=60.0, fx=92.5, fy=92.5, cx=80.5, cy=80.5)
_JPEG_QUALITY: Final = 80
_CLOCK_WRAP: Final = 1 << 32  # of the deck's clock [µs]
_READ_BYTES: Final = 1 << 16


@dataclass(frozen=True, slots=True)
class DeckFaults:
    """Faults to inject, as probabilities from 0 to 1 per image."""

    seed: int = 0
    stall: float = 0.0  #: sends nothing more on this connection
    hang: float = 0.0  #: sends nothing more until the camera processor is restarted
    cut: float = 0.0  #: leaves out the end of the image
    close: float = 0.0  #: sends part of a packet and closes the connection
    wrong_length: float = 0.0  #: announces a wrong length of a packet

    def __post_init__(self) -> None:
        for name in ("stall", "hang", "cut", "close", "wrong_length"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name} is {getattr(self, name)!r} and must be a probability between 0 and 1")


@dataclass(frozen=True, slots=True)
class DeckSettings:
    """What an emulated deck sends, and where."""

    stream: str = "grey"  #: ``grey``, ``bayer`` or ``jpeg``, 324 × 244; ``state``, 162 × 162 with the vehicle's state
    bind: str = "127.0.0.1"
    port: int = PORT  #: TCP port; 0 for any free one
    faults: DeckFaults = DeckFaults()

    def __post_init__(self) -> None:
        if self.stream not in STREAMS:
            raise UsageError(f"stream must be one of {', '.join(STREAMS)}, got {self.stream!r}")
        if self.stream == "jpeg":
            require_jpeg()


STREAMS: Final = ("grey", "bayer", "jpeg", "state")


def require_jpeg() -> None:
    """Raise :class:`MissingExtraError` unless OpenCV, which encodes JPEGs, is installed."""
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("the JPEG images of an emulated AI-deck", "vision", cause=str(error)) from error


class DeckPacker:
    """Makes a deck's packets from images. Not thread-safe; only ``state`` may be replaced from any thread."""

    def __init__(self, stream: str, booted_ns: int) -> None:
        self.state: DeckState | None = None  #: the vehicle's state that the deck has heard last
        self._stream = stream
        self._booted_ns = booted_ns
        self._number = 0

    def time_us(self, at_ns: int) -> int:
        """Return the deck's time, which is never 0, for a time on this host's clock [ns]."""
        return ((at_ns - self._booted_ns) // 1000) % _CLOCK_WRAP or 1

    def packets(self, pixels: NDArray[np.uint8], captured_ns: int) -> list[Packet]:
        """Return the packets of an image: BGR, uint8, shape (height, width, 3)."""
        height, width = pixels.shape[:2]
        self._number += 1
        picture = Picture(width, height, Format.RAW, b"", self._number)
        if self._stream == "state":
            stamp_us = self.time_us(captured_ns)
            full = replace(picture, data=to_grey(pixels).tobytes(), stamp_us=stamp_us, state=self.state)
            return newer_packets(full)
        if self._stream == "jpeg":
            import cv2

            quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            data = cv2.imencode(".jpg", to_grey(pixels), quality)[1].tobytes()
            return older_packets(replace(picture, format=Format.JPEG, data=data))
        mosaic = to_grey(pixels) if self._stream == "grey" else to_bayer(pixels)
        return older_packets(replace(picture, data=mosaic.tobytes()))


def to_grey(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the brightness of a BGR image, as ITU-R BT.601 weighs its colours."""
    blue, green, red = (pixels[:, :, n].astype(np.uint32) for n in range(3))
    return ((29 * blue + 150 * green + 77 * red) >> 8).astype(np.uint8)


def to_bayer(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return what a sensor with colour filters sees of a BGR image; its first row begins with red and green."""
    mosaic = pixels[:, :, 1].copy()
    mosaic[0::2, 0::2] = pixels[0::2, 0::2, 2]
    mosaic[1::2, 1::2] = pixels[1::2, 1::2, 0]
    return mosaic


class EmulatedDeck:
    """The deck of an emulated vehicle.

    Assign ``video`` to the :class:`skyloop.vehicles.emulation.emulator.RunningEmulator` and start it, append the deck
    to its open ports, and attach ``camera`` to the host. Use everything else on the loop's thread.
    """

    def __init__(self, loop: Loop, settings: DeckSettings, clock: Callable[[], int] = monotonic_ns) -> None:
        self._loop = loop
        self._settings = settings
        self._clock = clock
        self.camera: CameraModel = SMALL_CAMERA if settings.stream == "state" else CAMERA
        self._counting = Counting.DATA if settings.stream == "state" else Counting.ROUTE_AND_DATA
        self._random = random.Random(settings.faults.seed)
        self._packer = DeckPacker(settings.stream, clock())
        self._parser = PacketParser(self._counting)
        self._client: socket.socket | None = None
        self._unsent = bytearray()
        self._stalled = False  # whether nothing more is sent on this connection
        self._hung = False  # whether nothing more is sent until the camera processor is restarted
        self._resetting = False  # whether the camera processor waits in its bootloader
        self.sent = 0  #: number of images sent, including damaged ones
        self.clients = 0  #: number of connections so far
        self.restarts = 0  #: number of restarts of the camera processor
        self.video = VideoEncoding[OneCamera](self, self._shown, self._encoded)
        self._server = bound(socket.SOCK_STREAM, (settings.bind, settings.port), "AI-deck")
        self._server.listen(1)
        loop.watch(self._server, self._accept)

    @property
    def port(self) -> int:
        """The actual TCP port."""
        return int(self._server.getsockname()[1])

    def hear(self, state: DeckState, at_ns: int) -> None:
        """Take the vehicle's state, which it had at a time of this host's clock [ns]. May be called from any thread."""
        self._packer.state = replace(state, heard_us=self._packer.time_us(at_ns))

    def close(self) -> None:
        self._loop.forget(self._server)
        self._server.close()
        self._drop()

    # On the encoder's thread -------------------------------------------------------------------------------------

    def _shown(self) -> OneCamera:
        return OneCamera(self.camera.name if self._client is not None else "", self.camera.fps, 0)

    def pack(self, picture: NDArray[np.uint8], _settings: OneCamera, captured_ns: int) -> Piece:
        """Return the bytes of an image."""
        return Piece(self._joined(self._packer.packets(picture, captured_ns)), starts=True)

    def _encoded(self, piece: Piece) -> None:
        self._loop.post(lambda: self._send_picture(piece.data))

    def _joined(self, packets: list[Packet]) -> bytes:
        return b"".join(encode(packet, self._counting) for packet in packets)

    # On the loop's thread ----------------------------------------------------------------------------------------

    def _send_picture(self, data: bytes) -> None:
        faults, chance = self._settings.faults, self._random.random
        if self._client is None or self._stalled or self._hung or self._resetting or self._unsent:
            return
        self._stalled = chance() < faults.stall
        self._hung = chance() < faults.hang
        if self._stalled or self._hung:
            return
        self.sent += 1
        if chance() < faults.cut:
            packets = PacketParser(self._counting).feed(data)
            data = self._joined(packets[: self._random.randrange(1, len(packets))])
        if chance() < faults.wrong_length:
            data = bytes([self._random.randrange(256), self._random.randrange(256)]) + data[2:]
        if chance() < faults.close:
            self._send(data[: self._random.randrange(1, len(data))])
            self._drop()
            return
        self._send(data)

    def _send(self, data: bytes) -> None:
        self._unsent += data
        self._write()

    def _write(self) -> None:
        if self._client is None:
            return
        try:
            with suppress(BlockingIOError):
                while self._unsent:
                    del self._unsent[: self._client.send(self._unsent)]
        except OSError:
            self._drop()
            return
        self._loop.watch(self._client, self._receive, self._write if self._unsent else None)

    def _accept(self) -> None:
        self._client, _ = self._server.accept()
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._parser, self._stalled = PacketParser(self._counting), self._resetting
        self._unsent.clear()
        self.clients += 1
        self._loop.forget(self._server)
        self._loop.watch(self._client, self._receive)

    def _receive(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # the older firmware does not notice until it sends
            self._loop.forget(self._client)
            return
        if not data:
            self._drop()
            return
        with suppress(DecodeError):
            for packet in self._parser.feed(data):
                self._obey(packet)

    def _obey(self, packet: Packet) -> None:
        reset, start = restart_camera()
        request = packet.destination, packet.function, packet.data
        if request == (reset.destination, reset.function, reset.data):
            self._resetting, self._hung = True, False
            self._stalled = True  # the program that starts hears only of connections opened afterwards
            answer = Packet(Target.ESP32, Target.HOST, Function.SYSTEM, reset.data)
            self._send(encode(answer, self._counting))
        elif request == (start.destination, start.function, start.data) and self._resetting:
            self._resetting = False
            self.restarts += 1

    def _drop(self) -> None:
        if self._client is None:
            return
        self._loop.forget(self._client)
        self._client.close()
        self._client = None
        with suppress(OSError, ValueError):
            self._loop.watch(self._server, self._accept)
