"""A network camera or a camera device of this machine, opened with PyAV on start.

It publishes frames, and forwards H.264 undecoded: at once if nothing can have been lost in transit, otherwise only
after a decoder that rejects damage has accepted it.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.camera_options import DEVICE_FORMAT, CameraSource
from skyloop.drivers.h264 import CheckedRelay, StreamRelay
from skyloop.drivers.live_video import Coded, Decoder, LiveVideo, Picture, VideoEvent
from skyloop.errors import MissingExtraError
from skyloop.messages import EventKind, Intrinsics, Severity, Value

if TYPE_CHECKING:
    from skyloop.drivers.live_container import ContainerStream

STALLED_S: Final = 1.5  #: a stream that is silent for this long, or for three of its periods, is reopened
_WHERE: Final = "camera"  # source of the events
OPEN_S: Final = 5.0  #: time limit for connecting, the handshake and the first picture


@dataclass(frozen=True, slots=True)
class LiveCameraSettings:
    """A camera's settings. Size and rate are announced before the first picture, and requested from a device."""

    source: CameraSource
    name: str
    width: int  #: width [px]
    height: int
    fps: float
    stream: bool = True  #: whether its H.264 is forwarded undecoded
    device_options: dict[str, str] = field(default_factory=dict)  #: options for FFmpeg besides size and rate
    purpose: str = "a camera"  #: what PyAV is needed for, for error messages


class LiveCamera:
    """Publishes the camera's newest picture from :meth:`start` to :meth:`stop`, and keeps reconnecting.

    Args:
        settings: The camera's settings.
        sink: The proxy's sink.
        intrinsics: Returns the intrinsics for a width and height.
        configure: Called on the reading thread with the path of an opened device; returns the settings that failed.
        absent: Returns the error text for a missing device.
        on_event: Called with each event and its text, on either thread; None: events go to the sink.
    """

    def __init__(
        self,
        settings: LiveCameraSettings,
        sink: Sink,
        intrinsics: Callable[[int, int], Intrinsics | None],
        *,
        configure: Callable[[str], list[str]] | None = None,
        absent: Callable[[], str] = lambda: "there is no such device",
        on_event: Callable[[VideoEvent, str], None] | None = None,
    ) -> None:
        """Store the arguments. No I/O."""
        self._settings = settings
        self._sink = sink
        self._intrinsics = intrinsics
        self._configure = configure
        self._absent = absent
        self._checks = settings.source.loses  # whether pictures are decoded before being forwarded
        self._stopped = False
        self._reported: list[str] = []
        relay = StreamRelay(sink, lambda _camera, width, height: intrinsics(width, height))
        self._relay = CheckedRelay(relay, sink, settings.name, _WHERE)
        self._video = LiveVideo(
            settings.source.shown,
            connect=self._connect,
            make_decoder=self._make_decoder,
            show=self._show,
            on_event=on_event or self._publish_event,
            wants=lambda: sink.wants(settings.name),
            wants_checked=lambda: settings.stream and self._checks and sink.wants_stream(settings.name),
            came=self._on_coded,
            name="skyloop-camera",
        )

    def start(self) -> None:
        """Start receiving. Returns at once."""
        self._video.start()

    def stop(self) -> None:
        """Stop receiving. Idempotent; takes up to 4 s. The sink is not called afterwards."""
        self._stopped = True
        self._video.stop()

    def telemetry(self) -> dict[str, Value]:
        """Return the counters of :class:`skyloop.drivers.live_video.VideoCounters`, with the prefix ``camera.``."""
        return self._video.counters.telemetry("camera")

    # On the reading thread ---------------------------------------------------------------------------------------

    def _connect(self, number: int) -> ContainerStream:
        from skyloop.drivers.live_container import ContainerStream, ProtocolRefusedError

        settings, source = self._settings, self._settings.source
        read_s = max(STALLED_S, 3.0 / settings.fps)
        open_stream = partial(ContainerStream, number=number, clock=monotonic_ns, open_s=OPEN_S, read_s=read_s)
        self._checks = source.loses
        if not source.scheme:
            return self._open_device(open_stream)
        if source.host:
            # FFmpeg would report an unknown name as an I/O error.
            socket.getaddrinfo(source.host, None, type=socket.SOCK_STREAM)
        if source.sdp:
            return open_stream(source.sdp.encode(), format_name="sdp", options=dict(source.options))
        try:
            return open_stream(source.name, options=dict(source.options))
        except ProtocolRefusedError:
            if source.fallback is None:
                raise
        self._checks = True
        return open_stream(source.name, options=dict(source.fallback))

    def _open_device(self, open_stream: Callable[..., ContainerStream]) -> ContainerStream:
        settings = self._settings
        path = settings.source.name
        if not Path(path).exists():
            raise FileNotFoundError(self._absent())
        size = f"{settings.width}x{settings.height}"
        options = {"video_size": size, "framerate": f"{settings.fps:g}", **settings.device_options}
        stream = open_stream(path, format_name=DEVICE_FORMAT, options=options)
        for problem in [] if self._configure is None else self._configure(path):
            if problem not in self._reported:
                self._reported.append(problem)
                self._report(problem)
        return stream

    def _on_coded(self, coded: Coded) -> None:
        if not self._checks:
            self._forward(coded)

    # On the decoding thread --------------------------------------------------------------------------------------

    def _make_decoder(self) -> Decoder:
        try:
            from skyloop.drivers.live_container import LiveDecoder
        except MissingExtraError as error:
            purpose = self._settings.purpose
            raise MissingExtraError(purpose, error.extra, cause=str(error.__cause__)) from error
        return LiveDecoder(self._decoded, self._report)

    def _decoded(self, coded: Coded) -> None:
        if self._checks:
            self._forward(coded)

    def _show(self, picture: Picture) -> None:
        picture.show(self._sink, self._settings.name, self._intrinsics(picture.width, picture.height))

    # On either thread --------------------------------------------------------------------------------------------

    def _forward(self, coded: Coded) -> None:
        from skyloop.drivers.live_container import Piece

        if self._stopped or not self._settings.stream:
            return
        piece = coded.data
        assert isinstance(piece, Piece)
        self._relay.take(piece.unit, piece.reason, coded.captured_ns, number=piece.number, connection=coded.connection)

    def _report(self, what: str) -> None:
        if not self._stopped:
            self._sink.event(EventKind.VEHICLE_MESSAGE, f"{_WHERE}: {what}", Severity.WARNING, where=_WHERE)

    def _publish_event(self, event: VideoEvent, text: str) -> None:
        event.publish(self._sink, _WHERE, text)
