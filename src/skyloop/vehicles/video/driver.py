"""The driver of ``video://``: life cycle, and the thread that plays a recording or reports about a camera."""

from __future__ import annotations

import threading
from functools import partial

from skyloop.clock import monotonic_ns, seconds
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.camera_options import CameraSource, intrinsics_of
from skyloop.drivers.live_camera import LiveCamera, LiveCameraSettings
from skyloop.drivers.live_video import VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError
from skyloop.messages import CameraInfo, Capabilities, EventKind, Feedback, Hover, Intrinsics, Land, LinkState, Severity
from skyloop.messages.frame import H264
from skyloop.vehicles.video.devices import cameras, described
from skyloop.vehicles.video.options import options_of
from skyloop.vehicles.video.player import FEEDBACK_NS, CameraPublisher, FilePlayer
from skyloop.vehicles.video.sources import Source, open_file
from skyloop.vehicles.video.v4l2 import FORMATS

_CLOSE_S = 2.0


class VideoDriver(Driver):
    """A vehicle that can't fly, whose one camera shows a recorded file, a device of this machine or a stream."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._info: CameraInfo | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._live: LiveCamera | None = None
        self._streams = False

    def capabilities(self) -> Capabilities:
        """Return the camera. The head of a file is read once, for the size of its images; a camera is not touched."""
        return Capabilities(
            vehicle="video",
            cameras=(self._camera_info(),),
            description=f"frames of {self.options.place}",
            why_not=f"{self.uri} is a recording or a camera, not a vehicle: there is nothing to fly",
        )

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Return True: nothing flies."""
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
            sink.link(LinkState.CONNECTING, f"waiting for the video of {options.place}")
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

    # A recording -----------------------------------------------------------------------------------------------------

    def _run(self, sink: Sink, source: Source) -> None:
        options = self.options
        try:
            publisher = CameraPublisher(sink, options.camera, self._intrinsics, self._stop)
            player = FilePlayer(publisher, partial(open_file, options.path), loop=options.loop, speed=options.speed)
            player.run(source, wait=options.wait)
        except Exception as error:  # noqa: BLE001  a codec's surprise must not end in silence
            sink.event(EventKind.DRIVER_ERROR, f"{self.uri}: {error!r}", Severity.ERROR, where="playing")
            sink.link(LinkState.LOST, f"playing failed: {error!r}")

    # A camera --------------------------------------------------------------------------------------------------------

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
        """Publish an event of the camera, as the link's state where it is one. On either of its threads."""
        if event is VideoEvent.STREAMING:
            self._streams = True
            sink.link(LinkState.UP)
        elif event is VideoEvent.LOST:
            self._streams = False
            sink.link(LinkState.LOST, text)
        else:
            event.publish(sink, "camera", text)

    def _report_live(self, sink: Sink, live: LiveCamera) -> None:
        """Publish feedback while the camera streams: its counters, and nothing else, as nothing flies."""
        while not self._stop.wait(seconds(FEEDBACK_NS)):
            if self._streams:
                sink.feedback(Feedback(captured_ns=monotonic_ns(), native=live.telemetry()))

    def _camera_info(self) -> CameraInfo:
        options = self.options
        if self._info is None and options.source is None:
            try:
                source = open_file(options.path)
            except SkyloopError:
                pass  # open() raises it; until then nothing better than the nominal size is known
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
        """Return the intrinsics that the options give; None unless they have a focal length."""
        return intrinsics_of(self.uri, width, height)
