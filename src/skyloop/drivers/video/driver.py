"""The driver of ``video://PATH``: life cycle and the thread that plays."""

from __future__ import annotations

import threading
from functools import partial

from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.intrinsics import intrinsics_of
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.video.devices import cameras, described
from skyloop.drivers.video.options import options_of
from skyloop.drivers.video.player import CameraPublisher, FilePlayer, LivePlayer
from skyloop.drivers.video.sources import Source, open_device, open_file
from skyloop.errors import DriverError, SkyloopError
from skyloop.messages import CameraInfo, Capabilities, EventKind, Hover, Intrinsics, Land, LinkState, Severity

_CLOSE_S = 2.0


class VideoDriver(Driver):
    """A vehicle that can't fly, whose one camera shows a recorded file or a device of this machine."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._info: CameraInfo | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        """Return the camera. The head of a file is read once, for the size of its images; a device is not touched."""
        return Capabilities(
            vehicle="video",
            cameras=(self._camera_info(),),
            description=f"frames of {self.options.path}",
            why_not=f"{self.uri} is a recording or a camera, not a vehicle: there is nothing to fly",
        )

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Return True: nothing flies."""
        return True

    def _open(self, sink: Sink) -> None:
        source = None if self.options.live else open_file(self.options.path)
        if source is not None:
            self._info = self._describe(source)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(sink, source), name="skyloop-video", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_S)
        self._thread = None

    def _run(self, sink: Sink, source: Source | None) -> None:
        try:
            self._play(CameraPublisher(sink, self.options.camera, self._intrinsics, self._stop), source)
        except Exception as error:  # noqa: BLE001  a codec's surprise must not end in silence
            sink.event(EventKind.DRIVER_ERROR, f"{self.uri}: {error!r}", Severity.ERROR, where="playing")
            sink.link(LinkState.LOST, f"playing failed: {error!r}")

    def _play(self, publisher: CameraPublisher, source: Source | None) -> None:
        if source is None:
            LivePlayer(publisher, self._open_device).run()
        else:
            player = FilePlayer(
                publisher, partial(open_file, self.options.path), loop=self.options.loop, speed=self.options.speed
            )
            player.run(source, wait=self.options.wait)

    def _open_device(self) -> Source:
        if not self.options.path.exists():
            raise DriverError(f"there is no {self.options.path}; {described(cameras())}")
        size = f"{self.options.width}x{self.options.height}"
        return open_device(self.options.path, {"video_size": size, "framerate": f"{self.options.fps:g}"})

    def _camera_info(self) -> CameraInfo:
        if self._info is None and not self.options.live:
            try:
                source = open_file(self.options.path)
            except SkyloopError:
                pass  # open() raises it; until then nothing better than the nominal size is known
            else:
                source.close()
                self._info = self._describe(source)
        if self._info is not None:
            return self._info
        width, height = self.options.width, self.options.height
        return CameraInfo(
            self.options.camera, width, height, self.options.fps, intrinsics=self._intrinsics(width, height)
        )

    def _describe(self, source: Source) -> CameraInfo:
        intrinsics = self._intrinsics(source.width, source.height)
        return CameraInfo(
            self.options.camera, source.width, source.height, source.fps, intrinsics=intrinsics, stream=source.stream
        )

    def _intrinsics(self, width: int, height: int) -> Intrinsics | None:
        """Return the intrinsics that the options give; None unless they have a focal length."""
        return intrinsics_of(self.uri, width, height)
