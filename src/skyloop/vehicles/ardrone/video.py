"""The drone's video port: streams, frames and their times, decoders, and cameras.

An AR.Drone 2 sends PaVE over TCP. An AR.Drone 1 sends each image as one UDP datagram, as long as a client keeps
requesting them. The stamps in PaVE headers are the drone's own time in 32-bit milliseconds (``video_encapsulation.h``
in the AR.Drone SDK 2.0.1). No source specifies which moment the stamps refer to; the driver assumes the time of
capture. The intrinsics for the AR.Drone 2 are those of a single drone, published with ardrone_autonomy (TUM's branch)
for 640×360 images; other drones differ by a few per cent. No intrinsics are known for the AR.Drone 1.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import partial
from typing import Final

import msgspec
import numpy as np

from skyloop.clock import Clock, LiveClock, monotonic_ns, nanoseconds
from skyloop.drivers.base import Sink
from skyloop.drivers.h264 import Unit
from skyloop.drivers.live_camera import intrinsics_of
from skyloop.drivers.live_video import Coded, Decoded, Decoder, LiveFrame, LiveVideo, Stream, StreamRelay, VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DecodeError, MissingExtraError, UnsupportedError, UsageError
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.messages.frame import H264, LOOKING_DOWN, LOOKING_FORWARD
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, PaveFrame, PaveParser
from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder, UvlcPicture, is_intra, is_p264

# Cameras -------------------------------------------------------------------------------------------------------------

_FRONT: Final = Intrinsics(
    561.999146, 561.782697, 307.433982, 190.144373, distortion=(-0.50758, 0.24911, 0.000579, 0.000996, 0.0)
)
_BOTTOM: Final = Intrinsics(686.994766, 688.195055, 329.323208, 159.323007)
_CAMERAS: Final = {
    1: (
        CameraInfo("front", 320, 240, 15.0, rotation=LOOKING_FORWARD),
        CameraInfo("bottom", 176, 144, 60.0, rotation=LOOKING_DOWN),
    ),
    2: (
        CameraInfo("front", 640, 360, 30.0, intrinsics=_FRONT, rotation=LOOKING_FORWARD, stream=H264),
        CameraInfo("bottom", 640, 360, 30.0, intrinsics=_BOTTOM, rotation=LOOKING_DOWN, stream=H264),
    ),
}


def cameras_of(uri: VehicleUri, version: int | None) -> tuple[CameraInfo, ...]:
    """Return both cameras; the drone sends one at a time. Intrinsics in the address apply to the front camera."""
    front, bottom = _CAMERAS[version or 2]
    given = intrinsics_of(uri, front.width, front.height)
    return (msgspec.structs.replace(front, intrinsics=given) if given is not None else front, bottom)


# Capture times -------------------------------------------------------------------------------------------------------

_WRAP: Final = 1 << 32  #: stamps wrap around at this value [ms]


class DroneStamps:
    """Determines the capture times of one connection's frames.

    Follows the drift of the drone's clock and the wrap-around of its stamps. Stamps that go back, as after a restart of
    the drone, reset the estimate.
    """

    def __init__(self) -> None:
        self._clock = LiveClock()
        self._stamp_ms = 0  # the previous frame's stamp as sent
        self._time_ms = 0  # the same stamp, without wrap-around

    def captured_ns(self, stamp_ms: int, arrived_ns: int) -> int:
        """Return the capture time for a stamp in a PaVE header; it is never later than the arrival."""
        step_ms = (stamp_ms - self._stamp_ms + _WRAP // 2) % _WRAP - _WRAP // 2
        self._stamp_ms = stamp_ms
        self._time_ms += step_ms
        return self._clock.captured_ns(self._time_ms / 1000.0, arrived_ns)


# Streams -------------------------------------------------------------------------------------------------------------


class PaveAssembly:
    """Assembles the frames of one connection.

    The first frame may be seconds old (seen in a capture from a real drone). It is therefore held back until the second
    one arrives, and returned only if their numbers are consecutive.
    """

    def __init__(self, connection: int) -> None:
        self._connection = connection
        self._parser = PaveParser()
        self._stamps = DroneStamps()
        self._stale = 0
        self._first: tuple[int, Coded] | None = None  # the first frame with its number, until the second frame arrives
        self._greeted = False

    @property
    def broken(self) -> int:
        """Number of incomplete or stale frames."""
        return self._parser.broken_frames + self._stale

    @property
    def lost_bytes(self) -> int:
        """Number of bytes that did not belong to a complete frame."""
        return self._parser.skipped_bytes

    def feed(self, data: bytes, now_ns: int) -> list[Coded]:
        """Return the frames that these bytes complete. Never raises, regardless of content."""
        return [coded for frame in self._parser.feed(data) for coded in self._greet(frame, self._coded(frame, now_ns))]

    def end(self) -> None:
        """Handle the end of the connection."""
        self._parser.end()
        self._stale += self._first is not None

    def _coded(self, frame: PaveFrame, now_ns: int) -> Coded:
        captured_ns = self._stamps.captured_ns(frame.timestamp_ms, now_ns)
        return Coded(frame, frame.is_key, captured_ns, now_ns, self._connection)

    def _greet(self, frame: PaveFrame, coded: Coded) -> list[Coded]:
        if self._greeted:
            return [coded]
        if self._first is None:
            self._first = frame.number, coded
            return []
        (number, first), self._first = self._first, None
        self._greeted = True
        if frame.number == number + 1 & 0xFFFFFFFF:
            return [first, coded]
        self._stale += 1
        return [coded]


CONNECT_S: Final = 1.0  #: connection timeout
POLL_S: Final = 0.1  #: maximum time that a read blocks
SILENT_S: Final = 3.0  #: time without a complete frame after which the connection is closed
KEEP_ALIVE_S: Final = 0.5  #: time between requests to an AR.Drone 1
WAKE: Final = b"\x01\x00\x00\x00"  #: request to an AR.Drone 1: any small datagram starts the video and keeps it running
_CHUNK: Final = 1 << 16  #: maximum number of bytes per read, and more than any datagram has


class PaveStream(PaveAssembly):
    """A connection to an AR.Drone 2: PaVE over TCP."""

    def __init__(self, host: str, port: int, connection: int, clock: Clock) -> None:
        super().__init__(connection)
        self._clock = clock
        self._received_ns = clock()
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.settimeout(POLL_S)

    def read(self) -> list[Coded]:
        """Return the frames that arrive within :data:`POLL_S`."""
        try:
            data = self._socket.recv(_CHUNK)
        except TimeoutError:
            frames = []
        else:
            if not data:
                self.end()
                raise ConnectionError("the drone ended the stream")
            frames = self.feed(data, self._clock())
        self._received_ns = self._clock() if frames else self._received_ns
        _give_up_if_silent(self._clock() - self._received_ns)
        return frames

    def close(self) -> None:
        self._socket.close()


class DatagramStream:
    """The video of an AR.Drone 1: one image per UDP datagram, as long as the client keeps requesting them."""

    def __init__(self, host: str, port: int, connection: int, clock: Clock) -> None:
        self.broken = 0
        self.lost_bytes = 0
        self._connection = connection
        self._clock = clock
        self._received_ns = clock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.settimeout(POLL_S)
            self._socket.connect((host, port))  # drops datagrams from other senders
            self._socket.send(WAKE)
        except OSError:
            self._socket.close()
            raise
        self._woken_ns = self._received_ns

    def read(self) -> list[Coded]:
        """Return the image that arrives within :data:`POLL_S`.

        Images have no stamps, so the time of arrival is used as the capture time.
        """
        try:
            data = self._socket.recv(_CHUNK)
        except TimeoutError:
            data = b""
        now_ns = self._clock()
        if now_ns - self._woken_ns > nanoseconds(KEEP_ALIVE_S):
            self._woken_ns = now_ns
            self._socket.send(WAKE)
        if data:
            self._received_ns = now_ns
            return [Coded(data, is_intra(data), now_ns, now_ns, self._connection)]
        _give_up_if_silent(now_ns - self._received_ns)
        return []

    def close(self) -> None:
        self._socket.close()


def open_stream(version: int, host: str, port: int, connection: int, clock: Clock) -> Stream:
    """Connect to the drone's video. The absence of an AR.Drone 1 is detected only when reading."""
    return (PaveStream if version == 2 else DatagramStream)(host, port, connection, clock)


def _give_up_if_silent(silent_ns: int) -> None:
    if silent_ns > nanoseconds(SILENT_S):
        raise TimeoutError(f"no frame arrived for {SILENT_S:g} s")


# Decoders ------------------------------------------------------------------------------------------------------------

REORDERED: Final = 64  #: maximum step back in the numbers of late images; a larger step means a restart
OLD_RUN: Final = 4  #: this many consecutive images older than the newest one also mean a restart
_DECODED: Final = (Codec.MPEG4_VISUAL, Codec.MPEG4_AVC)


class PaveVideo:
    """Decodes an AR.Drone 2's video."""

    def __init__(self) -> None:
        try:
            from skyloop.vehicles.ardrone.pave_decoder import PaveDecoder
        except MissingExtraError as error:
            raise MissingExtraError("the video of an AR.Drone 2", error.extra, cause=str(error.__cause__)) from error
        self._decoder = PaveDecoder()

    @property
    def waited(self) -> int:
        return self._decoder.waited

    @property
    def damaged(self) -> int:
        return self._decoder.damaged

    def restart(self) -> None:
        self._decoder.restart()

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        """See :class:`skyloop.drivers.live_video.Decoder`. Decodes MPEG-4 and H.264."""
        frame = coded.data
        if not isinstance(frame, PaveFrame):
            raise TypeError("expected a frame from an AR.Drone 2")
        if frame.codec not in _DECODED:
            raise UnsupportedError(
                f"the drone sends video in codec {_codec_name(frame.codec)}, which is not supported: "
                "set video:video_codec to H.264 (129)"
            )
        image = self._decoder.decode(frame)
        if image is None or not show:
            return None
        return Decoded(frame.number, np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8))


class UvlcVideo:
    """Decodes an AR.Drone 1's video and drops images that arrive after a newer one."""

    def __init__(self) -> None:
        self.waited = 0
        self.damaged = 0
        self._decoder = UvlcDecoder()
        self._number: int | None = None  # number of the newest image
        self._old_run = 0

    def restart(self) -> None:
        """Discard all state from the stream so far."""
        self._decoder = UvlcDecoder()
        self._number = None

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        """See :class:`skyloop.drivers.live_video.Decoder`. Decodes UVLC, not P264."""
        packet = coded.data
        if not isinstance(packet, bytes):
            raise TypeError("expected a datagram from an AR.Drone 1")
        if is_p264(packet):
            raise UnsupportedError(
                "the drone sends video in P264, which is not supported: set video:video_codec to UVLC (32)"
            )
        try:
            picture = self._decoder.decode(packet)
        except DecodeError:
            self.damaged += 1
            return None
        self._old_run = self._old_run + 1 if self._is_old(picture) else 0
        if 0 < self._old_run < OLD_RUN:
            self.waited += 1
            return None
        self._number = picture.number
        return Decoded(picture.number, picture.pixels) if show else None

    def _is_old(self, picture: UvlcPicture) -> bool:
        """Return whether an image is older than, or the same as, the newest one."""
        return self._number is not None and 0 <= (self._number - picture.number) % (1 << 32) < REORDERED


def make_decoder(version: int) -> Decoder:
    """Return the decoder for a version of the drone; raise an error if its library is not installed."""
    return PaveVideo() if version == 2 else UvlcVideo()


def _codec_name(codec: int) -> str:
    try:
        return Codec(codec).name
    except ValueError:
        return str(codec)


# Encoded images for recorders ----------------------------------------------------------------------------------------


class EncodedStream:
    """Relays H.264 while a recorder subscribes; see :class:`StreamRelay`. Used by the reading thread.

    Frames arrive complete over TCP, so they need not be decoded to check for missing data.
    """

    def __init__(
        self, sink: Sink, camera: Callable[[], str], intrinsics: Callable[[int, int], Intrinsics | None]
    ) -> None:
        self._camera = camera
        self._relay = StreamRelay(sink, lambda _camera, width, height: intrinsics(width, height))

    def take(self, coded: Coded) -> None:
        """Relay a complete frame if it is H.264, was requested, and can be decoded after the last relayed frame."""
        frame = coded.data
        if not isinstance(frame, PaveFrame) or frame.codec != Codec.MPEG4_AVC:
            self._relay.restart()
            return
        self._relay.take(
            self._camera(),
            Unit(frame.payload, frame.is_key, frame.after_damage, frame.width, frame.height),
            coded.captured_ns,
            number=frame.number,
            connection=coded.connection,
            picture=frame.type != FrameType.HEADERS,
        )


# The receiver --------------------------------------------------------------------------------------------------------


class VideoReceiver(LiveVideo):
    """Receives an AR.Drone's live video; for the callbacks see :class:`skyloop.drivers.live_video.LiveVideo`."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        version: int,
        show: Callable[[LiveFrame], None],
        on_event: Callable[[VideoEvent, str], None],
        wants: Callable[[], bool] = lambda: True,
        came: Callable[[Coded], None] | None = None,
        clock: Clock = monotonic_ns,
    ) -> None:
        if version not in (1, 2):
            raise UsageError(f"the AR.Drone's version must be 1 or 2, got {version}")

        super().__init__(
            f"{host}:{port}",
            connect=lambda connection: open_stream(version, host, port, connection, clock),
            make_decoder=partial(make_decoder, version),
            show=show,
            on_event=on_event,
            wants=wants,
            came=came,
            clock=clock,
            name="ardrone-video",
        )
