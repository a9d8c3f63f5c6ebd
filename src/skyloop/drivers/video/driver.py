"""The driver of ``video://PATH``: options, life cycle and the thread that plays.

Options: ``camera`` its name (``front``); ``loop`` start over at the end (no); ``speed`` of a recording (1);
``wait`` for somebody to look before a recording starts (yes); ``fx``, ``fy``, ``cx``, ``cy`` [px] and ``distortion``
(``k1,k2,p1,p2[,k3]``) where the camera is known; ``width``, ``height``, ``fps`` to ask of a device.
"""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path

from skyloop.drivers.base import Driver, Sink, reject_unknown_options
from skyloop.drivers.intrinsics import INTRINSICS_OPTIONS, check_intrinsics, intrinsics_of
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.video.player import FilePlayer, LivePlayer, Screen
from skyloop.drivers.video.sources import DEFAULT_FPS, Source, is_device, open_device, open_file
from skyloop.errors import DriverError, SkyloopError, UsageError
from skyloop.messages import CameraInfo, Capabilities, EventKind, Hover, Intrinsics, Land, LinkState, Severity

_OPTIONS = {"camera", "loop", "speed", "wait", "width", "height", "fps", *INTRINSICS_OPTIONS}
_DEVICE_OPTIONS = {"width", "height", "fps"}
_CLOSE_S = 2.0


class VideoDriver(Driver):
    """A vehicle that can't fly, whose one camera shows a recording or a device of this machine."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        reject_unknown_options(uri, _OPTIONS)
        if not uri.place:
            raise UsageError(f"{uri} names no file: it looks like video:///home/me/flight.mp4 or video:///dev/video0")
        self._path = Path(uri.place).expanduser()
        self._live = is_device(self._path)
        if not self._live and (given := _DEVICE_OPTIONS & uri.options.keys()):
            raise UsageError(f"{uri}: {', '.join(sorted(given))} can be asked of a device only, not of a file")
        self._camera = uri.options.get("camera", "front")
        if not 1 <= len(self._camera) <= 64:
            raise UsageError(f"{uri}: a camera's name has 1 to 64 characters")
        self._loop = uri.flag("loop")
        self._speed = uri.number("speed", 1.0, minimum=0.01, maximum=1000.0)
        self._wait = uri.flag("wait", default=not self._live)
        self._asked_width = uri.whole("width", 640, minimum=1, maximum=16384)
        self._asked_height = uri.whole("height", 480, minimum=1, maximum=16384)
        self._asked_fps = uri.number("fps", DEFAULT_FPS, minimum=0.1, maximum=1000.0)
        check_intrinsics(uri)
        self._info: CameraInfo | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        """Looks into the head of a file, once, for the size of its pictures; a device is not touched."""
        return Capabilities(
            vehicle="video",
            cameras=(self._camera_info(),),
            description=f"pictures of {self._path}",
            why_not=f"{self.uri} is a recording or a camera, not a vehicle: there is nothing to fly",
        )

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Nothing flies, so everything is safe."""
        return True

    def _open(self, sink: Sink) -> None:
        source = None if self._live else open_file(self._path)
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
            self._play(Screen(sink, self._camera, self._intrinsics, self._stop), source)
        except Exception as error:  # noqa: BLE001  a codec's surprise must not end in silence
            sink.event(EventKind.DRIVER_ERROR, f"{self.uri}: {error!r}", Severity.ERROR, where="playing")
            sink.link(LinkState.LOST, f"playing failed: {error!r}")

    def _play(self, screen: Screen, source: Source | None) -> None:
        if source is None:
            LivePlayer(screen, self._open_device).run()
        else:
            player = FilePlayer(screen, partial(open_file, self._path), loop=self._loop, speed=self._speed)
            player.run(source, wait=self._wait)

    def _open_device(self) -> Source:
        if not self._path.exists():
            raise DriverError(f"there is no device {self._path}")
        size = f"{self._asked_width}x{self._asked_height}"
        return open_device(self._path, {"video_size": size, "framerate": f"{self._asked_fps:g}"})

    def _camera_info(self) -> CameraInfo:
        if self._info is None and not self._live:
            try:
                source = open_file(self._path)
            except SkyloopError:
                pass  # open() will say it; until then nothing better than the nominal size is known
            else:
                source.close()
                self._info = self._describe(source)
        if self._info is not None:
            return self._info
        width, height = self._asked_width, self._asked_height
        return CameraInfo(self._camera, width, height, self._asked_fps, intrinsics=self._intrinsics(width, height))

    def _describe(self, source: Source) -> CameraInfo:
        intrinsics = self._intrinsics(source.width, source.height)
        return CameraInfo(
            self._camera, source.width, source.height, source.fps, intrinsics=intrinsics, stream=source.stream
        )

    def _intrinsics(self, width: int, height: int) -> Intrinsics | None:
        """From the options; unknown (None) unless the focal length is given."""
        return intrinsics_of(self.uri, width, height)
