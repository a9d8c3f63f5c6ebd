"""Read a network camera or a camera device of this machine: its options in a vehicle's address, and its live video.

The video source is the address of a stream or the path of a device, opened by FFmpeg. The intrinsics are given either
by ``calibration``, the name of a calibration file, or by the numbers ``fx``, ``fy``, ``cx``, ``cy`` [px] and
``distortion`` (k1, k2, p1, p2[, k3[, k4, k5, k6]]).
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl, urlsplit

from skyloop.address import without_secrets
from skyloop.calibration import Calibration, load_calibration
from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.live_video import CheckedRelay, Coded, Decoder, LiveFrame, LiveVideo, StreamRelay, VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import EventKind, Intrinsics, Severity, Value

if TYPE_CHECKING:
    from skyloop.drivers.live_container import ContainerStream

STALLED_S: Final = 1.5  #: time without data, or three frame periods if longer, after which a stream is reopened
_WHERE: Final = "camera"  # source of the camera's events
OPEN_S: Final = 5.0  #: time limit for the connection, the handshake and the first frame
DEVICE_FORMAT: Final = "v4l2"
#: FFmpeg's input formats for cameras of macOS and Windows, and how each names a camera without a microphone
#: (ffmpeg.org/ffmpeg-devices.html). They are written like schemes: ``dshow://Integrated Camera``, ``avfoundation://0``.
OTHER_DEVICES: Final = {"avfoundation": "{}:none", "dshow": "video={}"}
RTP_PORT: Final = 5600  #: default port of PX4, ArduPilot's companion computers and QGroundControl
_PAYLOAD: Final = 96  # GStreamer's default payload type for rtph264pay and rtph265pay
_RTP_OPTIONS: Final = frozenset({"payload", "codec"})
_CODECS: Final = {"h264": "H264", "h265": "H265"}
#: Options that minimise FFmpeg's probing before the first frame; the frame rate is not needed.
_LIVE: Final = {"fpsprobesize": "0"}
#: Maximum time to wait for a late packet before using later packets: a few frame periods on a radio link.
_REORDER: Final = {"max_delay": "50000", "reorder_queue_size": "100"}
_RTSP: Final = {**_LIVE, "allowed_media_types": "video"}
_WAYS: Final[Mapping[str, Mapping[str, str]]] = {
    "rtsp": {**_RTSP, "rtsp_transport": "tcp"},
    "rtp": {**_LIVE, **_REORDER, "protocol_whitelist": "udp,rtp"},
    "udp": {**_LIVE, "fifo_size": "100000", "overrun_nonfatal": "1"},
    "http": _LIVE,
    "tcp": _LIVE,
}
_LISTENING: Final = frozenset({"udp", "rtp"})


@dataclass(frozen=True, slots=True)
class CameraSource:
    """A video source for FFmpeg, and its options."""

    name: str = field(repr=False)  #: address or path, including any secrets
    scheme: str  #: scheme of the address; empty for a device
    options: Mapping[str, str] = field(default_factory=dict)  #: FFmpeg's options
    sdp: str = ""  #: session description (RFC 4566), if no server provides it
    fallback: Mapping[str, str] | None = None  #: options for a retry if the server refuses the first protocol
    loses: bool = False  #: whether parts of frames can be lost unnoticed
    device: str = ""  #: FFmpeg's input format for a device of another system than Linux

    @property
    def host(self) -> str | None:
        """The host to look up; None if there is no host, or if packets may come from any host."""
        return None if self.scheme in ("", *_LISTENING) else urlsplit(self.name).hostname

    @property
    def shown(self) -> str:
        """The address without parts that may be secret: user, password and query."""
        return without_secrets(self.name)


def source_of(text: str, where: str) -> CameraSource:
    """Parse the address of a camera or the path of a device; error messages begin with ``where``.

    Raises :class:`UsageError` if the text is neither a supported stream's address nor a device.
    """
    scheme, separator, _ = text.partition("://")
    if not separator and Path(text).is_relative_to("/dev"):
        return CameraSource(text, "")
    if scheme in OTHER_DEVICES and text != f"{scheme}://":
        return CameraSource(OTHER_DEVICES[scheme].format(text.partition("://")[2]), "", device=scheme)
    if not separator or scheme not in _WAYS:
        ways = ", ".join(f"{way}://…" for way in _WAYS)
        raise UsageError(
            f"{where} is {without_secrets(text)!r} and must be one of {ways} or a device: /dev/video…, dshow://NAME, avfoundation://NAME"
        )
    try:
        parts = urlsplit(text)
        named = parts.port != 0 and (bool(parts.hostname) or scheme in _LISTENING)
    except ValueError:
        named = False
    if not named:
        raise UsageError(f"{where} names no host, as in {scheme}://192.168.1.10:8554/live")
    if scheme == "rtp":
        return CameraSource(text, scheme, _WAYS[scheme], _sdp_of(text, where), loses=True)
    fallback = {**_RTSP, **_REORDER, "rtsp_transport": "udp"} if scheme == "rtsp" else None
    return CameraSource(text, scheme, _WAYS[scheme], fallback=fallback, loses=scheme == "udp")


def _sdp_of(text: str, where: str) -> str:
    """Return the SDP for RTP packets sent to this host: ``rtp://[ADDRESS][:PORT][?payload=96&codec=h264]``."""
    parts = urlsplit(text)
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    address = parts.hostname or "0.0.0.0"
    codec, payload = options.get("codec", "h264"), options.get("payload", str(_PAYLOAD))
    try:
        version = ipaddress.ip_address(address).version
    except ValueError:
        raise UsageError(
            f"{where} is {without_secrets(text)!r}, which needs an IP address of this host or a multicast group, "
            f"or nothing, as in rtp://:{RTP_PORT}"
        ) from None
    if unknown := options.keys() - _RTP_OPTIONS:
        raise UsageError(f"{where}: rtp:// has the options codec and payload, got {', '.join(sorted(unknown))}")
    if codec not in _CODECS:
        raise UsageError(f"{where}: codec is {codec!r} and must be one of {', '.join(_CODECS)}")
    if not payload.isascii() or not payload.isdigit() or not 0 <= int(payload) <= 127:
        raise UsageError(f"{where}: payload is {payload!r} and must be a number from 0 to 127")
    port = parts.port or RTP_PORT
    mode = f"a=fmtp:{payload} packetization-mode=1\r\n" if codec == "h264" else ""
    return (
        f"v=0\r\no=- 0 0 IN IP{version} {address}\r\ns=camera\r\nc=IN IP{version} {address}\r\nt=0 0\r\n"
        f"m=video {port} RTP/AVP {payload}\r\na=rtpmap:{payload} {_CODECS[codec]}/90000\r\n{mode}"
    )


INTRINSICS_OPTIONS: Final = frozenset({"calibration", "fx", "fy", "cx", "cy", "distortion"})


def check_intrinsics(uri: VehicleUri) -> None:
    """Check the intrinsics given in an address; see :func:`intrinsics_of`."""
    if "calibration" in uri.options:
        _calibration(uri)
    else:
        intrinsics_of(uri, 1, 1)


def intrinsics_of(uri: VehicleUri, width: int, height: int) -> Intrinsics | None:
    """Return the intrinsics given in an address, for frames of this size [px].

    Returns None unless the address contains the focal length, or a calibration for this aspect ratio. Raises
    :class:`UsageError` if an option is invalid, options contradict each other, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        calibration = _calibration(uri)
        return calibration.intrinsics_for(width, height) if calibration.fits(width, height) else None
    distortion = _distortion(uri)
    if "fx" not in uri.options:
        for option in sorted(INTRINSICS_OPTIONS & uri.options.keys()):
            raise UsageError(f"{uri}: option {option} also needs fx")
        return None
    fx = uri.number("fx", 0.0, minimum=1e-3)
    return Intrinsics(
        fx=fx,
        fy=uri.number("fy", fx, minimum=1e-3),
        cx=uri.number("cx", (width - 1) / 2),
        cy=uri.number("cy", (height - 1) / 2),
        distortion=distortion,
    )


def _calibration(uri: VehicleUri) -> Calibration:
    for option in sorted(INTRINSICS_OPTIONS & uri.options.keys() - {"calibration"}):
        raise UsageError(f"{uri}: option {option} can't be combined with calibration, which includes it")
    return load_calibration(uri.reveal("calibration") or "")


def _distortion(uri: VehicleUri) -> tuple[float, ...]:
    given = uri.options.get("distortion", "")
    try:
        numbers = tuple(float(part) for part in given.split(",")) if given else ()
    except ValueError:
        numbers = (0.0,)
    if len(numbers) not in (0, 4, 5, 8):
        raise UsageError(f"{uri}: distortion is {given!r} and must be 4, 5 or 8 numbers: k1,k2,p1,p2[,k3[,k4,k5,k6]]")
    return numbers


@dataclass(frozen=True, slots=True)
class LiveCameraSettings:
    """Settings of a camera. The size and the rate are announced before the first frame, and requested from a device."""

    source: CameraSource
    name: str
    width: int  #: width [px]
    height: int
    fps: float
    stream: bool = True  #: whether the camera's H.264 is forwarded undecoded
    device_options: dict[str, str] = field(default_factory=dict)  #: FFmpeg options other than the size and the rate
    purpose: str = "a camera"  #: what PyAV is needed for, used in error messages


class LiveCamera:
    """Publishes a camera's newest frame from :meth:`start` to :meth:`stop`, and keeps reconnecting.

    PyAV opens the camera on start. Its H.264 is forwarded undecoded: immediately if nothing can have been lost in
    transit, otherwise after a decoder that rejects damaged frames has accepted it.

    Args:
        settings: Settings of the camera.
        sink: Sink of the proxy.
        intrinsics: Called with a width and a height; returns the intrinsics.
        configure: Called on the reading thread with the path of an opened device; returns the settings that failed.
        absent: Returns the error message for a missing device.
        on_event: Called with each event and its text, on the reading or decoding thread; None: the sink gets them.
    """

    def __init__(
        self,
        settings: LiveCameraSettings,
        sink: Sink,
        intrinsics: Callable[[int, int], Intrinsics | None],
        *,
        configure: Callable[[str], list[str]] | None = None,
        absent: Callable[[], str] = lambda: "there is no such device",
        on_event: Callable[[VideoEvent, str], None] | None = None,
    ) -> None:
        """Store the arguments. No I/O."""
        self._settings = settings
        self._sink = sink
        self._intrinsics = intrinsics
        self._configure = configure
        self._absent = absent
        self._checks = settings.source.loses  # whether frames are decoded before being forwarded
        self._stopped = False
        self._reported: list[str] = []
        relay = StreamRelay(sink, lambda _camera, width, height: intrinsics(width, height))
        self._relay = CheckedRelay(relay, sink, settings.name, _WHERE)
        self._video = LiveVideo(
            settings.source.shown,
            connect=self._connect,
            make_decoder=self._make_decoder,
            show=self._show,
            on_event=on_event or self._publish_event,
            wants=lambda: sink.wants(settings.name),
            wants_checked=lambda: settings.stream and self._checks and sink.wants_stream(settings.name),
            came=self._on_coded,
            name="skyloop-camera",
        )

    def start(self) -> None:
        """Start receiving. Returns immediately."""
        self._video.start()

    def stop(self) -> None:
        """Stop receiving. Idempotent; takes up to 4 s. The sink is not called afterwards."""
        self._stopped = True
        self._video.stop()

    def telemetry(self) -> dict[str, Value]:
        """Return :class:`skyloop.drivers.live_video.VideoCounters`; the names begin with ``camera.``."""
        return self._video.counters.telemetry("camera")

    # On the reading thread ---------------------------------------------------------------------------------------

    def _connect(self, number: int) -> ContainerStream:
        from skyloop.drivers.live_container import ContainerStream, ProtocolRefusedError

        settings, source = self._settings, self._settings.source
        read_s = max(STALLED_S, 3.0 / settings.fps)
        open_stream = partial(ContainerStream, number=number, clock=monotonic_ns, open_s=OPEN_S, read_s=read_s)
        self._checks = source.loses
        if not source.scheme:
            return self._open_device(open_stream)
        if source.host:
            # FFmpeg would report an unknown host name as an I/O error.
            socket.getaddrinfo(source.host, None, type=socket.SOCK_STREAM)
        if source.sdp:
            return open_stream(source.sdp.encode(), format_name="sdp", options=dict(source.options))
        try:
            return open_stream(source.name, options=dict(source.options))
        except ProtocolRefusedError:
            if source.fallback is None:
                raise
        self._checks = True
        return open_stream(source.name, options=dict(source.fallback))

    def _open_device(self, open_stream: Callable[..., ContainerStream]) -> ContainerStream:
        settings = self._settings
        path, device = settings.source.name, settings.source.device
        if not device and not Path(path).exists():
            raise FileNotFoundError(self._absent())
        size = f"{settings.width}x{settings.height}"
        options = {"video_size": size, "framerate": f"{settings.fps:g}", **settings.device_options}
        stream = open_stream(path, format_name=device or DEVICE_FORMAT, options=options)
        for problem in self._configure(path) if self._configure is not None and not device else []:
            if problem not in self._reported:
                self._reported.append(problem)
                self._report(problem)
        return stream

    def _on_coded(self, coded: Coded) -> None:
        if not self._checks:
            self._forward(coded)

    # On the decoding thread --------------------------------------------------------------------------------------

    def _make_decoder(self) -> Decoder:
        try:
            from skyloop.drivers.live_container import LiveDecoder
        except MissingExtraError as error:
            purpose = self._settings.purpose
            raise MissingExtraError(purpose, error.extra, cause=str(error.__cause__)) from error
        return LiveDecoder(self._decoded, self._report)

    def _decoded(self, coded: Coded) -> None:
        if self._checks:
            self._forward(coded)

    def _show(self, picture: LiveFrame) -> None:
        picture.show(self._sink, self._settings.name, self._intrinsics(picture.width, picture.height))

    # On either thread --------------------------------------------------------------------------------------------

    def _forward(self, coded: Coded) -> None:
        from skyloop.drivers.live_container import Piece

        if self._stopped or not self._settings.stream:
            return
        piece = coded.data
        assert isinstance(piece, Piece)
        self._relay.take(piece.unit, piece.reason, coded.captured_ns, number=piece.number, connection=coded.connection)

    def _report(self, what: str) -> None:
        if not self._stopped:
            self._sink.event(EventKind.VEHICLE_MESSAGE, f"{_WHERE}: {what}", Severity.WARNING, where=_WHERE)

    def _publish_event(self, event: VideoEvent, text: str) -> None:
        event.publish(self._sink, _WHERE, text)
