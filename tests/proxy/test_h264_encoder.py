"""The encoder of a stream whose rate changes while it runs."""

from __future__ import annotations

import pytest

from benchmarks.measuring.schedule import SMALL
from benchmarks.moving_scene import MovingScene
from skyloop.pyav import H264Encoder

pytest.importorskip("av", reason="H.264 needs the extra 'video'")
FPS = 30
PERIOD_NS = 1_000_000_000 // FPS


class Film:
    """A moving camera."""

    def __init__(self) -> None:
        self._scene = MovingScene(SMALL)
        self._now_ns = 0

    def kbit_s(self, encoder: H264Encoder) -> float:
        """Encode for two seconds, and return the rate in the second half."""
        size = 0
        for index in range(2 * FPS):
            self._now_ns += PERIOD_NS
            data, _ = encoder.encode(self._scene.picture(self._now_ns), "bgr24", self._now_ns)
            size += len(data) if index >= FPS else 0
        return size * 8e-3


def test_a_variable_rate_can_be_raised_and_lowered_without_a_new_encoder() -> None:
    encoder, film = H264Encoder(320, 240, FPS, 300, varies=True), Film()
    assert film.kbit_s(encoder) == pytest.approx(300, rel=0.3)
    assert encoder.carries(900)
    encoder.set_rate(900)
    assert film.kbit_s(encoder) == pytest.approx(800, rel=0.3)
    assert encoder.carries(100)
    encoder.set_rate(100)
    assert film.kbit_s(encoder) == pytest.approx(100, rel=0.3)


def test_a_rate_far_from_the_initial_one_needs_a_new_encoder() -> None:
    steady, varying = H264Encoder(320, 240, FPS, 300), H264Encoder(320, 240, FPS, 300, varies=True)
    assert [steady.carries(kbit_s) for kbit_s in (20, 300, 301)] == [False, True, False]
    assert [varying.carries(kbit_s) for kbit_s in (60, 75, 900, 901)] == [False, True, True, False]
