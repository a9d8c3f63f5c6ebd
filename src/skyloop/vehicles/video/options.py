"""Options of a ``video://`` address. Pure but for a look at what kind of file a path names.

``docs/drivers.md`` has the options as a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.camera_options import INTRINSICS_OPTIONS, CameraSource, check_intrinsics, is_address, source_of
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.files import expand
from skyloop.messages.frame import H264
from skyloop.vehicles.video.devices import cameras, described
from skyloop.vehicles.video.sources import DEFAULT_FPS, is_device
from skyloop.vehicles.video.v4l2 import FORMATS, V4l2Device, opened

_LIVE: Final = ("width", "height", "fps", "stream")
_DEVICE: Final = ("format", "exposure", "gain")
KNOWN: Final = {"camera", "loop", "speed", "wait", *_LIVE, *_DEVICE, *INTRINSICS_OPTIONS}
_AUTO: Final = "auto"


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """What is set on a camera of this machine; a field that was not given leaves it as it is."""

    format: str = ""  #: one of :data:`FORMATS`
    exposure: float | str = ""  #: [ms], or ``auto``
    gain: int | str = ""  #: in the device's own unit, or ``auto``

    def configure(self, path: str) -> list[str]:
        """Set exposure and gain. Return what could not be set, in words."""
        if self.exposure == "" and self.gain == "":
            return []
        try:
            with opened(path) as device:
                problems = self.apply(device)
        except OSError as error:
            problems = [f"exposure and gain can't be set: {error.strerror or error}"]
        return problems

    def apply(self, device: V4l2Device) -> list[str]:
        """Set exposure and gain of an open device; see :meth:`configure`."""
        problems = []
        if self.exposure != "":
            problems.append(device.set_exposure(None if isinstance(self.exposure, str) else self.exposure))
        if self.gain != "":
            problems.append(device.set_gain(None if isinstance(self.gain, str) else self.gain))
        return [problem for problem in problems if problem]


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """A parsed address."""

    place: str  #: path or address, as it may be shown
    path: Path  #: of a file
    source: CameraSource | None  #: of live video; None: a file
    camera: str  #: its name
    loop: bool  #: start over at the end
    speed: float  #: of a recording: seconds of it in a second
    wait: bool  #: a recording starts when somebody wants its frames
    width: int  #: to ask of a device, and announced of a stream [px]
    height: int
    fps: float
    stream: bool  #: whether H.264 is announced, to be handed on as it comes
    device: DeviceOptions


def options_of(uri: VehicleUri) -> VideoOptions:
    """Parse an address.

    Raises:
        UnknownNameError: It has an option that is not in :data:`KNOWN`.
        UsageError: It names no file, or an option's value makes no sense.
    """
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(
            f"{uri} names no file and no camera: it looks like video:///home/me/flight.mp4, video:///dev/video0 or "
            f"video://rtsp://192.168.1.10/live; {described(cameras())}"
        )
    path, source = _place(uri)
    _check_kind(uri, source)
    camera = uri.options.get("camera", "front")
    if not 1 <= len(camera) <= 64:
        raise UsageError(f"{uri}: a camera's name has 1 to 64 characters")
    options = VideoOptions(
        place=source.shown if source is not None else str(path),
        path=path,
        source=source,
        camera=camera,
        loop=uri.flag("loop"),
        speed=uri.number("speed", 1.0, minimum=0.01, maximum=1000.0),
        wait=uri.flag("wait", default=source is None),
        width=uri.whole("width", 640, minimum=1, maximum=16384),
        height=uri.whole("height", 480, minimum=1, maximum=16384),
        fps=uri.number("fps", DEFAULT_FPS, minimum=0.1, maximum=1000.0),
        stream=uri.flag("stream", default=_streams(uri, source)),
        device=_device(uri),
    )
    check_intrinsics(uri)
    return options


def _place(uri: VehicleUri) -> tuple[Path, CameraSource | None]:
    place = uri.reveal_place()
    if is_address(place):
        return Path(), source_of(place, f"{uri.scheme}://")
    path = expand(place)
    return path, CameraSource(str(path), "") if is_device(path) else None


def _check_kind(uri: VehicleUri, source: CameraSource | None) -> None:
    """Check that options fit what the address names.

    Raises:
        UsageError: They don't.
    """
    if source is not None and (uri.flag("loop") or uri.number("speed", 1.0) != 1.0):
        raise UsageError(f"{uri}: a live camera has no loop and no speed")
    unfit = {
        "only a device or a stream has": _LIVE if source is None else (),
        "only a device has": _DEVICE if source is None or source.scheme else (),
    }
    for what, names in unfit.items():
        if given := [name for name in names if name in uri.options]:
            raise UsageError(f"{uri}: {what} {' and '.join(given)}")


def _streams(uri: VehicleUri, source: CameraSource | None) -> bool:
    """Return whether a camera is likely to send H.264: one on the network, or a device that is asked for it."""
    return source is not None and (bool(source.scheme) or uri.options.get("format") == H264)


def _device(uri: VehicleUri) -> DeviceOptions:
    known = uri.options.get("format", "")
    if known and known not in FORMATS:
        raise UnknownNameError("format of video://", known, FORMATS)
    exposure: float | str = uri.options.get("exposure", "")
    gain: int | str = uri.options.get("gain", "")
    if exposure not in ("", _AUTO):
        exposure = uri.number("exposure", 0.0, minimum=0.1, maximum=100_000.0)
    if gain not in ("", _AUTO):
        gain = uri.whole("gain", 0, minimum=-(2**31))
    return DeviceOptions(known, exposure, gain)
