"""The driver for ``video://``: life cycle, the thread that plays a file or reports on a camera, and options.

``docs/drivers.md`` lists the options.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from skyloop.clock import monotonic_ns, seconds
from skyloop.drivers.base import Driver, Sink, reject_unknown_options
from skyloop.drivers.live_camera import (
    INTRINSICS_OPTIONS,
    CameraSource,
    LiveCamera,
    LiveCameraSettings,
    check_intrinsics,
    intrinsics_of,
    source_of,
)
from skyloop.drivers.live_video import VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError, UnknownNameError, UsageError
from skyloop.files import expand
from skyloop.messages import CameraInfo, Capabilities, EventKind, Feedback, Hover, Intrinsics, Land, LinkState, Severity
from skyloop.messages.frame import H264
from skyloop.vehicles.video.player import (
    DEFAULT_FPS,
    FEEDBACK_NS,
    CameraPublisher,
    FilePlayer,
    Source,
    is_device,
    open_file,
)
from skyloop.vehicles.video.v4l2 import FORMATS, V4l2Device, cameras, described, opened

_CLOSE_S = 2.0  # time allowed for the thread to end


class VideoDriver(Driver):
    """A vehicle that can't fly and has one camera, which is a video file, a local device or a stream."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._info: CameraInfo | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._live: LiveCamera | None = None
        self._streams = False

    def capabilities(self) -> Capabilities:
        """Return the camera. A file's start is read once to determine its image size; a live camera is not opened."""
        return Capabilities(
            vehicle="video",
            cameras=(self._camera_info(),),
            description=f"frames of {self.options.place}",
            why_not=f"{self.uri} is a recording or a camera, not a vehicle that can fly",
        )

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Return True because nothing is flying."""
        return True

    def _open(self, sink: Sink) -> None:
        options = self.options
        self._stop.clear()
        if options.source is None:
            source = open_file(options.path)
            self._info = self._describe(source)
            run = partial(self._run, sink, source)
        else:
            self._live = LiveCamera(
                self._live_settings(options.source),
                sink,
                self._intrinsics,
                configure=options.device.configure,
                absent=lambda: f"there is no such device; {described(cameras())}",
                on_event=partial(self._publish_event, sink),
            )
            sink.link(LinkState.CONNECTING, f"waiting for video from {options.place}")
            self._live.start()
            run = partial(self._report_live, sink, self._live)
        self._thread = threading.Thread(target=run, name="skyloop-video", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        if self._live is not None:
            self._live.stop()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_S)
        self._thread = self._live = None

    def _run(self, sink: Sink, source: Source) -> None:
        options = self.options
        try:
            publisher = CameraPublisher(sink, options.camera, self._intrinsics, self._stop)
            player = FilePlayer(publisher, partial(open_file, options.path), loop=options.loop, speed=options.speed)
            player.run(source, wait=options.wait)
        except Exception as error:  # noqa: BLE001  an unexpected error in a codec must be reported
            sink.event(EventKind.DRIVER_ERROR, f"{self.uri}: {error!r}", Severity.ERROR, where="playing")
            sink.link(LinkState.LOST, f"playback failed: {error!r}")

    def _live_settings(self, source: CameraSource) -> LiveCameraSettings:
        options = self.options
        wanted = {"input_format": FORMATS[options.device.format]} if options.device.format else {}
        return LiveCameraSettings(
            source,
            options.camera,
            options.width,
            options.height,
            options.fps,
            options.stream,
            wanted,
            purpose="video://",
        )

    def _publish_event(self, sink: Sink, event: VideoEvent, text: str) -> None:
        """Publish a camera's event, or the link state that it implies. Runs on either of the camera's threads."""
        if event is VideoEvent.STREAMING:
            self._streams = True
            sink.link(LinkState.UP)
        elif event is VideoEvent.LOST:
            self._streams = False
            sink.link(LinkState.LOST, text)
        else:
            event.publish(sink, "camera", text)

    def _report_live(self, sink: Sink, live: LiveCamera) -> None:
        """Publish feedback while the camera streams. Feedback consists only of counters, because nothing is flying."""
        while not self._stop.wait(seconds(FEEDBACK_NS)):
            if self._streams:
                sink.feedback(Feedback(captured_ns=monotonic_ns(), native=live.telemetry()))

    def _camera_info(self) -> CameraInfo:
        options = self.options
        if self._info is None and options.source is None:
            try:
                source = open_file(options.path)
            except SkyloopError:
                pass  # open() raises the error; until then only the nominal size is known
            else:
                source.close()
                self._info = self._describe(source)
        if self._info is not None:
            return self._info
        width, height = options.width, options.height
        return CameraInfo(
            options.camera,
            width,
            height,
            options.fps,
            intrinsics=self._intrinsics(width, height),
            stream=H264 if options.stream else "",
        )

    def _describe(self, source: Source) -> CameraInfo:
        intrinsics = self._intrinsics(source.width, source.height)
        return CameraInfo(
            self.options.camera, source.width, source.height, source.fps, intrinsics=intrinsics, stream=source.stream
        )

    def _intrinsics(self, width: int, height: int) -> Intrinsics | None:
        """Return the intrinsics given by the options; None if there is no focal length."""
        return intrinsics_of(self.uri, width, height)


_LIVE: Final = ("width", "height", "fps", "stream")
_DEVICE: Final = ("format", "exposure", "gain")
KNOWN: Final = {"camera", "loop", "speed", "wait", *_LIVE, *_DEVICE, *INTRINSICS_OPTIONS}
_AUTO: Final = "auto"


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """Settings for a local camera; settings that are not given are left unchanged."""

    format: str = ""  #: one of :data:`FORMATS`
    exposure: float | str = ""  #: [ms], or ``auto``
    gain: int | str = ""  #: gain in the device's own unit, or ``auto``

    def configure(self, path: str) -> list[str]:
        """Set exposure and gain; return a readable description of each failure."""
        if self.exposure == "" and self.gain == "":
            return []
        try:
            with opened(path) as device:
                problems = self.apply(device)
        except OSError as error:
            problems = [f"exposure and gain can't be set: {error.strerror or error}"]
        return problems

    def apply(self, device: V4l2Device) -> list[str]:
        """Set the exposure and gain of an open device; see :meth:`configure`."""
        problems = []
        if self.exposure != "":
            problems.append(device.set_exposure(None if isinstance(self.exposure, str) else self.exposure))
        if self.gain != "":
            problems.append(device.set_gain(None if isinstance(self.gain, str) else self.gain))
        return [problem for problem in problems if problem]


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """The contents of a parsed ``video://`` address."""

    place: str  #: path or address without secrets
    path: Path  #: path of the file
    source: CameraSource | None  #: source of live video; None for a file
    camera: str  #: the camera's name
    loop: bool  #: whether to start over at the end
    speed: float  #: speed at which a file is played, in recorded seconds per second
    wait: bool  #: whether a file starts only once a client wants its frames
    width: int  #: width to request from a device or announce for a stream [px]
    height: int
    fps: float
    stream: bool  #: whether to announce H.264 that is relayed unchanged
    device: DeviceOptions


def options_of(uri: VehicleUri) -> VideoOptions:
    """Parse an address."""
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(
            f"{uri} names neither a file nor a camera; it should look like video:///home/me/flight.mp4, "
            f"video:///dev/video0 or video://rtsp://192.168.1.10/live; {described(cameras())}"
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
    if "://" in place:
        return Path(), source_of(place, f"{uri.scheme}://")
    path = expand(place)
    return path, CameraSource(str(path), "") if is_device(path) else None


def _check_kind(uri: VehicleUri, source: CameraSource | None) -> None:
    """Raise an error if the options do not fit the source."""
    if source is not None and (uri.flag("loop") or uri.number("speed", 1.0) != 1.0):
        raise UsageError(f"{uri}: loop and speed apply only to files, not to live cameras")
    unfit = {
        "only a device or a stream has": _LIVE if source is None else (),
        "only a device has": _DEVICE if source is None or source.scheme else (),
    }
    for what, names in unfit.items():
        if given := [name for name in names if name in uri.options]:
            raise UsageError(f"{uri}: {what} {' and '.join(given)}")


def _streams(uri: VehicleUri, source: CameraSource | None) -> bool:
    """Return whether a camera probably sends H.264, as a network camera or a device set to that format does."""
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
