"""A camera in the options of a vehicle's address: where its video comes from, and its intrinsics.

Video comes from the address of a stream or from a device, as FFmpeg opens them. Of the intrinsics, ``calibration``
names the file of a calibration; or ``fx``, ``fy``, ``cx``, ``cy`` [px] and ``distortion`` (k1, k2, p1, p2[, k3[, k4,
k5, k6]]) give the numbers.
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
RTP_PORT: Final = 5600  #: which PX4, ArduPilot's companions and QGroundControl use
_PAYLOAD: Final = 96  # GStreamer's, of rtph264pay and rtph265pay
_RTP_OPTIONS: Final = frozenset({"payload", "codec"})
_CODECS: Final = {"h264": "H264", "h265": "H265"}
#: FFmpeg gathers as little as it can before the first picture: the rate of pictures is not needed.
_LIVE: Final = {"fpsprobesize": "0"}
#: A packet that is late is waited for so long before the others go on without it: a few pictures of a radio link.
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
    """What FFmpeg opens, and how."""

    name: str = field(repr=False)  #: address or path, with its secrets
    scheme: str  #: of the address; empty for a device
    options: Mapping[str, str] = field(default_factory=dict)  #: FFmpeg's
    sdp: str = ""  #: RFC 4566, for a session that nobody describes
    fallback: Mapping[str, str] | None = None  #: options for a server that refuses the first ones' protocol
    loses: bool = False  #: parts of pictures may get lost on the way, unnoticed

    @property
    def host(self) -> str | None:
        """The host to look up; None if there is none, or packets come from wherever they do."""
        return None if self.scheme in ("", *_LISTENING) else urlsplit(self.name).hostname

    @property
    def shown(self) -> str:
        """The address without what may be a secret: user, password and query."""
        return without_secrets(self.name)


def is_address(text: str) -> bool:
    """Return whether a text is the address of a stream rather than a path."""
    return "://" in text


def source_of(text: str, where: str) -> CameraSource:
    """Parse the address of a camera.

    Args:
        text: The address, or a device's path.
        where: The beginning of errors: of what it is the address.

    Raises:
        UsageError: It is neither the address of a stream that can be opened nor a device.
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
        raise UsageError(f"{where} names no host: it looks like {scheme}://192.168.1.10:8554/live")
    if scheme == "rtp":
        return CameraSource(text, scheme, _WAYS[scheme], _sdp_of(text, where), loses=True)
    fallback = {**_RTSP, **_REORDER, "rtsp_transport": "udp"} if scheme == "rtsp" else None
    return CameraSource(text, scheme, _WAYS[scheme], fallback=fallback, loses=scheme == "udp")


def _sdp_of(text: str, where: str) -> str:
    """Describe RTP that comes to a port of this host: ``rtp://[ADDRESS][:PORT][?payload=96&codec=h264]``.

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
            f"or none: rtp://:{RTP_PORT}"
        ) from None
    if unknown := options.keys() - _RTP_OPTIONS:
        raise UsageError(f"{where}: rtp:// has the options codec and payload, not {', '.join(sorted(unknown))}")
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
    """Check the intrinsics of an address.

    Raises:
        UsageError: An option makes no sense, options don't go together, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        _calibration(uri)
    else:
        intrinsics_of(uri, 1, 1)


def intrinsics_of(uri: VehicleUri, width: int, height: int) -> Intrinsics | None:
    """Return the intrinsics of an address for frames of a size.

    Args:
        uri: The vehicle's address.
        width: [px]
        height: [px]

    Returns:
        None unless the address gives the focal length, or a calibration made with frames of this shape.

    Raises:
        UsageError: An option makes no sense, options don't go together, or the calibration can't be read.
    """
    if "calibration" in uri.options:
        calibration = _calibration(uri)
        return calibration.intrinsics_for(width, height) if calibration.fits(width, height) else None
    distortion = _distortion(uri)
    if "fx" not in uri.options:
        for option in sorted(INTRINSICS_OPTIONS & uri.options.keys()):
            raise UsageError(f"{uri}: option {option} needs fx as well")
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
        raise UsageError(f"{uri}: option {option} does not go with calibration, which has it already")
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
