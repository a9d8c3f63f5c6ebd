"""Decks for tests: one whose images a test shows, one fed by a simulated world, and one that follows a script."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import Report, SimHost
from skyloop.vehicles.crazyflie.deck import DeckOptions, DeckVideo, deck_options
from skyloop.vehicles.crazyflie.emulator.deck import DeckFaults, DeckSettings, EmulatedDeck
from skyloop.vehicles.crazyflie.wire.pictures import DeckState
from skyloop.vehicles.emulation.emulator import Emulator, Loop, RunningEmulator

Pixels = NDArray[np.uint8]
WITHIN_S = 20.0
_NOISE = np.random.default_rng(1).integers(40, 200, (324, 324, 3)).astype(np.uint8)


def options(port: int, more: str = "") -> DeckOptions:
    made = deck_options(parse_uri(f"crazyflie://udp?deck=127.0.0.1:{port}{more}"))
    assert made is not None
    return made


@contextmanager
def receiving(deck: DeckOptions, **arguments: object) -> Iterator[tuple[DeckVideo, RecordingSink]]:
    video, sink = DeckVideo(deck, **arguments), RecordingSink()  # type: ignore[arg-type]
    video.open(sink)
    try:
        yield video, sink
    finally:
        video.close()


def scene(number: int, width: int = 324, height: int = 244) -> Pixels:
    """Return an image that differs from all others, with its number in its first pixels."""
    picture = _NOISE[:height, :width].copy()
    picture[:, number % width] = 255
    picture[0, 0], picture[0, 1] = number % 256, number // 256
    return picture


def number_of(pixels: Pixels) -> int:
    return int(pixels[0, 0]) + 256 * int(pixels[0, 1])


class ShownDeck:
    """An emulated deck on a loop of its own, showing images at a rate, one after the other, while it is entered."""

    def __init__(
        self, stream: str = "grey", faults: DeckFaults | None = None, hz: float = 100.0, port: int = 0
    ) -> None:
        self._loop = Loop("deck")
        self.deck = EmulatedDeck(self._loop, DeckSettings(stream, port=port, faults=faults or DeckFaults()))
        self.shown = 0
        self._hz = hz
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._show, daemon=True)

    def __enter__(self) -> ShownDeck:
        self.deck.video.start()
        self._loop.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.deck.video.stop()
        self._loop.stop()
        self.deck.close()

    def post(self, call: Callable[[], None]) -> None:
        self._loop.post(call)

    def _show(self) -> None:
        camera = self.deck.camera
        while not self._ended.wait(1.0 / self._hz):
            self.shown += 1
            now_ns = monotonic_ns()
            self.deck.hear(DeckState(0, (self.shown / 1000.0, -0.5, 1.25)), now_ns)
            self.deck.video.show(camera.name, scene(self.shown, camera.width, camera.height), now_ns)


class _RunningDeck(RunningEmulator):
    def __init__(self, host: SimHost, drone: int, settings: DeckSettings) -> None:
        super().__init__(host, drone, "deck")
        self.deck = EmulatedDeck(self._loop, settings)
        self._open.append(self.deck)
        self._video = self.deck.video
        self._video.start()
        self._loop.start()
        host.attach(drone, self, self, [self.deck.camera])

    def _tick(self, report: Report) -> None:
        truth = report.truth
        self.deck.hear(DeckState(0, truth.position_m, truth.velocity_m_s, (0.0, 0.0, 0.0, 1.0)), report.captured_ns)


class SimulatedDeck(Emulator[_RunningDeck]):
    """A deck on a simulated vehicle that nobody flies."""

    def __init__(self, host: SimHost, stream: str = "grey", drone: int = 0, port: int = 0) -> None:
        super().__init__(host, drone)
        self._settings = DeckSettings(stream, port=port)

    def _switched_on(self) -> _RunningDeck:
        return _RunningDeck(self.host, self.drone, self._settings)

    @property
    def deck(self) -> EmulatedDeck:
        return self._started.deck


class ScriptedDeck:
    """A deck that runs a function for each connection, on a thread; the last function serves all further ones."""

    def __init__(self, *scripts: Callable[[socket.socket], None]) -> None:
        self._scripts = scripts
        self._server = socket.create_server(("127.0.0.1", 0))
        self.connections = 0
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @property
    def port(self) -> int:
        return int(self._server.getsockname()[1])

    def __enter__(self) -> ScriptedDeck:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join(WITHIN_S)

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            self.connections += 1
            with connection:
                self._scripts[min(self.connections, len(self._scripts)) - 1](connection)


def until_closed(connection: socket.socket) -> bytes:
    """Read until the peer ends the connection in order; return what it sent. A reset raises an error."""
    got = b""
    while data := connection.recv(4096):
        got += data
    return got
