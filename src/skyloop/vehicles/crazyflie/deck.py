"""The AI-deck's camera over Wi-Fi: its options in a vehicle's address, its connection, and its images.

The deck stops sending after seconds in many users' reports, with its connection still open. A silent connection is
therefore ended and opened again, with growing pauses, and the application gets an event. As the deck serves one
connection at a time and does not notice a reset one while it sends nothing, every connection is ended in order.
"""

from __future__ import annotations

import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.address import is_host
from skyloop.clock import Clock, LiveClock, monotonic_ns, nanoseconds
from skyloop.drivers.base import Sink
from skyloop.drivers.live_camera import INTRINSICS_OPTIONS, check_intrinsics, intrinsics_of
from skyloop.drivers.live_video import Coded, Decoded, LiveFrame, LiveVideo, VideoEvent
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.errors import DecodeError, MissingExtraError, UnsupportedError, UsageError
from skyloop.messages import CameraInfo, Encoding, EventKind, Severity, Value
from skyloop.messages.frame import LOOKING_FORWARD, image_size, why_not_decoded
from skyloop.platform import wait_readable
from skyloop.vehicles.crazyflie.wire.cpx import PORT, PacketParser, encode, restart_camera
from skyloop.vehicles.crazyflie.wire.pictures import VERSION, DeckState, Format, Picture, PictureAssembly

# Options -------------------------------------------------------------------------------------------------------------

CAMERA: Final = "front"
SIZES: Final = {"324x244": (324, 244), "324x324": (324, 324), "162x162": (162, 162), "162x122": (162, 122)}
_FPS: Final = {"162x162": 60.0}  # nominal rates; others depend on the Wi-Fi
_USUAL_FPS: Final = 15.0
_OWN_OPTIONS: Final = frozenset({"deck", "deck_size", "deck_colour", "deck_restart"})
DECK_OPTIONS: Final = _OWN_OPTIONS | INTRINSICS_OPTIONS  #: names of the options that concern the deck


@dataclass(frozen=True, slots=True)
class DeckOptions:
    """The part of a vehicle's address that concerns the deck."""

    uri: VehicleUri  #: the whole address, for the intrinsics
    host: str
    port: int = PORT
    size: tuple[int, int] = (324, 244)  #: announced width and height [px]
    fps: float = _USUAL_FPS  #: announced rate
    colour: bool = False  #: whether images are a Bayer mosaic to convert to colour
    restarts: bool = False  #: whether to restart the camera processor if reconnecting does not help

    @property
    def place(self) -> str:
        """The address, for display."""
        return f"{self.host}:{self.port}"

    @property
    def camera(self) -> CameraInfo:
        """The camera as announced before the first frame."""
        width, height = self.size
        encoding = Encoding.BGR8 if self.colour else Encoding.MONO8
        lens = intrinsics_of(self.uri, width, height)
        return CameraInfo(CAMERA, width, height, self.fps, encoding, lens, rotation=LOOKING_FORWARD)


def deck_options(uri: VehicleUri) -> DeckOptions | None:
    """Parse the options that concern the deck; return None if the address names no deck.

    Raises :class:`UsageError` for invalid values, and for options of the camera without ``deck=``.
    """
    given = uri.options.get("deck")
    if given is None:
        for option in sorted(DECK_OPTIONS & uri.options.keys()):
            raise UsageError(f"{uri}: option {option} also needs deck, the address of the AI-deck")
        return None
    split = host_and_port(given)
    if split is None and not is_host(given):
        raise UsageError(f"{uri}: deck is {given!r} and must be HOST or HOST:PORT, such as 192.168.4.1")
    size = uri.options.get("deck_size", "324x244")
    if size not in SIZES:
        raise UsageError(f"{uri}: deck_size is {size!r} and must be one of {', '.join(SIZES)}")
    check_intrinsics(uri)
    host, port = split or (given, PORT)
    return DeckOptions(
        uri,
        host,
        port,
        SIZES[size],
        _FPS.get(size, _USUAL_FPS),
        uri.flag("deck_colour", default=False),
        uri.flag("deck_restart", default=False),
    )


# Connection ----------------------------------------------------------------------------------------------------------

POLL_S: Final = 0.1  #: maximum time that a read blocks
CONNECT_S: Final = 2.0  #: time limit for establishing a connection
SILENT_S: Final = 1.5  #: time without a byte after which a connection has stalled
PICTURELESS_S: Final = 4.0  #: time without a whole image after which a connection has stalled
FUTILE: Final = 3  #: number of connections in a row without an image after which only a restart is likely to help
_END_S: Final = 0.3  # how long closing waits for the deck to end the connection too
_READ_BYTES: Final = 1 << 16
_WRAP: Final = 1 << 32  # the deck's clock wraps around at this value [µs]


class DeckStream:
    """One connection to the deck.

    Images from the older firmware have no stamps, so that the arrival of their first packet is used as the capture
    time.
    """

    def __init__(self, connected: socket.socket, connection: int, clock: Clock) -> None:
        self._socket = connected
        self._connection = connection
        self._clock = clock
        self._parser = PacketParser()
        self._assembly = PictureAssembly()
        self._stamps = DeckStamps()
        self._begun_ns = self._heard_ns = self._picture_ns = clock()
        self._socket.setblocking(False)

    @property
    def broken(self) -> int:
        return self._assembly.broken

    @property
    def lost_bytes(self) -> int:
        return self._assembly.stray

    def read(self) -> list[Coded]:
        """Return the images that arrive within :data:`POLL_S`.

        Raises ``TimeoutError`` if none arrives for too long, and ``ConnectionError`` if the connection ends or its
        bytes make no sense.
        """
        frames: list[Coded] = []
        if wait_readable(self._socket, POLL_S):
            self._receive(frames)
        now_ns = self._clock()
        if now_ns - self._heard_ns > nanoseconds(SILENT_S):
            raise TimeoutError(f"the deck has sent nothing for {SILENT_S:g} s")
        if now_ns - self._picture_ns > nanoseconds(PICTURELESS_S):
            raise TimeoutError(f"no whole image has arrived for {PICTURELESS_S:g} s")
        return frames

    def close(self) -> None:
        """End the connection in order: closing it with unread bytes would reset it."""
        until_s = time.monotonic() + _END_S
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            while (left_s := until_s - time.monotonic()) > 0 and wait_readable(self._socket, left_s):
                if not self._socket.recv(_READ_BYTES):
                    break
        self._socket.close()

    def _receive(self, frames: list[Coded]) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            raise ConnectionError("the deck closed the connection")
        now_ns = self._heard_ns = self._clock()
        try:
            packets = self._parser.feed(data)
        except DecodeError as error:
            raise ConnectionError(str(error)) from error
        for packet in packets:
            begun = self._assembly.begun
            picture = self._assembly.feed(packet)
            if self._assembly.begun > begun:
                self._begun_ns = now_ns
            if picture is not None:
                self._picture_ns = now_ns
                captured_ns = self._begun_ns
                if picture.stamp_us is not None:
                    captured_ns = self._stamps.captured_ns(picture.stamp_us, self._begun_ns)
                frames.append(Coded(picture, True, captured_ns, now_ns, self._connection))


class DeckStamps:
    """Determines the capture times of one connection's images from their stamps, which wrap around after 71 minutes."""

    def __init__(self) -> None:
        self._clock = LiveClock()
        self._stamp_us = 0  # the previous image's stamp as sent
        self._time_us = 0  # the same stamp, without wrap-around

    def captured_ns(self, stamp_us: int, arrived_ns: int) -> int:
        """Return the time for a stamp on the deck's clock; it is never later than the arrival."""
        self._time_us += since_us(stamp_us, self._stamp_us)
        self._stamp_us = stamp_us
        return self._clock.captured_ns(self._time_us / 1e6, arrived_ns)


def since_us(stamp_us: int, earlier_us: int) -> int:
    """Return the time between two stamps of the deck's clock; negative if the first is the earlier one."""
    return (stamp_us - earlier_us + _WRAP // 2) % _WRAP - _WRAP // 2


# Images --------------------------------------------------------------------------------------------------------------


class DeckDecoder:
    """Decodes images to grey, shape (height, width), or to BGR, shape (height, width, 3), if they are Bayer mosaics."""

    waited = 0  #: always 0: no image depends on another

    def __init__(self, *, colour: bool = False) -> None:
        self.damaged = 0  #: number of JPEGs that could not be decoded
        self._colour = colour
        self._number = 0

    def restart(self) -> None:
        self._number = 0

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        picture = coded.data
        if not isinstance(picture, Picture):
            raise TypeError("expected an image from an AI-deck")
        if picture.version != VERSION:
            raise UnsupportedError(
                f"the deck's messages have version {picture.version}, and only version {VERSION} is supported"
            )
        if picture.format not in list(Format):
            raise UnsupportedError(f"the deck's images have the unknown format {picture.format}")
        if not show:
            return None
        if picture.format == Format.RAW:
            grey = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.width)
        else:
            decoded = _from_jpeg(picture)
            if decoded is None:
                self.damaged += 1
                return None
            grey = decoded
        self._number += (picture.number - self._number) % 256 or 256
        return Decoded(self._number & 0xFFFFFFFF, _from_bayer(grey) if self._colour else grey)


def _from_jpeg(picture: Picture) -> NDArray[np.uint8] | None:
    """Return the grey image in a JPEG; None if it is damaged or has another size than announced."""
    try:
        cv2 = opencv("JPEG images from an AI-deck")
    except MissingExtraError as error:
        raise UnsupportedError(str(error)) from error
    if image_size(picture.data) != (picture.width, picture.height) or why_not_decoded(picture.data):
        return None
    image = None
    with suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape != (picture.height, picture.width):
        return None
    return np.ascontiguousarray(image, np.uint8)


def _from_bayer(mosaic: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours of a mosaic with red in its first pixel, as the deck's colour sensor has it."""
    cv2 = opencv("colour from an AI-deck")
    return np.ascontiguousarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerBG2BGR), np.uint8)


def opencv(purpose: str) -> Any:
    """Import OpenCV; raise :class:`MissingExtraError`, naming the purpose, if it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(purpose, "vision", cause=str(error)) from error
    return cv2


# All together --------------------------------------------------------------------------------------------------------

_WHERE: Final = "deck"  # source of the deck's events
_REMEDY: Final = "if reconnecting does not help, add deck_restart=1 to the address, or switch the vehicle off and on"


class DeckVideo:
    """Publishes the deck's newest images from :meth:`open` to :meth:`close`, and keeps reconnecting."""

    def __init__(self, options: DeckOptions, clock: Clock = monotonic_ns) -> None:
        """Store the arguments. No I/O."""
        self.options = options
        self._clock = clock
        self._video: LiveVideo | None = None
        self._reached = False  # whether the latest attempt to connect has succeeded
        self._futile = 0  # number of connections in a row without an image, including the current one
        self._stalls = self._restarts = 0
        self._state: tuple[DeckState, int] | None = None  # the newest state, and when it was that of the vehicle

    def open(self, sink: Sink) -> None:
        """Start receiving. Returns at once. Raises :class:`MissingExtraError` if colour is wanted without OpenCV."""
        options = self.options
        if options.colour:
            opencv("colour from an AI-deck")
        self._futile = self._stalls = self._restarts = 0
        self._state = None

        def show(frame: LiveFrame) -> None:
            sink.frame(
                CAMERA,
                frame.pixels,
                frame.captured_ns,
                width=frame.width,
                height=frame.height,
                encoding=Encoding.MONO8 if frame.pixels.ndim == 2 else Encoding.BGR8,
                intrinsics=intrinsics_of(options.uri, frame.width, frame.height),
            )

        self._video = LiveVideo(
            options.place,
            connect=lambda number: self._connect(sink, number),
            make_decoder=lambda: DeckDecoder(colour=options.colour),
            show=show,
            on_event=lambda event, text: self._publish_event(sink, event, text),
            wants=lambda: sink.wants(CAMERA),
            came=self._came,
            clock=self._clock,
            name="crazyflie-deck",
        )
        self._video.start()

    def close(self) -> None:
        """Stop receiving. Idempotent; takes up to 4 s. The sink is not called afterwards."""
        if self._video is not None:
            self._video.stop()
            self._video = None

    def telemetry(self) -> dict[str, Value]:
        """Return counters of the video, and the vehicle's state as sent beside the newest image, if any."""
        if self._video is None:
            return {}
        values: dict[str, Value] = self._video.counters.telemetry(_WHERE)
        values |= {f"{_WHERE}.stalls": self._stalls, f"{_WHERE}.restarts": self._restarts}
        if self._state is not None:
            state, at_ns = self._state
            vectors = {"position_m": state.position_m, "velocity_m_s": state.velocity_m_s}
            for name, vector in vectors.items():
                for axis, value in zip("xyz", vector or (), strict=False):
                    values[f"{_WHERE}.{name}.{axis}"] = value
            values[f"{_WHERE}.state_age_s"] = max(0.0, (self._clock() - at_ns) / 1e9)
        return values

    @property
    def state(self) -> tuple[DeckState, int] | None:
        """The vehicle's state beside the newest image, and when it held on this host's clock [ns]; None if unknown."""
        return self._state

    # On the reading thread ---------------------------------------------------------------------------------------

    def _connect(self, sink: Sink, number: int) -> DeckStream:
        self._reached = False
        connected = socket.create_connection((self.options.host, self.options.port), CONNECT_S)
        self._reached = True
        stream = DeckStream(connected, number, self._clock)
        self._futile += 1
        if self.options.restarts and self._futile > FUTILE:
            self._futile = 0
            try:
                connected.sendall(b"".join(encode(packet) for packet in restart_camera()))
            finally:
                stream.close()
            self._report_restart(sink)
        return stream

    def _report_restart(self, sink: Sink) -> None:
        """Report a restart, and make the caller connect again: the new program hears only of later connections."""
        self._restarts += 1
        text = f"deck: reconnecting to {self.options.place} brought no images, so its camera processor is restarted"
        sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, where=_WHERE, reason="deck_restarted")
        raise ConnectionError("its camera processor is restarting")

    def _came(self, coded: Coded) -> None:
        self._futile = 0
        picture = coded.data
        assert isinstance(picture, Picture)
        if picture.state is not None and picture.stamp_us is not None:
            at_ns = coded.captured_ns - 1000 * since_us(picture.stamp_us, picture.state.heard_us)
            self._state = picture.state, at_ns

    # On either thread --------------------------------------------------------------------------------------------

    def _publish_event(self, sink: Sink, event: VideoEvent, text: str) -> None:
        if event is not VideoEvent.LOST:
            event.publish(sink, _WHERE, text)
            return
        self._stalls += self._reached
        remedy = f" ({_REMEDY})" if self._reached and not self.options.restarts else ""
        sink.event(
            EventKind.VEHICLE_MESSAGE,
            f"deck: no images from {text}; trying again{remedy}",
            Severity.WARNING,
            where=_WHERE,
            reason="deck_lost" if self._reached else "deck_unreachable",
        )
