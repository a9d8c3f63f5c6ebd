"""Camera options in a vehicle's address: the video source, and the intrinsics.

The video source is the address of a stream, or a device; FFmpeg opens it. The intrinsics are given by ``calibration``,
the name of a calibration file, or by the numbers ``fx``, ``fy``, ``cx``, ``cy`` [px] and ``distortion`` (k1, k2, p1,
p2[, k3[, k4, k5, k6]]).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from skyloop.address import without_secrets
from skyloop.calibration import Calibration, load_calibration
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.messages import Intrinsics

DEVICE_FORMAT: Final = "v4l2"
RTP_PORT: Final = 5600  #: the default port of PX4, ArduPilot's companion computers and QGroundControl
_PAYLOAD: Final = 96  # GStreamer's default for rtph264pay and rtph265pay
_RTP_OPTIONS: Final = frozenset({"payload", "codec"})
_CODECS: Final = {"h264": "H264", "h265": "H265"}
#: Options that minimise FFmpeg's probing before the first picture, because the frame rate is not needed.
_LIVE: Final = {"fpsprobesize": "0"}
#: How long to wait for a late packet before using later ones: a few pictures' time on a radio link.
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
    """A video source for FFmpeg, with its options."""

    name: str = field(repr=False)  #: address or path, with its secrets
    scheme: str  #: scheme of the address; empty for a device
    options: Mapping[str, str] = field(default_factory=dict)  #: FFmpeg's options
    sdp: str = ""  #: session description (RFC 4566), if there is no server to provide it
    fallback: Mapping[str, str] | None = None  #: options to retry with if the server refuses the first protocol
    loses: bool = False  #: whether parts of pictures may get lost unnoticed

    @property
    def host(self) -> str | None:
        """The host to look up; None if there is none or packets may come from any host."""
        return None if self.scheme in ("", *_LISTENING) else urlsplit(self.name).hostname

    @property
    def shown(self) -> str:
        """The address without possible secrets: user, password and query."""
        return without_secrets(self.name)


def is_address(text: str) -> bool:
    """Return whether a text is the address of a stream rather than a path."""
    return "://" in text


def source_of(text: str, where: str) -> CameraSource:
    """Parse the address of a camera.

    Args:
        text: The address, or a device's path.
        where: Name of the address, which begins error messages.

    Raises:
        UsageError: The text is neither the address of a supported stream nor a device.
    """
    scheme, separator, _ = text.partition("://")
    if not separator and Path(text).is_relative_to("/dev"):
        return CameraSource(text, "")
    if not separator or scheme not in _WAYS:
        ways = ", ".join(f"{way}://…" for way in _WAYS)
        raise UsageError(f"{where} is {without_secrets(text)!r} and must be one of {ways} or a device /dev/video…")
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
    """Return the SDP for RTP sent to a port of this host: ``rtp://[ADDRESS][:PORT][?payload=96&codec=h264]``.

    Raises:
        UsageError: The address or an option makes no sense.
    """
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
    """Check the intrinsics in an address.

    Raises:
        UsageError: An option makes no sense, options contradict each other, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        _calibration(uri)
    else:
        intrinsics_of(uri, 1, 1)


def intrinsics_of(uri: VehicleUri, width: int, height: int) -> Intrinsics | None:
    """Return the intrinsics in an address for frames of the given size.

    Args:
        uri: The vehicle's address.
        width: Width [px].
        height: Height [px].

    Returns:
        The intrinsics; None unless the address gives the focal length, or a calibration for this aspect ratio.

    Raises:
        UsageError: An option makes no sense, options contradict each other, or the calibration can't be read.
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
