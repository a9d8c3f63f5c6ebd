"""Options of a ``video://PATH`` address. Pure but for a look at what kind of file the path names.

``docs/drivers.md`` has the options as a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.intrinsics import INTRINSICS_OPTIONS, check_intrinsics
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.video.devices import cameras, described
from skyloop.drivers.video.sources import DEFAULT_FPS, is_device
from skyloop.errors import UsageError
from skyloop.files import expand

KNOWN: Final = {"camera", "loop", "speed", "wait", "width", "height", "fps", *INTRINSICS_OPTIONS}
_DEVICE_OPTIONS: Final = {"width", "height", "fps"}


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """A parsed address."""

    path: Path
    live: bool  #: a device of this machine, not a file
    camera: str  #: its name
    loop: bool  #: start over at the end
    speed: float  #: of a recording: seconds of it in a second
    wait: bool  #: a recording starts when somebody wants its frames
    width: int  #: to ask of a device [px]
    height: int
    fps: float


def options_of(uri: VehicleUri) -> VideoOptions:
    """Parse an address.

    Raises:
        UnknownNameError: It has an option that is not in :data:`KNOWN`.
        UsageError: It names no file, or an option's value makes no sense.
    """
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(
            f"{uri} names no file and no camera: it looks like video:///home/me/flight.mp4 or video:///dev/video0; "
            f"{described(cameras())}"
        )
    path = expand(uri.place)
    live = is_device(path)
    if not live and (given := _DEVICE_OPTIONS & uri.options.keys()):
        raise UsageError(f"{uri}: {', '.join(sorted(given))} can be asked of a device only, not of a file")
    camera = uri.options.get("camera", "front")
    if not 1 <= len(camera) <= 64:
        raise UsageError(f"{uri}: a camera's name has 1 to 64 characters")
    options = VideoOptions(
        path=path,
        live=live,
        camera=camera,
        loop=uri.flag("loop"),
        speed=uri.number("speed", 1.0, minimum=0.01, maximum=1000.0),
        wait=uri.flag("wait", default=not live),
        width=uri.whole("width", 640, minimum=1, maximum=16384),
        height=uri.whole("height", 480, minimum=1, maximum=16384),
        fps=uri.number("fps", DEFAULT_FPS, minimum=0.1, maximum=1000.0),
    )
    check_intrinsics(uri)
    return options
