"""Show drones in Rerun, in a viewer that is started or already running, or in a file; export a recording to a file."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.client import Drone
from skyloop.clock import nanoseconds
from skyloop.errors import FileFormatError, LinkError, NoAnswerError, SkyloopError
from skyloop.messages.frame import H264, Chain
from skyloop.recording.backlog import Item
from skyloop.recording.layout import Channel, ClockPair, DroneRecord, FrameRecord
from skyloop.recording.options import MB, VIDEO
from skyloop.recording.pictures import Picture as RecordedPicture
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.rerun_log import RerunLog, Shown, rerun_sdk
from skyloop.recording.taps import check_names
from skyloop.recording.translation import Picture
from skyloop.recording.view import Source

PORT: Final = 9876  #: default port of Rerun's viewer
_START_S: Final = 20.0  # time allowed for the viewer to start listening
_AHEAD: Final = 8 * MB  #: bytes that the viewer may lag behind
_PATIENCE_S: Final = 0.5  # time to wait for a slow viewer before dropping samples
_ASK_NS: Final = nanoseconds(1.0)  # interval between checks that the viewer keeps up
_LAST_S: Final = 5.0  # time allowed for the viewer to accept the remaining data at the end
_LOOK_S: Final = 0.1  # interval between checks that the viewer listens
_SETTLED_S: Final = 1.0  # time the viewer must keep listening to count as started
_SHOWN: Final = ("feedback", "commands", "events", "annotations", "logs")
_log = logging.getLogger(__name__)


class RerunViewer:
    """A :class:`skyloop.recording.view.Screen` that shows everything: Rerun does not report what is displayed."""

    def __init__(
        self,
        drones: Sequence[Drone],
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        connect: str | None = None,
        save: Path | None = None,
    ) -> None:
        """Start the viewer or connect to it, or open the file.

        Args:
            drones: Connected drones, with distinct names.
            host: Address on which a viewer started here listens.
            port: Port of the viewer. If a viewer already listens there, it is used. None: 9876; 0: any free port.
            connect: Address of a running viewer to use instead of starting one.
            save: File to write instead of using a viewer.

        Raises:
            UsageError: Two drones have the same name, the file can't be written, or the address is invalid.
            LinkError: The viewer can't be started.
            NoAnswerError: The viewer does not start listening in time.
            MissingExtraError: The extra ``[rerun]`` is not installed.
        """
        check_names(drones, "view")
        rerun_sdk()
        self.left_out = 0  #: samples dropped because the viewer was too slow
        self._ahead = 0  # bytes that the viewer may not have accepted yet
        self._stalled = False
        self._due_ns = 0
        self._chains: dict[tuple[int, str], Chain] = {}  # H.264 shown so far
        clock = ClockPair.now()
        self._channels = frozenset(
            (number, channel)
            for number, drone in enumerate(drones)
            for channel in (*_SHOWN, *(f"{VIDEO}.{camera.name}" for camera in drone.capabilities.cameras))
        )
        self._shown = RerunLog([Shown(drone.name, drone.capabilities, _unix(clock, drone)) for drone in drones])
        if save is not None:
            self.target = str(save)
            self._shown.save(save)
            return
        if connect is None:
            chosen = _free_port(host) if port == 0 else PORT if port is None else port
            _start(host, chosen)
            connect = f"rerun+http://{host}:{chosen}/proxy"
        self.target = connect
        self._shown.connect(connect)

    def wanted(self) -> frozenset[Source]:
        """Return all sources that can be drawn."""
        return self._channels

    def show(self, item: Item) -> None:
        """Draw a sample, unless the viewer hangs: Rerun would queue all of them in memory."""
        if not self._keeps_up(item):
            self.left_out += 1
            return
        sample = item.sample
        if not isinstance(sample, Picture):
            self._shown.add(item.drone, sample)
        elif self._decodable(item, sample.record):
            self._shown.add_picture(item.drone, sample.record, sample.data)

    def close(self) -> None:
        """Finish the file. The viewer stays open."""
        try:
            self._shown.close(_PATIENCE_S if self._stalled else _LAST_S)
        except SkyloopError as error:
            _log.warning("%s", error)

    def _keeps_up(self, item: Item) -> bool:
        now_ns = time.monotonic_ns()
        self._ahead += item.size
        if now_ns < self._due_ns and (self._stalled or self._ahead < _AHEAD):
            return not self._stalled
        taken = self._shown.taken(_PATIENCE_S)
        if taken == self._stalled:
            self._stalled = not taken
            _log.warning("Rerun's viewer %s", "accepts data again" if taken else "hangs or is closed: it takes no data")
        self._ahead = 0
        self._due_ns = now_ns + _ASK_NS
        return taken

    def _decodable(self, item: Item, record: FrameRecord) -> bool:
        if record.format != H264:
            return True
        chain = self._chains.setdefault((item.drone, item.channel), Chain())
        return chain.follows(record.header.seq, key=record.key)


def _unix(clock: ClockPair, drone: Drone | DroneRecord) -> Callable[[int], int]:
    return lambda proxy_ns: clock.unix(proxy_ns, drone.clock_offset_ns)


def _start(host: str, port: int) -> None:
    """Start a viewer that outlives this program, unless one is already listening."""
    if _listens(host, port):
        return
    # Rerun's own spawn() would listen on all network interfaces.
    command = [sys.executable, "-m", "rerun_cli", "--bind", host, "--port", str(port), "--expect-data-soon"]
    try:
        viewer = subprocess.Popen(command, start_new_session=True, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise LinkError(f"Rerun's viewer can't be started: {error}") from None
    end = time.monotonic() + _START_S
    listening_s = 0.0  # a viewer without a display listens for a moment, then exits
    while listening_s < _SETTLED_S:
        if viewer.poll() is not None:
            raise LinkError(
                "Rerun's viewer exited at once: it needs a display. Without one, write a file with --save FILE, or "
                "show the drones in a viewer elsewhere with --connect URL"
            )
        if time.monotonic() > end:
            os.killpg(viewer.pid, signal.SIGTERM)  # the viewer is a child of the process started here
            raise NoAnswerError(f"Rerun's viewer is not listening on {host}:{port} after {_START_S:g} s")
        time.sleep(_LOOK_S)
        listening_s = listening_s + _LOOK_S if _listens(host, port) else 0.0


def _listens(host: str, port: int) -> bool:
    with suppress(OSError), socket.create_connection((host, port), timeout=1.0):
        return True
    return False


def _free_port(host: str) -> int:
    try:
        with socket.create_server((host, 0)) as free:
            return int(free.getsockname()[1])
    except OSError as error:
        raise LinkError(f"can't listen on {host}: {error}") from None


# A file ---------------------------------------------------------------------------------------------------------


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
    """The result of an export."""

    drones: tuple[str, ...]
    samples: int
    pictures: int
    left_out: int  #: images that are damaged or can't be decoded


def export_rrd(
    recording: Recording, path: Path, *, drone: str | None = None, progress: Progress | None = None
) -> Exported:
    """Export a recording to a file for Rerun.

    Args:
        recording: The recording.
        path: The file to write; an existing one is replaced.
        drone: The drone to export; None exports all.
        progress: Called with the fraction read so far, 0 to 1.

    Raises:
        UnknownNameError: The recording has no such drone.
        UsageError: The file can't be written.
        FileFormatError: The recording has no drones.
        MissingExtraError: The extra ``[rerun]`` is not installed.
    """
    chosen = [recording.drone(drone)] if drone is not None or not recording.drones else list(recording.drones)
    shown = [Shown(each.name, each.described, _unix(recording.clock, each)) for each in chosen]
    log = RerunLog(shown, f"{recording.path.stem}-{recording.start.started_unix_ns}")
    log.save(path)
    samples = pictures = left_out = 0
    for number, each in enumerate(chosen):
        first = number / len(chosen)
        report = None if progress is None else _part_of(progress, first, len(chosen))
        for item in recording.items_and_pictures(each.name, _CHANNELS, report):
            if not isinstance(item, RecordedPicture):
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


def _part_of(progress: Progress, first: float, parts: int) -> Progress:
    return lambda share: progress(first + share / parts)
