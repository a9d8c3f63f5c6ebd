"""The driver for ``replay://`` addresses: life cycle, the playing thread, and options (``docs/replay.md``)."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.clock import Clock
from skyloop.drivers.base import Driver, Sink, reject_unknown_options
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError, UsageError
from skyloop.files import expand
from skyloop.messages import AnyAction, Capabilities, EventKind, Hover, Land, LinkState, Parameter, Severity, Value
from skyloop.recording.layout import DroneRecord
from skyloop.recording.reader import Recording
from skyloop.vehicles.replay.player import NAMES, PREFIX, SPEEDS, Playback, Player, ReplayPublisher, StepPlayer
from skyloop.vehicles.replay.source import ReplaySource, capabilities_of

_log = logging.getLogger(__name__)
_CLOSE_S: Final = 2.0  #: time allowed for the thread to end


class ReplayDriver(Driver):
    """A vehicle that replays a recording: it accepts every command but follows no command.

    With ``speed=max`` nothing plays automatically. The consumer sets :attr:`clock` before :meth:`open`, then advances
    the replay through :attr:`steps`.
    """

    shared = False
    parameters_without_authority = NAMES  # these control only the replay, not a flight

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self.stepped = self.options.stepped
        self.clock: Clock | None = None
        self.steps: StepPlayer | None = None
        self._capabilities: Capabilities | None = None
        self._playback: Playback | None = None
        self._thread: threading.Thread | None = None
        self._publisher: ReplayPublisher | None = None

    def capabilities(self) -> Capabilities:
        """Return the recording's cameras. The file is read once; :meth:`open` refuses an unreadable file."""
        if self._capabilities is None:
            try:
                recording, drone = self._read()
                self._capabilities = capabilities_of(recording, drone)
            except SkyloopError as error:
                return Capabilities("replay", why_not=str(error))
        return self._capabilities

    def parameters(self) -> list[Parameter]:
        """Return the replay's own parameters, and those recorded so far (read-only, with the prefix ``recorded.``)."""
        playback, publisher = self._playback, self._publisher
        if playback is None or publisher is None:
            return []
        recorded = sorted(publisher.parameters.copy().values(), key=lambda parameter: parameter.name)
        return [*recorded, *playback.parameters()]

    def set_parameter(self, name: str, value: Value) -> Value:
        """Move, pause or slow down the replay; see :class:`skyloop.vehicles.replay.player.Playback`."""
        if self._playback is None or name.startswith(PREFIX):
            return super().set_parameter(name, value)
        return self._playback.set(name, value)

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Return True because nothing is flying."""
        return True

    def source(self) -> ReplaySource:
        """Open the recording; raise an error if it is missing or unreadable, or ends before ``start``."""
        recording, drone = self._read()
        source = ReplaySource(recording, drone, self.options.start_s)
        if source.empty:
            raise UsageError(
                f"{self.uri}: the recording lasts {recording.seconds:.1f} s"
                + (f", but start is {self.options.start_s:g} s" if self.options.start_s else ": it is empty")
            )
        return source

    def _open(self, sink: Sink) -> None:
        source = self.source()
        if self.stepped:
            self._open_steps(source, sink)
            return
        self._playback = Playback(source.seconds, self.options.speed)
        player = Player(source, sink, self._playback, loop=self.options.loop)
        self._publisher = player.publisher
        cameras = tuple(camera.name for camera in self.capabilities().cameras) if self.options.wait else ()
        self._thread = threading.Thread(
            target=self._run, args=(player, sink, cameras), name="skyloop-replay", daemon=True
        )
        self._thread.start()

    def _open_steps(self, source: ReplaySource, sink: Sink) -> None:
        if self.clock is None:
            raise UsageError(
                f'{self.uri}: speed=max runs in step with one application: call skyloop.connect("{self.uri}") there, '
                "or give a number, such as speed=10, to serve any client"
            )
        self._playback = Playback(source.seconds, in_step=True)
        self.steps = StepPlayer(source, sink, self.clock, self._playback)
        self._publisher = self.steps.publisher
        self.steps.begin()

    def _close(self) -> None:
        if self._playback is not None:
            self._playback.stop()
        if self.steps is not None:
            self.steps.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_S)
        self._thread = None

    def _apply(self, action: AnyAction) -> AnyAction:
        """Accept the action, which has no effect on the replay."""
        return action

    def _run(self, player: Player, sink: Sink, cameras: tuple[str, ...]) -> None:
        try:
            player.run(cameras)
        except Exception as error:  # noqa: BLE001  an unexpected error in a damaged file must be reported
            _log.exception("%s can't be played further", self.uri)
            why = str(error) if isinstance(error, SkyloopError) else "an error in Skyloop (see the proxy's output)"
            at_s = self._playback.position_s if self._playback is not None else 0.0
            text = f"this recording can't be played beyond {at_s:.1f} s: {why}"
            sink.event(EventKind.DRIVER_ERROR, text, Severity.ERROR, where="replaying")
            sink.link(LinkState.LOST, text)

    def _read(self) -> tuple[Recording, DroneRecord]:
        recording = Recording.open(self.options.path)
        return recording, recording.drone(self.options.drone)


KNOWN: Final = {"speed", "loop", "drone", "start", "wait"}
MAX: Final = "max"


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """The contents of a parsed ``replay://`` address."""

    path: Path
    drone: str | None  #: the drone's name in the recording; None for the first drone
    start_s: float  #: start of the replay, counted from the start of the recording
    speed: float  #: recorded seconds per second
    stepped: bool  #: whether it runs in step with one application (``speed=max``; see :mod:`skyloop.stepping.replay`)
    loop: bool  #: whether to start over at the end
    wait: bool  #: whether to start only once a client requests a camera's frames


def options_of(uri: VehicleUri) -> ReplayOptions:
    """Parse an address."""
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(f"{uri} names no file; it should look like replay:///home/me/flight.mcap?speed=2")
    stepped = uri.options.get("speed") == MAX
    options = ReplayOptions(
        path=expand(uri.reveal_place()),
        drone=uri.options.get("drone"),
        speed=1.0 if stepped else uri.number("speed", 1.0, minimum=SPEEDS[0], maximum=SPEEDS[1]),
        stepped=stepped,
        loop=uri.flag("loop"),
        start_s=uri.number("start", 0.0, minimum=0.0, maximum=1e6),
        wait=uri.flag("wait"),
    )
    if stepped and (options.loop or options.wait):
        raise UsageError(f"{uri}: speed=max can't be combined with loop or wait")
    return options
