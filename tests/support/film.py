"""Pictures that show their number, as H.264, and a projector that sends them at their times."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.vehicles.emulation.video import Encoded, Encoder, Format

BITS, STRIPE, HEIGHT = 12, 16, 64
WIDTH = BITS * STRIPE
FPS = 25.0
GROUP = 10

Pixels = NDArray[np.uint8]


def picture_of(number: int) -> Pixels:
    """Return a picture, (height, width, 3): a stripe for each bit of the number, above detail that takes bytes."""
    pixels = np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    for bit in range(BITS):
        pixels[: HEIGHT // 2, bit * STRIPE : (bit + 1) * STRIPE] = 220 if number >> bit & 1 else 30
    return pixels


def number_of(pixels: Pixels) -> int:
    """Return the number that the stripes show."""
    stripes = pixels[4 : HEIGHT // 2 - 4].reshape(-1, BITS, STRIPE, 3).mean(axis=(0, 2, 3))
    return sum(1 << bit for bit, level in enumerate(stripes) if level > 125)


class Film:
    """Encodes one picture after another."""

    def __init__(self) -> None:
        self._encoder = Encoder(Format("h264", WIDTH, HEIGHT, 0), FPS, 2000, group=GROUP)
        self.number = 0

    def next(self) -> Encoded:
        encoded = self._encoder.encode(picture_of(self.number))
        assert encoded is not None
        self.number += 1
        return encoded


class Projector:
    """Passes pictures to ``send``, each with its stamp [s], 25 times a second until it is closed.

    ``taken_ns`` holds when each was taken, by number.
    """

    def __init__(self, send: Callable[[bytes, float], None], film: Film | None = None) -> None:
        self._send = send
        self._film = film or Film()
        self._ended = threading.Event()
        self.paused = threading.Event()
        self.spoilt = threading.Event()  #: whether pictures are noise
        self.taken_ns: dict[int, int] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Projector:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(10.0)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        begun_ns, period_ns = monotonic_ns(), nanoseconds(1 / FPS)
        noise = np.random.default_rng(0)
        while not self._ended.is_set():
            number = self._film.number
            due_ns = begun_ns + number * period_ns
            if self._ended.wait(max(0, due_ns - monotonic_ns()) / 1e9):
                return
            taken_ns = monotonic_ns()
            data = self._film.next().payload
            if self.spoilt.is_set():
                data = b"\0\0\0\1" + noise.integers(1, 256, 400, np.uint8).tobytes()
            self.taken_ns[number] = taken_ns
            if not self.paused.is_set():
                self._send(data, 1000.0 + (taken_ns - begun_ns) / 1e9)
