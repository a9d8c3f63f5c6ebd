"""Show drones in Rerun's viewer, started here or already running, or in a file for it; export recordings to such files.

Samples become entities on the timeline ``capture`` (Unix time):

=============================== =====================================================================
``world/drones/NAME``           pose and axes
``world/drones/NAME/CAMERA``    mounting, frustum, images, and drawings on them
``world/paths/NAME``            path flown
``cameras/NAME/CAMERA``         images of a camera with unknown mounting
``plots/NAME/…``                attitude, velocity, altitude, battery, set-points, logged numbers
``log/NAME``                    events and logged texts
=============================== =====================================================================
"""

from __future__ import annotations

import logging
import math
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skyloop.client import Drone
from skyloop.clock import nanoseconds
from skyloop.errors import FileFormatError, LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.messages import (
    ACTION_NAMES,
    Annotation,
    Applied,
    CameraInfo,
    Capabilities,
    Event,
    Feedback,
    Intrinsics,
    LogEntry,
    Points,
    Polyline,
    Severity,
)
from skyloop.messages.command import SET_POINTS
from skyloop.messages.frame import H264, Chain
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.messages.relayed import Text
from skyloop.platform import end_session, own_session
from skyloop.recording.backlog import Item
from skyloop.recording.layout import Channel, ClockPair, DroneRecord, FrameRecord
from skyloop.recording.options import MB, VIDEO
from skyloop.recording.pictures import RecordedImage
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.taps import Source, check_names
from skyloop.recording.translation import Trail, TranslatedImage

PORT: Final = 9876  #: default port of Rerun's viewer
_START_S: Final = 20.0  # time allowed for the viewer to start listening
_AHEAD: Final = 8 * MB  #: maximum number of bytes not yet accepted by the viewer
_PATIENCE_S: Final = 0.5  # time to wait for a slow viewer before dropping samples
_CHECK_NS: Final = nanoseconds(1.0)  # interval between checks whether the viewer keeps up
_FINISH_S: Final = 5.0  # time allowed for the viewer to accept the remaining data at the end
_POLL_S: Final = 0.1  # interval between checks whether the viewer is listening
_SETTLED_S: Final = 1.0  # time for which the viewer must keep listening to count as started
_SHOWN: Final = ("feedback", "commands", "events", "annotations", "logs")
_log = logging.getLogger(__name__)


class RerunViewer:
    """A :class:`skyloop.recording.taps.Screen` that shows everything: Rerun does not report what is displayed."""

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
            port: Port of the viewer: 9876 by default, 0 for any free one. A viewer that already listens there is used.
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
        self._ahead = 0  # number of bytes that the viewer may not have accepted yet
        self._stalled = False
        self._due_ns = 0
        self._chains: dict[tuple[int, str], Chain] = {}  # the H.264 frames shown so far
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
        """Return all drawable sources."""
        return self._channels

    def show(self, item: Item) -> None:
        """Draw a sample; drop it if the viewer hangs, because Rerun would queue all samples in memory."""
        if not self._keeps_up(item):
            self.left_out += 1
            return
        sample = item.sample
        if not isinstance(sample, TranslatedImage):
            self._shown.add(item.drone, sample)
        elif self._decodable(item, sample.record):
            self._shown.add_picture(item.drone, sample.record, sample.data)

    def close(self) -> None:
        """Finish the file. The viewer stays open."""
        try:
            self._shown.close(_PATIENCE_S if self._stalled else _FINISH_S)
        except SkyloopError as error:
            _log.warning("%s", error)

    def _keeps_up(self, item: Item) -> bool:
        now_ns = time.monotonic_ns()
        self._ahead += item.size
        if now_ns < self._due_ns and (self._stalled or self._ahead < _AHEAD):
            return not self._stalled  # as of the last check
        taken = self._shown.taken(_PATIENCE_S)
        if taken == self._stalled:
            self._stalled = not taken
            _log.warning("Rerun's viewer %s", "accepts data again" if taken else "hangs or is closed")
        self._ahead = 0
        self._due_ns = now_ns + _CHECK_NS
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
        viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, **own_session())
    except OSError as error:
        raise LinkError(f"Rerun's viewer can't be started: {error}") from None
    end = time.monotonic() + _START_S
    listening_s = 0.0  # a viewer that has no display listens for a moment, then exits
    while listening_s < _SETTLED_S:
        if viewer.poll() is not None:
            raise LinkError(
                "Rerun's viewer exited at once: it needs a display. Without one, write a file with --save FILE, or "
                "show the drones in a viewer elsewhere with --connect URL"
            )
        if time.monotonic() > end:
            end_session(viewer)  # the viewer is a child of the process that was started here
            raise NoAnswerError(f"Rerun's viewer is not listening on {host}:{port} after {_START_S:g} s")
        time.sleep(_POLL_S)
        listening_s = listening_s + _POLL_S if _listens(host, port) else 0.0


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
    left_out: int  #: number of images that are damaged or can't be decoded


def export_rrd(
    recording: Recording, path: Path, *, drone: str | None = None, progress: Progress | None = None
) -> Exported:
    """Export one drone of a recording, or all of them, to a file for Rerun; an existing file is replaced.

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
            if not isinstance(item, RecordedImage):
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


# Samples as Rerun entities ---------------------------------------------------------------------------------------


TIMELINE: Final = "capture"
APPLICATION: Final = "skyloop"
_MOST_SERIES: Final = 64  # maximum number of series and drawing sources; applications choose their names
_PATH_EVERY_NS: Final = 1_000_000_000  # interval between points of a path
_FRUSTUM_M: Final = 0.3  # size at which a camera is drawn
_LEVELS: Final = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}
_STATE: Final[dict[str, tuple[str, ...]]] = {
    "attitude": ("roll [rad]", "pitch [rad]", "yaw [rad]"),
    "velocity": ("forward [m/s]", "left [m/s]", "up [m/s]"),
    "altitude": ("altitude [m]",),
    "battery": ("battery [0 to 1]",),
}


@dataclass(frozen=True, slots=True)
class Shown:
    """A drone to show."""

    name: str
    capabilities: Capabilities
    unix: Callable[[int], int]  #: function from a time on the proxy's clock to Unix time [ns]


class RerunLog:
    """A Rerun recording. Must be used from a single thread."""

    def __init__(self, drones: Sequence[Shown], recording: str = "") -> None:
        """Initialise a recording without a destination; call :meth:`save` or :meth:`connect` next.

        ``recording``: name of the recording; Rerun merges recordings that have the same name. If empty, one is created.
        """
        self._rr = rerun_sdk()
        self._stream = self._rr.RecordingStream(APPLICATION, recording_id=recording or str(uuid.uuid4()))
        self._stream.set_log_time_enabled(False)  # log time would be the time of writing, which has no meaning here
        self._stream.set_log_tick_enabled(False)
        self._drones = [_Drone(self._rr, self._stream, drone) for drone in drones]
        self._shown = drones

    def save(self, path: Path) -> None:
        """Write to a file. Raise ``UsageError`` if the file can't be written."""
        try:
            self._stream.save(str(path), default_blueprint=self._blueprint())
        except (OSError, RuntimeError, ValueError) as error:
            raise UsageError(f"can't write {path}: {error}") from None
        self._begin()

    def connect(self, url: str) -> None:
        """Send to a viewer or a server, at an address such as ``rerun+http://127.0.0.1:9876/proxy``.

        Raise ``UsageError`` if the address is invalid.
        """
        try:
            self._stream.connect_grpc(url, default_blueprint=self._blueprint())
        except (RuntimeError, ValueError) as error:
            raise UsageError(f"{url} is not an address of a Rerun viewer: {error}") from None
        self._begin()

    def add(self, drone: int, sample: Any) -> None:
        """Add a sample of the drone with this index, if samples of that type are drawn."""
        self._drones[drone].add(sample)

    def add_picture(self, drone: int, record: FrameRecord, data: bytes) -> None:
        """Add a frame as an image file or an H.264 access unit; the first H.264 frame must be a key frame."""
        self._drones[drone].picture(record, data)

    def taken(self, timeout_s: float) -> bool:
        """Return whether the viewer or disk accepts all added samples within this time [s], which must be positive."""
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except Exception:  # noqa: BLE001 (Rerun raises its own exceptions, which have no common base)
            return False
        return True

    def close(self, timeout_s: float = 5.0) -> None:
        """Finish the file, or send the remaining data to the viewer, waiting up to ``timeout_s`` [s].

        Raise ``LinkError`` if the viewer did not accept the remaining data, which are then dropped.
        """
        if self.taken(timeout_s):
            self._stream.disconnect()
            return
        # Disconnecting, now or when Python exits, could wait forever for the viewer.
        threading.Thread(target=self._stream.disconnect, name="skyloop-rerun-end", daemon=True).start()
        self._rr.unregister_shutdown()
        raise LinkError(f"the viewer did not accept the remaining data within {timeout_s:g} s: it hangs or is closed")

    def _begin(self) -> None:
        self._stream.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for drone in self._drones:
            drone.begin()

    def _blueprint(self) -> Any:
        """Return the viewer's layout: world, cameras, plots and text."""
        import rerun.blueprint as views

        cameras = [
            views.Spatial2DView(origin=entity_of(drone.name, camera), name=f"{drone.name} {camera.name}")
            for drone in self._shown
            for camera in drone.capabilities.cameras
        ]
        plots = [
            views.TimeSeriesView(origin=f"plots/{quoted(drone.name)}/{plot}", name=f"{drone.name} {plot}")
            for drone in self._shown
            for plot in (*_STATE, "set_points")
        ]
        return views.Blueprint(
            views.Horizontal(
                views.Vertical(
                    views.Spatial3DView(origin="world", name="World"),
                    views.TextLogView(origin="log", name="Log"),
                    row_shares=[3, 1],
                ),
                views.Vertical(
                    *([views.Grid(*cameras, name="Cameras")] if cameras else []),
                    views.Grid(*plots, name="Plots") if len(self._shown) == 1 else views.Tabs(*plots, name="Plots"),
                ),
            ),
            collapse_panels=True,
        )


class _Drone:
    """Draws one drone."""

    def __init__(self, rr: Any, stream: Any, drone: Shown) -> None:
        self._rr = rr
        self._stream = stream
        self._drone = drone.name
        self._name = quoted(drone.name)
        self._unix = drone.unix
        self._cameras = {camera.name: camera for camera in drone.capabilities.cameras}
        self._lenses: dict[str, tuple[int, int, Intrinsics]] = {}
        self._codecs: set[str] = set()
        self._series: set[str] = set()
        self._sources: set[tuple[str, str]] = set()
        self._titled: set[str] = set()
        self._path = Trail()
        self._path_due_ns = 0
        self._makers: dict[type, Callable[[Any], None]] = {
            Feedback: self._feedback,
            Applied: self._applied,
            Event: self._event,
            Annotation: self._annotation,
            LogEntry: self._log,
        }

    def begin(self) -> None:
        """Draw the static parts: axes and mountings."""
        rr = self._rr
        self._stream.log(f"world/drones/{self._name}", rr.TransformAxes3D(0.3), static=True)
        for camera in self._cameras.values():
            if camera.rotation is not None:
                mounting = rr.Transform3D(
                    translation=camera.position_m or (0.0, 0.0, 0.0), mat3x3=np.array(camera.rotation).reshape(3, 3)
                )
                self._stream.log(self._entity(camera.name), mounting, static=True)

    def add(self, sample: Any) -> None:
        maker = self._makers.get(type(sample))
        if maker is not None:
            maker(sample)

    def picture(self, record: FrameRecord, data: bytes) -> None:
        rr, header = self._rr, record.header
        self._at(header.captured_ns)
        camera = self._cameras.get(header.camera)
        if header.intrinsics is not None:
            self._lens(header.camera, header.width, header.height, header.intrinsics)
        elif camera is not None and camera.intrinsics is not None:
            self._lens(camera.name, camera.width, camera.height, camera.intrinsics)
        entity = self._entity(header.camera)
        if record.format != H264:
            self._stream.log(entity, rr.EncodedImage(contents=data, media_type=f"image/{record.format}"))
            return
        if entity not in self._codecs:
            self._codecs.add(entity)
            self._stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.H264), static=True)
        self._stream.log(entity, rr.VideoStream.from_fields(sample=data, is_keyframe=record.key))

    # Kinds of samples -----------------------------------------------------------------------------------------------

    def _at(self, proxy_ns: int) -> int:
        at_ns = self._unix(proxy_ns)
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(at_ns, "ns"))
        return at_ns

    def _feedback(self, feedback: Feedback) -> None:
        rr = self._rr
        at_ns = self._at(feedback.captured_ns)
        attitude = feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad
        for plot, numbers in (
            ("attitude", attitude),
            ("velocity", feedback.velocity_m_s),
            ("altitude", (feedback.altitude_m,)),
            ("battery", (feedback.battery,)),
        ):
            if numbers is not None and any(number is not None for number in numbers):
                self._plot(plot, _STATE[plot], numbers)
        if None in attitude:
            return
        place = feedback.position_m or (0.0, 0.0, feedback.altitude_m or 0.0)
        turned = rr.Quaternion(xyzw=quaternion_from_euler(*attitude))  # type: ignore[arg-type]  # none is None here
        self._stream.log(f"world/drones/{self._name}", rr.Transform3D(translation=place, quaternion=turned))
        if feedback.position_m is not None:
            self._path.add(feedback.position_m)
            if at_ns >= self._path_due_ns:
                self._path_due_ns = at_ns + _PATH_EVERY_NS
                self._stream.log(f"world/paths/{self._name}", rr.LineStrips3D([self._path.places]))

    def _applied(self, applied: Applied) -> None:
        if not isinstance(applied.applied, SET_POINTS):
            return
        fields = {name: getattr(applied.applied, name) for name in applied.applied.__struct_fields__}
        numbers = [value for value in fields.values() if not isinstance(value, bool)]
        names = [name for name, value in fields.items() if not isinstance(value, bool)]
        if any(number is not None for number in numbers):
            self._at(applied.applied_ns)
            self._plot(f"set_points/{ACTION_NAMES[type(applied.applied)]}", names, numbers)

    def _event(self, event: Event) -> None:
        self._at(event.at_ns)
        self._text(event.text, event.severity)

    def _log(self, entry: LogEntry) -> None:
        self._at(entry.at_ns)
        if entry.text is not None:
            self._text(f"{entry.name}: {entry.text}" if entry.name else entry.text, entry.severity)
        elif entry.number is not None and _admits(self._series, entry.name):
            self._plot(f"logs/{quoted(entry.name)}", (entry.name,), (entry.number,))

    def _annotation(self, annotation: Annotation) -> None:
        if annotation.camera not in self._cameras or not _admits(self._sources, (annotation.camera, annotation.source)):
            return
        rr = self._rr
        self._at(annotation.captured_ns)
        entity = f"{self._entity(annotation.camera)}/drawn/{quoted(annotation.source)}"
        lines = [shape for shape in annotation.shapes if isinstance(shape, Polyline) and shape.points]
        spots = [shape for shape in annotation.shapes if isinstance(shape, Points)]
        texts = [shape for shape in annotation.shapes if isinstance(shape, Text)]
        strips = [(*line.points, line.points[0]) if line.closed else line.points for line in lines]
        self._stream.log(f"{entity}/lines", rr.LineStrips2D(strips, colors=[line.colour for line in lines]))
        points = [(point, spot.colour) for spot in spots for point in spot.points]
        self._stream.log(f"{entity}/points", rr.Points2D([p for p, _ in points], colors=[c for _, c in points]))
        written = rr.Points2D(
            [text.at for text in texts],
            colors=[text.colour for text in texts],
            labels=[text.text for text in texts],
            show_labels=True,
            radii=0.0,
        )
        self._stream.log(f"{entity}/texts", written)

    # Internals -------------------------------------------------------------------------------------------------

    def _plot(self, plot: str, names: Iterable[str], numbers: Iterable[float | None]) -> None:
        entity = f"plots/{self._name}/{plot}"
        if entity not in self._titled:
            self._titled.add(entity)
            self._stream.log(entity, self._rr.SeriesLines(names=list(names)), static=True)
        values = [math.nan if number is None else number for number in numbers]  # NaN is drawn as a gap
        self._stream.log(entity, self._rr.Scalars(values))

    def _text(self, text: str, severity: Severity) -> None:
        self._stream.log(f"log/{self._name}", self._rr.TextLog(text, level=_LEVELS[severity]))

    def _lens(self, camera: str, width: int, height: int, lens: Intrinsics) -> None:
        if self._lenses.get(camera) == (width, height, lens):
            return
        self._lenses[camera] = width, height, lens
        pinhole = self._rr.Pinhole(
            focal_length=(lens.fx, lens.fy),
            principal_point=(lens.cx, lens.cy),
            resolution=(width, height),
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_M,
        )
        self._stream.log(self._entity(camera), pinhole)

    def _entity(self, camera: str) -> str:
        info = self._cameras.get(camera)
        return f"cameras/{quoted(self._drone)}/{quoted(camera)}" if info is None else entity_of(self._drone, info)


def entity_of(drone: str, camera: CameraInfo) -> str:
    """Return a camera's entity, which is placed in the world if the camera's mounting is known."""
    return f"{'cameras' if camera.rotation is None else 'world/drones'}/{quoted(drone)}/{quoted(camera.name)}"


def quoted(name: str) -> str:
    """Quote a name so that it can be part of an entity path."""
    return str(rerun_sdk().escape_entity_path_part(name))


def rerun_sdk() -> Any:
    """Return Rerun's module."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError("viewing in Rerun", "rerun", cause=str(error)) from None
    return rerun


def _admits(known: set[Any], name: Any) -> bool:
    """Return whether to create an entity for an application's name; the number of such names is limited."""
    if name not in known and len(known) < _MOST_SERIES:
        known.add(name)
    return name in known
