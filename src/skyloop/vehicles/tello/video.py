"""The drone's video: its cameras, assembling images from datagrams, and a decoder that shows only intact images.

The intrinsics are the calibration of one drone for 960×720 images, published with tello_ros; other drones differ by a
few per cent. Nothing is known about the lens of the downward camera.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from skyloop.clock import Clock, nanoseconds
from skyloop.drivers.live_camera import intrinsics_of
from skyloop.drivers.live_video import Coded, Decoded
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_link import MAX_DATAGRAM
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.messages.frame import H264, LOOKING_FORWARD
from skyloop.platform import wait_readable
from skyloop.pyav import new_decoder, require_pyav
from skyloop.vehicles.tello.link import receiving_socket
from skyloop.vehicles.tello.options import TelloOptions
from skyloop.vehicles.tello.wire import AccessUnit, Assembly

if TYPE_CHECKING:
    import av
    from av.video.codeccontext import VideoCodecContext

# Cameras -------------------------------------------------------------------------------------------------------------

FRONT: Final = "front"
BOTTOM: Final = "bottom"
WIDTH: Final = 960  #: width of the front camera's full-size images [px]
_CALIBRATION: Final = Intrinsics(
    921.170702, 919.018377, 459.904354, 351.238301, distortion=(-0.033458, 0.105152, 0.001256, -0.006647, 0.0)
)
_CAMERAS: Final = (
    CameraInfo(
        FRONT,
        WIDTH,
        720,
        30.0,
        intrinsics=_CALIBRATION,
        rotation=LOOKING_FORWARD,
        position_m=(0.05, 0.0, 0.0),
        stream=H264,
    ),
    CameraInfo(BOTTOM, 320, 240, 30.0, rotation=(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0), stream=H264),
)


def cameras_of(uri: VehicleUri) -> tuple[CameraInfo, ...]:
    """Return both cameras. The drone sends the images of one camera at a time; the downward camera needs SDK 3.0.

    Intrinsics in the address apply to the front camera.
    """
    front, bottom = _CAMERAS
    given = intrinsics_of(uri, front.width, front.height)
    return (msgspec.structs.replace(front, intrinsics=given) if given is not None else front, bottom)


def intrinsics_for(front: CameraInfo, camera: str, width: int) -> Intrinsics | None:
    """Return a camera's intrinsics for another image width, to which the drone can scale images down.

    None for the bottom camera, whose intrinsics are unknown.
    """
    known = front.intrinsics
    if camera != FRONT or known is None:
        return None
    scale = width / front.width
    return msgspec.structs.replace(
        known,
        fx=known.fx * scale,
        fy=known.fy * scale,
        cx=(known.cx + 0.5) * scale - 0.5,
        cy=(known.cy + 0.5) * scale - 0.5,
    )


# Datagrams to access units -------------------------------------------------------------------------------------------

POLL_S: Final = 0.1  #: maximum time that a read blocks
SILENT_S: Final = 3.0  #: time without a datagram after which the port is reopened
BURST: Final = 64  #: maximum number of datagrams per read


class VideoStream:
    """The port for video. Images have no stamps, so the arrival of their first datagram is used as the capture time."""

    def __init__(
        self, options: TelloOptions, addresses: Callable[[], tuple[str, str] | None], connection: int, clock: Clock
    ) -> None:
        known = addresses()
        if known is None:
            raise OSError("the drone's address is not known yet")
        self._drone, local = known
        self._connection = connection
        self._clock = clock
        self._assembly = Assembly()
        self._received_ns = clock()
        self._socket = receiving_socket(options, local, options.video_port)

    @property
    def broken(self) -> int:
        return self._assembly.missing

    @property
    def lost_bytes(self) -> int:
        return self._assembly.stray

    def read(self) -> list[Coded]:
        """Return the images that arrive within :data:`POLL_S`."""
        frames: list[Coded] = []
        if wait_readable(self._socket, POLL_S):
            self._drain(frames)
        if self._clock() - self._received_ns > nanoseconds(SILENT_S):
            raise TimeoutError(f"no video arrived for {SILENT_S:g} s")
        return frames

    def close(self) -> None:
        self._socket.close()

    def _drain(self, frames: list[Coded]) -> None:
        """Read what has arrived up to the end of an image, so that the image is decoded while the next one arrives."""
        for _ in range(BURST):
            try:
                datagram, sender = self._socket.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            if sender[0] != self._drone:
                continue
            now_ns = self._received_ns = self._clock()
            for unit in self._assembly.feed(datagram, now_ns):
                frames.append(Coded(unit, unit.is_key, unit.arrived_ns, now_ns, self._connection))
            if frames:
                return


# Decoder -------------------------------------------------------------------------------------------------------------

MOST_UNITS: Final = 120  #: maximum number of images kept for decoding again; the drone's key frames are 30 images apart
_PURPOSE: Final = "the video of a Tello"


class TelloVideo:
    """Decodes one stream.

    Decoding starts at an intact key frame with a decoder that rejects any damage. If concealment is allowed, a second
    decoder takes over at the first damage and decodes again from that key frame, filling gaps from the previous image.
    After a damaged key frame, or more than ``concealed`` damaged images, nothing is shown until the next intact key
    frame. ``on_whole`` is called on the decoding thread with each undamaged image that depends only on undamaged ones.
    Raises :class:`MissingExtraError` if PyAV is not installed.
    """

    def __init__(self, concealed: int = 0, on_whole: Callable[[Coded], None] = lambda _: None) -> None:
        require_pyav(_PURPOSE)
        self._concealed = concealed
        self._on_whole = on_whole
        self._came: int | None = None  # number of the previous image
        self.waited = 0  #: number of images skipped while waiting for a key frame
        self.damaged = 0  #: number of images with damage
        self._strict: VideoCodecContext | None = None
        self._patching: VideoCodecContext | None = None
        self._units: list[bytes] = []  # access units since the key frame, while there is no damage
        self._damage = 0  # number of damaged images since the key frame
        self._number = 0

    def restart(self) -> None:
        self._strict = self._patching = None

    @property
    def waits(self) -> bool:
        """Whether nothing can be shown until the next intact key frame."""
        return self._strict is None and self._patching is None

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        unit = coded.data
        if not isinstance(unit, AccessUnit):
            raise TypeError("expected an image from a Tello")
        came, self._came = self._came, unit.number
        left_out = came is not None and unit.number != came + 1
        if unit.is_key:
            image = self._decode_key(unit.data)
        elif self.waits:
            self.waited += 1
            return None
        else:
            image = self._decode_next(unit, gap=unit.after_gap or left_out)
        if image is None:
            return None
        if self._strict is not None:
            self._on_whole(coded)
        if not show:
            return None
        self._number += 1
        return Decoded(self._number, np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8))

    def _decode_key(self, data: bytes) -> av.VideoFrame | None:
        fresh = new_decoder("h264", _PURPOSE)
        image = self._decode(fresh, data)
        if image is None:
            self.damaged += 1
            self.restart()
            return None
        self._strict, self._patching, self._units, self._damage = fresh, None, [data], 0
        return image

    def _decode_next(self, unit: AccessUnit, *, gap: bool) -> av.VideoFrame | None:
        if self._strict is not None and len(self._units) < MOST_UNITS and unit.whole and not gap:
            image = self._decode(self._strict, unit.data)
            if image is not None:
                self._units.append(unit.data)
                return image
        noted = self._strict is not None or gap or not unit.whole
        if noted:
            self._note_damage()
        if self._patching is None:
            return None
        image = self._decode(self._patching, unit.data)
        if image is None and not noted:
            self._note_damage()
        return image

    def _note_damage(self) -> None:
        """Conceal from here on, or wait for a key frame if there is too much damage."""
        self.damaged += 1
        self._damage += 1
        if self._damage > self._concealed:
            self._strict = self._patching = None
        elif self._strict is not None:
            self._strict, self._patching = None, new_decoder("h264", _PURPOSE, patch=True)
            for data in self._units:
                self._decode(self._patching, data)
        self._units = []

    def _decode(self, context: VideoCodecContext, data: bytes) -> av.VideoFrame | None:
        """Return the image; None if there is none or the decoder reports damage."""
        import av

        try:
            images = context.decode(av.Packet(data))
        except (av.error.FFmpegError, ValueError):
            return None
        # CABAC may end a damaged image early without an error; FFmpeg then fills in the rest and flags the image.
        concealed = images and images[-1].is_corrupt and context is not self._patching
        return images[-1] if images and not concealed else None
