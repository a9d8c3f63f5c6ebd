"""The driver for ``ardrone://``, which combines the link, the video and the parameters."""

from __future__ import annotations

import secrets
from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.live_camera import intrinsics_of
from skyloop.drivers.live_video import LiveFrame, VideoEvent
from skyloop.drivers.uri import VehicleUri
from skyloop.drivers.vehicle_session import SinkCallback, deliver
from skyloop.errors import DriverError, ParameterError, SkyloopError
from skyloop.messages import AnyAction, Capabilities, EventKind, Intrinsics, Parameter, Refusal, Severity, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.ardrone.configuration import own_ids
from skyloop.vehicles.ardrone.link import ArdroneLink
from skyloop.vehicles.ardrone.options import options_of
from skyloop.vehicles.ardrone.parameters import Commands, Entry, active_camera, entries_of, is_confirmed, prepare_write
from skyloop.vehicles.ardrone.protocol import ArdroneSession
from skyloop.vehicles.ardrone.telemetry import diagnose
from skyloop.vehicles.ardrone.video import EncodedStream, VideoReceiver, cameras_of, make_decoder

ACTIONS: Final = frozenset({"idle", "takeoff", "hover", "land", "attitude", "emergency_stop", "reset_emergency"})


class ArdroneDriver(Driver):
    """A Parrot AR.Drone 1 or 2. See ``docs/ardrone.md`` for options, parameters, events and telemetry."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._session: ArdroneSession | None = None
        self._link: ArdroneLink | None = None
        self._video: VideoReceiver | None = None
        self._commands: Commands | None = None
        self._camera = "front"

    def capabilities(self) -> Capabilities:
        """Return the capabilities, with the cameras of an AR.Drone 2 unless the address specifies version 1."""
        version = self.options.version
        return Capabilities(
            vehicle=f"ardrone{version}" if version else "ardrone",
            actions=ACTIONS,
            cameras=cameras_of(self.uri, version) if self.options.video else (),
            description=f"a Parrot AR.Drone{f' {version}' if version else ''} at {self.options.host}",
        )

    def _open(self, sink: Sink) -> None:
        if self.options.video:
            make_decoder(self.options.version or 2)  # raises an error now if the decoder's library is not installed
        ids = own_ids(secrets.randbits(32))
        session = ArdroneSession(self.options, ids, monotonic_ns(), extra=self._video_telemetry)
        self._session = session
        self._link = ArdroneLink(session, lambda pending: self._deliver(sink, pending))
        self._commands = Commands(session.setpoints, self._link.send)
        self._link.start()

    def _close(self) -> None:
        if self._link is not None:
            self._link.stop()
        if self._video is not None:
            self._video.stop()
        self._session = self._link = self._video = self._commands = None

    def _deliver(self, sink: Sink, pending: list[SinkCallback]) -> None:
        """Run the session's callbacks. Runs on the link's thread."""
        deliver(sink, pending)
        session = self._session
        if session is not None and session.ready:
            self._camera = active_camera(session.configurator.values)
            if self._video is None and self.options.video and session.version is not None:
                self._start_video(sink, session.version)

    def _apply(self, action: AnyAction) -> AnyAction:
        if action.name not in ACTIONS:
            return super()._apply(action)
        if self._link is None:
            raise DriverError(f"{self.uri} is not open")
        return self._link.command(action)

    def checkup(self) -> list[Diagnostic]:
        """Return preflight findings based on the drone's state and configuration."""
        link = self._link
        if link is None:
            raise DriverError(f"{self.uri} is not open")
        with link.lock:
            state, values = link.session.state, dict(link.session.configurator.values)
        return diagnose(state, values)

    def parameters(self) -> list[Parameter]:
        """Return the commands that are not actions, and the drone's configuration once it has been read."""
        if self._link is None or self._commands is None:
            return []
        with self._link.lock:
            version = self._link.session.version
            known = self._commands.parameters(version)
        return known + [entry.parameter for entry in self._entries().values()]

    def set_parameter(self, name: str, value: Value) -> Value:
        """Write a key, wait for its acknowledgement and read it back; or send a command. Takes up to 0.9 s."""
        link, commands = self._link, self._commands
        if link is None or commands is None:
            raise ParameterError(f"{self.uri} is not open", code=Refusal.VEHICLE_LINK_LOST)
        with link.lock:
            known = {parameter.name: parameter for parameter in commands.parameters(link.session.version)}
        if name in known:
            return commands.write(known[name], value)
        entries = self._entries()
        if not entries:
            raise ParameterError("the drone's configuration has not been read yet", code=Refusal.VEHICLE_LINK_LOST)
        return self._configure(link, *prepare_write(entries, name, value))

    def _configure(self, link: ArdroneLink, entry: Entry, text: str) -> Value:
        failure = link.write(entry.key, text)
        if failure is not None:
            raise ParameterError(f"{entry.parameter.name}: {failure}", code=Refusal.DRIVER_FAILED)
        with link.lock:
            session = link.session
            reported = session.configurator.values.get(entry.key, "")
            session.read_limits()
            accepted = is_confirmed(entry, text, reported)
            if accepted:
                session.remembered[entry.key] = reported
        if not accepted:
            raise ParameterError(f"the drone kept {entry.key} at {reported} and did not accept {text}")
        return entry.from_text(reported)

    def _entries(self) -> dict[str, Entry]:
        link = self._link
        if link is None:
            return {}
        with link.lock:
            values, version = dict(link.session.configurator.values), link.session.version
        return entries_of(values, version)

    def _start_video(self, sink: Sink, version: int) -> None:
        options = self.options

        def show(picture: LiveFrame) -> None:
            picture.show(sink, self._camera, self._intrinsics(picture.width, picture.height))

        def publish_video_event(event: VideoEvent, text: str) -> None:
            event.publish(sink, "video", text)

        self._video = VideoReceiver(
            options.host,
            options.ports.video,
            version=version,
            show=show,
            on_event=publish_video_event,
            wants=lambda: sink.wants(self._camera),
            came=EncodedStream(sink, lambda: self._camera, self._intrinsics).take if version == 2 else None,
        )
        try:
            self._video.start()
        except SkyloopError as error:
            sink.event(EventKind.DRIVER_ERROR, f"no video: {error}", Severity.ERROR, where="video")

    def _intrinsics(self, width: int, height: int) -> Intrinsics | None:
        """Return the front camera's intrinsics if the address has any; None for the bottom camera."""
        return intrinsics_of(self.uri, width, height) if self._camera == "front" else None

    def _video_telemetry(self) -> dict[str, Value]:
        return {} if self._video is None else self._video.counters.telemetry("video")
