"""A drone's video: a separate thread encodes the newest image and passes it to the port.

PyAV is imported when the first encoder is created.
"""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Final, Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import MissingExtraError, SkyloopError

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

_log = logging.getLogger(__name__)


class VideoSettings(Protocol):
    """The cameras to send."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """The main camera, followed by the camera whose image is inset into the main camera's image, if any."""

    @property
    def inset(self) -> tuple[int, int]:
        """Width and height [px] of the inset image."""


@dataclass(frozen=True, slots=True)
class OneCamera:
    """Video settings that select a single camera."""

    camera: str
    fps: float
    bitrate_kbps: int

    @property
    def cameras(self) -> tuple[str, ...]:
        return (self.camera,)

    @property
    def inset(self) -> tuple[int, int]:
        return 0, 0


S = TypeVar("S", bound=VideoSettings)
S_contra = TypeVar("S_contra", bound=VideoSettings, contravariant=True)


@dataclass(frozen=True, slots=True)
class Piece:
    """The encoded data of one image, including its header."""

    data: bytes
    starts: bool  #: whether a decoder can begin here


@dataclass(frozen=True, slots=True)
class VideoStatus:
    """Counters of the sent video."""

    pictures: int = 0
    bytes_last: int = 0
    bitrate_kbps: int = 0


NOTHING_SENT: Final = VideoStatus()


class Packer(Protocol[S_contra]):
    """Encodes images in order. Not thread-safe."""

    def pack(self, picture: NDArray[np.uint8], settings: S_contra, captured_ns: int, /) -> Piece | None: ...


class VideoEncoding(Generic[S]):
    """Encodes on a separate thread. Of the images that arrive during encoding, only the newest is kept.

    Only that thread uses ``packer`` and calls ``send`` with each encoded image; any thread may call ``settings``.
    """

    def __init__(self, packer: Packer[S], settings: Callable[[], S], send: Callable[[Piece], None]) -> None:
        self._packer = packer
        self._settings = settings
        self._send = send
        self._changed = threading.Condition()
        self._newest: dict[str, tuple[NDArray[np.uint8], int]] = {}
        self._fresh = False
        self._stopping = False
        self._sent_ns = 0
        self._thread = threading.Thread(target=self._run, name="skyloop-firmware-video", daemon=True)
        self.status = NOTHING_SENT

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def wants(self, camera: str) -> bool:
        """Return whether this camera's images should be sent."""
        return camera in self._settings().cameras

    def show(self, camera: str, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Submit an image: BGR, uint8, shape (height, width, 3). The array must not be modified afterwards."""
        shown = self._settings().cameras
        if camera not in shown:
            return
        with self._changed:
            self._newest[camera] = pixels, captured_ns
            if camera == shown[0]:
                self._fresh = True
                self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fresh or self._stopping)
                if self._stopping:
                    return
                self._fresh = False
                newest = dict(self._newest)
            try:
                self._encode(newest)
            except (SkyloopError, ValueError, OSError):
                _log.exception("a picture could not be encoded")

    def _encode(self, newest: dict[str, tuple[NDArray[np.uint8], int]]) -> None:
        settings = self._settings()
        main, *others = settings.cameras
        if main not in newest:
            return
        picture, captured_ns = newest[main]
        if others and others[0] in newest:
            picture = with_inset(picture, newest[others[0]][0], settings.inset)
        piece = self._packer.pack(picture, settings, captured_ns)
        if piece is None:
            return
        size, since_ns = len(piece.data), captured_ns - self._sent_ns
        self._sent_ns = captured_ns
        rate = size * 8 * NS_PER_S // max(since_ns, 1) // 1000
        self.status = VideoStatus(self.status.pictures + 1, size, min(rate, 1_000_000))
        self._send(piece)


def with_inset(picture: NDArray[np.uint8], other: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a copy of an image with another image, scaled down to (width, height), in its upper left corner."""
    width, height = size
    rows = np.arange(height) * other.shape[0] // height
    columns = np.arange(width) * other.shape[1] // width
    made = picture.copy()
    made[:height, :width] = other[rows[:, None], columns]
    return made


GROUP: Final = 15  #: default number of images from one key frame to the next

_SPS, _PPS, _IDR, _SLICE = 7, 8, 5, 1  # types of NAL units
_START_CODE: Final = b"\0\0\0\1"
_ANY_START_CODE: Final = re.compile(rb"\x00{2,3}\x01")
_X264: Final = {"preset": "ultrafast", "tune": "zerolatency"}


@dataclass(frozen=True, slots=True)
class Format:
    """A stream's format, as given in its frame headers."""

    codec: Literal["h264", "mpeg4"]
    width: int
    height: int
    stream_id: int


@dataclass(frozen=True, slots=True)
class Encoded:
    """An encoded image. A key frame begins with parameter sets of these sizes, start codes included."""

    payload: bytes
    key: bool
    sps_size: int = 0
    pps_size: int = 0


class Encoder:
    """Encodes one stream with a key frame every ``group`` images.

    ``buffer_s`` is the size of the rate control's buffer, in seconds of the bitrate; if None, image sizes are
    unlimited. Raises :class:`MissingExtraError` if PyAV is not installed.
    """

    def __init__(
        self,
        form: Format,
        fps: float,
        bitrate_kbps: int,
        *,
        group: int = GROUP,
        profile: str = "Baseline",
        buffer_s: float | None = None,
    ) -> None:
        require_encoder()
        import av

        name: Literal["libx264", "mpeg4"] = "libx264" if form.codec == "h264" else "mpeg4"
        context: VideoCodecContext = av.CodecContext.create(name, "w")
        context.width, context.height, context.pix_fmt = form.width, form.height, "yuv420p"
        context.framerate = Fraction(fps).limit_denominator(1000)
        context.time_base = 1 / context.framerate
        context.bit_rate = bitrate_kbps * 1000
        context.gop_size = group
        context.thread_count = 1
        if name == "libx264":
            keys = f"keyint={group}:min-keyint={group}:scenecut=0"
            if buffer_s is not None:
                keys += f":vbv-maxrate={bitrate_kbps}:vbv-bufsize={round(bitrate_kbps * buffer_s)}"
            context.options = {**_X264, "x264-params": f"{keys}:sliced-threads=0:threads=1:repeat-headers=1"}
            context.profile = profile
        else:
            context.max_b_frames = 0
        self._context = context
        self._form = form
        self._count = 0

    def encode(self, picture: NDArray[np.uint8]) -> Encoded | None:
        """Encode an image: BGR, uint8, shape (height, width, 3), any size; return None if the encoder has no output."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        frame = frame.reformat(self._form.width, self._form.height, "yuv420p")
        frame.pts = self._count
        frame.time_base = self._context.time_base
        self._count += 1
        packets = self._context.encode(frame)
        data = b"".join(bytes(packet) for packet in packets)
        if not data:
            return None
        if self._form.codec == "h264":
            return as_the_drone_does(data)
        return Encoded(data, any(packet.is_keyframe for packet in packets))


def as_the_drone_does(stream: bytes) -> Encoded:
    """Return an access unit in Annex B form with only its parameter sets and slices, each after a 4-byte start code."""
    units = [unit for unit in _ANY_START_CODE.split(stream) if unit]
    kept = [(unit[0] & 31, _START_CODE + unit) for unit in units if unit[0] & 31 in (_SPS, _PPS, _IDR, _SLICE)]
    return Encoded(
        payload=b"".join(unit for _, unit in kept),
        key=any(kind == _IDR for kind, _ in kept),
        sps_size=sum(len(unit) for kind, unit in kept if kind == _SPS),
        pps_size=sum(len(unit) for kind, unit in kept if kind == _PPS),
    )


def require_encoder(what: str = "the video of an emulated AR.Drone 2") -> None:
    """Raise :class:`MissingExtraError`, naming ``what`` as the reason, unless PyAV is installed."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(what, "video", cause=str(error)) from error
