"""Options of a ``replay://FLIGHT.mcap`` address. Pure. ``docs/replay.md`` has them as a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.files import expand

KNOWN: Final = {"speed", "loop", "drone", "start", "wait"}
MAX: Final = "max"
SPEEDS: Final = (0.01, 1000.0)  #: slowest and fastest, in seconds of the recording in a second


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """A parsed address."""

    path: Path
    drone: str | None  #: its name in the recording; None: the first
    start_s: float  #: where to begin, after the recording's own begin
    speed: float  #: seconds of the recording in a second
    stepped: bool  #: ``speed=max``: in step with one application, see :mod:`skyloop.stepping.replay`
    loop: bool  #: start over at the end
    wait: bool  #: begin when somebody wants a camera's frames


def options_of(uri: VehicleUri) -> ReplayOptions:
    """Parse an address.

    Raises:
        UnknownNameError: It has an option that is not in :data:`KNOWN`.
        UsageError: It names no file, an option's value makes no sense, or options don't go together.
    """
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(f"{uri} names no file: it looks like replay:///home/me/flight.mcap?speed=2")
    stepped = uri.options.get("speed") == MAX
    options = ReplayOptions(
        path=expand(uri.reveal_place()),
        drone=uri.options.get("drone"),
        speed=1.0 if stepped else uri.number("speed", 1.0, minimum=SPEEDS[0], maximum=SPEEDS[1]),
        stepped=stepped,
        loop=uri.flag("loop"),
        start_s=uri.number("start", 0.0, minimum=0.0, maximum=1e6),
        wait=uri.flag("wait"),
    )
    if stepped and (options.loop or options.wait):
        raise UsageError(f"{uri}: speed=max goes neither with loop nor with wait: it is through when it is through")
    return options
