"""A camera beside the autopilot: RTSP, video over UDP, or a device of this machine, through PyAV."""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.drivers.base import Sink
from skyloop.drivers.intrinsics import intrinsics_of
from skyloop.drivers.mavlink.options import FACINGS, CameraOptions
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError, UsageError
from skyloop.messages import CameraInfo, Encoding, EventKind, Feedback, Intrinsics, LinkState, Severity, Value

if TYPE_CHECKING:
    from skyloop.drivers.video.sources import Source

STALLED_US: Final = 1_500_000  #: a stream that is silent for so long is opened anew
_CLOSE_S: Final = 4.0
#: No picture waits in a buffer for the next ones.
_LIVE: Final = {"fflags": "nobuffer", "flags": "low_delay", "timeout": str(STALLED_US)}
_WAYS: Final = {
    "rtsp": {**_LIVE, "rtsp_flags": "prefer_tcp"},
    "udp": {**_LIVE, "fifo_size": "100000", "overrun_nonfatal": "1"},
    "http": _LIVE,
    "tcp": _LIVE,
}


def camera_info(uri: VehicleUri, options: CameraOptions) -> CameraInfo:
    """As it is announced before the first picture."""
    intrinsics = intrinsics_of(uri, options.width, options.height)
    return CameraInfo(
        options.name,
        options.width,
        options.height,
        options.fps,
        intrinsics=intrinsics,
        rotation=FACINGS[options.facing],
    )


def check_source(uri: VehicleUri, options: CameraOptions) -> None:
    """Raises :class:`UsageError` for what is neither a stream's address nor a device."""
    scheme, separator, _ = options.source.partition("://")
    if separator and scheme in _WAYS:
        return
    if not separator and Path(options.source).is_relative_to("/dev"):
        return
    ways = ", ".join(f"{way}://…" for way in _WAYS)
    raise UsageError(f"{uri}: camera is {options.source!r} and must be one of {ways} or a device /dev/video…")


class Camera:
    """Plays the camera into a sink from :meth:`start` to :meth:`stop`; opens it anew for ever. The newest picture wins.

    Raises :class:`skyloop.errors.MissingExtraError` without PyAV.
    """

    def __init__(self, uri: VehicleUri, options: CameraOptions, sink: Sink) -> None:
        from skyloop.drivers.video.player import LivePlayer, Screen

        self._options = options
        self._stop = threading.Event()
        intrinsics = partial(intrinsics_of, uri)
        self._screen = Screen(_CameraSink(sink), options.name, intrinsics, self._stop)
        self._player = LivePlayer(self._screen, self._open)
        self._sink = sink
        self._thread = threading.Thread(target=self._run, name="skyloop-camera", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_S)

    @property
    def telemetry(self) -> dict[str, Value]:
        return {"camera.frames": self._screen.shown}

    def _run(self) -> None:
        try:
            self._player.run()
        except Exception as error:  # noqa: BLE001  a codec's surprise must not end in silence
            self._sink.event(EventKind.DRIVER_ERROR, f"the camera failed: {error!r}", Severity.ERROR, where="camera")

    def _open(self) -> Source:
        from skyloop.drivers.video.sources import ContainerSource, open_device

        source = self._options.source
        scheme, separator, _ = source.partition("://")
        if separator:
            return ContainerSource(source, None, dict(_WAYS[scheme]), live=True)
        if not Path(source).exists():
            raise DriverError(f"there is no device {source}")
        size = f"{self._options.width}x{self._options.height}"
        return open_device(Path(source), {"video_size": size, "framerate": f"{self._options.fps:g}"})


class _CameraSink:
    """Hands on pictures; a camera's link is no vehicle's."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.event = sink.event
        self.wants = sink.wants
        self.stream = sink.stream
        self.wants_stream = sink.wants_stream

    def feedback(self, feedback: Feedback) -> None:
        """A camera's is nobody's."""

    def frame(
        self,
        camera: str,
        pixels: NDArray[np.uint8],
        captured_ns: int,
        *,
        width: int,
        height: int,
        encoding: Encoding = Encoding.BGR8,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        self._sink.frame(
            camera, pixels, captured_ns, width=width, height=height, encoding=encoding, intrinsics=intrinsics
        )

    def link(self, state: LinkState, reason: str = "") -> None:
        severity = Severity.INFO if state is LinkState.UP else Severity.WARNING
        text = f"camera: {state.value}" + (f" ({reason})" if reason else "")
        self._sink.event(EventKind.VEHICLE_MESSAGE, text, severity, where="camera")
