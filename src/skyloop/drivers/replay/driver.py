"""The driver of ``replay://FLIGHT.mcap``: options, life cycle and the thread that plays.

Options: ``speed`` (1; ``max``: as fast as one application consumes, see :mod:`skyloop.recording.lockstep`); ``loop``
start over at the end (no); ``drone`` its name in the recording (the first); ``start`` where to begin [s] (0); ``wait``
for somebody to look at a camera before it starts (no).
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Final

from skyloop.clock import Clock
from skyloop.drivers.base import Driver, Sink, reject_unknown_options
from skyloop.drivers.replay.player import Player, Steps
from skyloop.drivers.replay.tape import Tape, capabilities
from skyloop.drivers.replay.telling import Teller
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError, UsageError
from skyloop.logfile.layout import DroneRecord
from skyloop.logfile.reader import Recording
from skyloop.messages import (
    AnyAction,
    Capabilities,
    EventKind,
    Hover,
    Land,
    LinkState,
    Parameter,
    Severity,
)

_OPTIONS: Final = {"speed", "loop", "drone", "start", "wait"}
MAX: Final = "max"
_CLOSE_S: Final = 2.0


class ReplayDriver(Driver):
    """A vehicle that does what was recorded, whatever it is commanded; commands are accepted, and change nothing."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        reject_unknown_options(uri, _OPTIONS)
        if not uri.place:
            raise UsageError(f"{uri} names no file: it looks like replay:///home/me/flight.mcap?speed=2")
        self._path = Path(uri.place).expanduser()
        #: Moved by ``steps`` by whoever consumes it and has set ``clock`` before it was opened.
        self.stepped = uri.options.get("speed") == MAX
        self._speed = 1.0 if self.stepped else uri.number("speed", 1.0, minimum=0.01, maximum=1000.0)
        self._loop = uri.flag("loop")
        self._start_s = uri.number("start", 0.0, minimum=0.0, maximum=1e6)
        self._wait = uri.flag("wait")
        if self.stepped and (self._loop or self._wait):
            raise UsageError(f"{uri}: speed=max goes neither with loop nor with wait: it is through when it is through")
        self.clock: Clock | None = None
        self.steps: Steps | None = None
        self._capabilities: Capabilities | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._teller: Teller | None = None

    def capabilities(self) -> Capabilities:
        """Looks through the file, once, for its cameras. A file that can't be read is refused by :meth:`open`."""
        if self._capabilities is None:
            try:
                recording, drone = self._read()
                self._capabilities = capabilities(recording, drone)
            except SkyloopError as error:
                return Capabilities("replay", why_not=str(error))
        return self._capabilities

    def parameters(self) -> list[Parameter]:
        """Those recorded so far, with the prefix ``recorded.``, to be read only."""
        teller = self._teller
        return [] if teller is None else sorted(teller.parameters.copy().values(), key=lambda parameter: parameter.name)

    def failsafe(self, action: Hover | Land) -> bool:  # noqa: ARG002
        """Nothing flies, so everything is safe."""
        return True

    def tape(self) -> Tape:
        """Raises :class:`UsageError` for a recording that is not there, can't be read, or is over before its start."""
        recording, drone = self._read()
        tape = Tape(recording, drone, self._start_s)
        if tape.empty:
            raise UsageError(
                f"{self.uri}: the recording lasts {recording.seconds:.1f} s"
                + (f", and start is {self._start_s:g} s" if self._start_s else ": it is empty")
            )
        return tape

    def _open(self, sink: Sink) -> None:
        tape = self.tape()
        if self.stepped:
            self._open_steps(tape, sink)
            return
        player = Player(tape, sink, self._stop, speed=self._speed, loop=self._loop)
        self._teller = player.teller
        self._stop.clear()
        cameras = tuple(camera.name for camera in self.capabilities().cameras) if self._wait else ()
        self._thread = threading.Thread(
            target=self._run, args=(player, sink, cameras), name="skyloop-replay", daemon=True
        )
        self._thread.start()

    def _open_steps(self, tape: Tape, sink: Sink) -> None:
        if self.clock is None:
            raise UsageError(
                f'{self.uri}: speed=max is in step with one application: call skyloop.connect("{self.uri}") there, '
                "or give a number, such as speed=10, to serve everybody"
            )
        self.steps = Steps(tape, sink, self.clock)
        self._teller = self.steps.teller
        self.steps.begin()

    def _close(self) -> None:
        self._stop.set()
        if self.steps is not None:
            self.steps.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_S)
        self._thread = None

    def _apply(self, action: AnyAction) -> AnyAction:
        """Taken, told to whoever listens, and without effect on what was recorded."""
        return action

    def _run(self, player: Player, sink: Sink, cameras: tuple[str, ...]) -> None:
        try:
            player.run(cameras)
        except Exception as error:  # noqa: BLE001  a damaged file's surprise must not end in silence
            sink.event(EventKind.DRIVER_ERROR, f"{self.uri}: {error!r}", Severity.ERROR, where="replaying")
            sink.link(LinkState.LOST, f"replaying failed: {error!r}")

    def _read(self) -> tuple[Recording, DroneRecord]:
        recording = Recording.open(self._path)
        return recording, recording.drone(self.uri.options.get("drone"))
