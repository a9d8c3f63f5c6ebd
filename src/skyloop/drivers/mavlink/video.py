"""A camera beside the autopilot: RTSP, video over UDP, or a device of this machine, through PyAV."""

from __future__ import annotations

import socket
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.intrinsics import intrinsics_of
from skyloop.drivers.live_video import Decoder, LiveVideo, Picture, VideoEvent
from skyloop.drivers.mavlink.options import FACINGS, CameraOptions
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import CameraInfo, Value

if TYPE_CHECKING:
    from skyloop.drivers.video.live import ContainerStream

STALLED_S: Final = 1.5  #: a stream that is silent for so long, or for three of its periods, is reopened
OPEN_S: Final = 5.0  #: for the connection, the handshake and the first picture
DEVICE_FORMAT: Final = "v4l2"
#: FFmpeg gathers as little as it can before the first picture: the rate of pictures is not needed.
_LIVE: Final = {"fpsprobesize": "0"}
_WAYS: Final = {
    "rtsp": {**_LIVE, "rtsp_flags": "prefer_tcp", "allowed_media_types": "video"},
    "udp": {**_LIVE, "fifo_size": "100000", "overrun_nonfatal": "1"},
    "http": _LIVE,
    "tcp": _LIVE,
}


def camera_info(uri: VehicleUri, options: CameraOptions) -> CameraInfo:
    """Return the camera as it is announced before the first picture."""
    intrinsics = intrinsics_of(uri, options.width, options.height)
    return CameraInfo(
        options.name,
        options.width,
        options.height,
        options.fps,
        intrinsics=intrinsics,
        rotation=FACINGS[options.facing],
    )


def check_source(uri: VehicleUri, options: CameraOptions) -> None:
    """Check the camera's address.

    Raises:
        UsageError: It is neither a stream's address nor a device.
    """
    scheme, separator, _ = options.source.partition("://")
    if separator and scheme in _WAYS:
        if not _names_host(options.source, needed=scheme != "udp"):
            raise UsageError(f"{uri}: camera names no host: it looks like {scheme}://192.168.1.10:8554/live")
        return
    if not separator and Path(options.source).is_relative_to("/dev"):
        return
    ways = ", ".join(f"{way}://…" for way in _WAYS)
    raise UsageError(f"{uri}: camera is {options.source!r} and must be one of {ways} or a device /dev/video…")


class CameraReceiver:
    """Shows the camera's newest picture from :meth:`start` to :meth:`stop`, and reconnects for ever.

    Args:
        uri: The vehicle's address, with the intrinsics.
        options: Of the camera.
        sink: The proxy's.
    """

    def __init__(self, uri: VehicleUri, options: CameraOptions, sink: Sink) -> None:
        self._options = options
        self._sink = sink
        self._intrinsics = partial(intrinsics_of, uri)
        self._video = LiveVideo(
            without_secrets(options.source),
            connect=self._connect,
            make_decoder=_make_decoder,
            show=self._show,
            on_event=self._publish_event,
            wants=lambda: sink.wants(options.name),
            name="skyloop-camera",
        )

    def start(self) -> None:
        """Start to receive. Returns at once.

        Raises:
            MissingExtraError: PyAV is not installed.
        """
        self._video.start()

    def stop(self) -> None:
        """Stop receiving. Idempotent; takes up to 4 s. The sink is not called after it."""
        self._video.stop()

    @property
    def telemetry(self) -> dict[str, Value]:
        """The counters of :class:`skyloop.drivers.live_video.VideoCounters` under ``camera.``."""
        return self._video.counters.telemetry("camera")

    def _connect(self, number: int) -> ContainerStream:
        from skyloop.drivers.video.live import ContainerStream

        source = self._options.source
        scheme, separator, _ = source.partition("://")
        read_s = max(STALLED_S, 3.0 / self._options.fps)
        if separator:
            if scheme != "udp":
                _look_up(source)
            return ContainerStream(
                source, number, monotonic_ns, options=dict(_WAYS[scheme]), open_s=OPEN_S, read_s=read_s
            )
        if not Path(source).exists():
            raise FileNotFoundError("there is no such device")
        options = {"video_size": f"{self._options.width}x{self._options.height}", "framerate": f"{self._options.fps:g}"}
        return ContainerStream(
            source, number, monotonic_ns, format_name=DEVICE_FORMAT, options=options, open_s=OPEN_S, read_s=read_s
        )

    def _show(self, picture: Picture) -> None:
        picture.show(self._sink, self._options.name, self._intrinsics(picture.width, picture.height))

    def _publish_event(self, event: VideoEvent, text: str) -> None:
        event.publish(self._sink, "camera", text)


def without_secrets(source: str) -> str:
    """Return an address without what may be a secret: user, password and query."""
    if "://" not in source:
        return source
    parts = urlsplit(source)
    return parts._replace(netloc=parts.netloc.rpartition("@")[2], query="", fragment="").geturl()


def _names_host(source: str, *, needed: bool) -> bool:
    try:
        parts = urlsplit(source)
        return parts.port != 0 and (bool(parts.hostname) or not needed)
    except ValueError:
        return False


def _look_up(source: str) -> None:
    """Look up the host's name, as FFmpeg would call an unknown one an error of input or output.

    Raises:
        OSError: The host is not known.
    """
    host = urlsplit(source).hostname
    if host:
        socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)


def _make_decoder() -> Decoder:
    try:
        from skyloop.drivers.video.live import LiveDecoder
    except MissingExtraError as error:
        raise MissingExtraError("a camera beside the autopilot", error.extra, cause=str(error.__cause__)) from error
    return LiveDecoder()
