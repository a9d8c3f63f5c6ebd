"""Export of a recording for Rerun, as a file that its viewer opens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.errors import FileFormatError
from skyloop.recording.layout import Channel, DroneRecord
from skyloop.recording.pictures import Picture
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.rerun_log import RerunLog, Shown

_CHANNELS: Final = (
    Channel.FEEDBACK,
    Channel.COMMANDS,
    Channel.EVENTS,
    Channel.ANNOTATIONS,
    Channel.LOGS,
    Channel.FRAMES,
)


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export wrote."""

    drones: tuple[str, ...]
    samples: int
    pictures: int
    left_out: int  #: pictures that can't be decoded, or are damaged


def export_rrd(
    recording: Recording, path: Path, *, drone: str | None = None, progress: Progress | None = None
) -> Exported:
    """Write a recording for Rerun.

    Args:
        recording: The recording.
        path: The file; an existing one is replaced.
        drone: The only one to export; None: all of them.
        progress: Called with the share that was read, 0 to 1.

    Raises:
        UnknownNameError: The recording has no such drone.
        UsageError: The file can't be written.
        FileFormatError: The recording has no drone.
        MissingExtraError: The extra ``[rerun]`` is not installed.
    """
    chosen = [recording.drone(drone)] if drone is not None or not recording.drones else list(recording.drones)
    shown = [Shown(each.name, each.described, _unix(recording, each)) for each in chosen]
    log = RerunLog(shown, f"{recording.path.stem}-{recording.start.started_unix_ns}")
    log.save(path)
    samples = pictures = left_out = 0
    for number, each in enumerate(chosen):
        first = number / len(chosen)
        report = None if progress is None else _part_of(progress, first, len(chosen))
        for item in recording.items_and_pictures(each.name, _CHANNELS, report):
            if not isinstance(item, Picture):
                log.add(number, item.value)
                samples += 1
                continue
            try:
                data = item.compressed if item.can_be_decoded else None
            except FileFormatError:
                data = None
            if data is None:
                left_out += 1
            else:
                log.add_picture(number, item.record, data)
                pictures += 1
    log.close()
    return Exported(tuple(each.name for each in chosen), samples, pictures, left_out)


def _unix(recording: Recording, drone: DroneRecord) -> Callable[[int], int]:
    return lambda proxy_ns: recording.clock.unix(proxy_ns, drone.clock_offset_ns)


def _part_of(progress: Progress, first: float, parts: int) -> Progress:
    return lambda share: progress(first + share / parts)
