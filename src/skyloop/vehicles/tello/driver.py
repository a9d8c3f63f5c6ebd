"""The driver for ``tello://``, which combines the link, the video and the parameters."""

from __future__ import annotations

from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.h264 import Unit
from skyloop.drivers.live_video import Coded, LiveFrame, LiveVideo, StreamRelay, VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import SinkCallback, deliver
from skyloop.errors import DriverError, ParameterError
from skyloop.messages import AnyAction, Capabilities, Hover, Intrinsics, Land, Parameter, Refusal, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.tello.link import TelloLink
from skyloop.vehicles.tello.options import options_of
from skyloop.vehicles.tello.parameters import DroneSettings
from skyloop.vehicles.tello.protocol import TelloSession
from skyloop.vehicles.tello.video import TelloVideo, VideoStream, cameras_of, intrinsics_for
from skyloop.vehicles.tello.wire import AccessUnit

ACTIONS: Final = frozenset(
    {"idle", "takeoff", "hover", "land", "velocity", "attitude", "emergency_stop", "reset_emergency"}
)


class TelloDriver(Driver):
    """A Ryze Tello. See ``docs/tello.md`` for options, parameters, events and telemetry."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._cameras = cameras_of(uri)
        self._link: TelloLink | None = None
        self._settings: DroneSettings | None = None
        self._video: LiveVideo | None = None
        self._video_ns = 0  # when usable video last arrived; 0 if never

    def capabilities(self) -> Capabilities:
        """Return the drone's capabilities.

        The cameras include the downward one, although only SDK 3.0 can switch to it.
        """
        return Capabilities(
            vehicle="tello",
            actions=ACTIONS,
            cameras=self._cameras if self.options.video else (),
            description=f"a Ryze Tello at {self.options.host}",
        )

    def _open(self, sink: Sink) -> None:
        if self.options.video:
            TelloVideo()  # raises an error now if PyAV is not installed
        session = TelloSession(
            self.options, monotonic_ns(), extra=self._video_telemetry, video_ns=lambda: self._video_ns
        )
        self._link = TelloLink(session, lambda pending: self._deliver(sink, pending))
        self._settings = DroneSettings(self._link)
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        if self._video is not None:
            self._video.stop()
        self._link = self._settings = self._video = None

    def _deliver(self, sink: Sink, pending: list[SinkCallback]) -> None:
        """Run the session's callbacks. Runs on the link's thread."""
        deliver(sink, pending)
        link, settings = self._link, self._settings
        if self._video is not None or not self.options.video or link is None or settings is None:
            return
        if link.session.ready:
            self._start_video(sink, link, settings)

    def _apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link.command(action, new=new)

    def _repeat(self, action: AnyAction) -> AnyAction:
        return self._apply(action, new=False)

    def _alone(self, action: Hover | Land) -> AnyAction:
        return self._apply(action, new=False)

    def checkup(self) -> list[Diagnostic]:
        """Return preflight findings based on the drone's latest state."""
        link = self._link
        if link is None:
            raise DriverError(f"{self.uri} is not open")
        with link.lock:
            return link.session.diagnose()

    def parameters(self) -> list[Parameter]:
        """Return the parameters. Parameters that depend on the SDK version appear once the version is known."""
        return [] if self._settings is None else self._settings.parameters()

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a parameter. Waits up to 0.95 s for the drone's reply."""
        if self._settings is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        return self._settings.write(name, value)

    def _start_video(self, sink: Sink, link: TelloLink, settings: DroneSettings) -> None:
        def show(picture: LiveFrame) -> None:
            camera = settings.camera
            picture.show(sink, camera, intrinsics(camera, picture.width, picture.height))

        def publish_video_event(event: VideoEvent, text: str) -> None:
            event.publish(sink, "video", text)

        def intrinsics(camera: str, width: int, _height: int) -> Intrinsics | None:
            return intrinsics_for(self._cameras[0], camera, width)

        relay = StreamRelay(sink, intrinsics)

        def hand_on(coded: Coded) -> None:
            unit = coded.data
            assert isinstance(unit, AccessUnit)
            whole = Unit(unit.data, unit.is_key, unit.after_gap, unit.width, unit.height)
            relay.take(settings.camera, whole, coded.captured_ns, number=unit.number, connection=coded.connection)

        def wants_stream() -> bool:
            return sink.wants_stream(settings.camera)

        decoder = TelloVideo(self.options.concealed, hand_on)

        def came(coded: Coded) -> None:
            # If nothing can be shown for too long, request the video again, as if it had stopped arriving.
            if coded.is_key or not (decoder.waits and (sink.wants(settings.camera) or wants_stream())):
                self._video_ns = monotonic_ns()

        self._video = LiveVideo(
            f"port {self.options.video_port}",
            connect=lambda number: VideoStream(self.options, lambda: link.addresses, number, monotonic_ns),
            make_decoder=lambda: decoder,
            show=show,
            on_event=publish_video_event,
            wants=lambda: sink.wants(settings.camera),
            wants_checked=wants_stream,
            came=came,
            name="tello-video",
        )
        self._video.start()

    def _video_telemetry(self) -> dict[str, Value]:
        return {} if self._video is None else self._video.counters.telemetry("video")
