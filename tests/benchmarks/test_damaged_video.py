"""``benchmarks.damaged_video``: the results of a short run on both streams, and its counting."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.recordings import needs_recordings

pytest.importorskip("av")

from benchmarks import damaged_video


@needs_recordings
@pytest.mark.slow
def test_every_picture_shown_is_right() -> None:
    rows = list(damaged_video.run((0.02,), 1))
    assert [(row.stream, row.decoder) for row in rows] == [
        ("AR.Drone 2", "Skyloop"),
        ("AR.Drone 2", "FFmpeg"),
        ("the same over RTP", "Skyloop"),
        ("Tello, 2.05 Mbit/s", "Skyloop"),
        ("Tello, 2.05 Mbit/s", "Skyloop, concealed=2"),
        ("Tello, 2.05 Mbit/s", "FFmpeg"),
    ]
    for row in rows:
        assert 0 < row.shown <= 1
        if row.decoder == "Skyloop":
            assert row.right == 1
    text = damaged_video.table(rows)
    assert "| AR.Drone 2 | 2 % | Skyloop |" in text
    assert text.count("| identical |") == 3


def test_a_seed_loses_the_same_pieces_each_time() -> None:
    stream = [[bytes([n])] * 50 for n in range(20)]
    assert damaged_video.lost(stream, 0.1, 1) == damaged_video.lost(stream, 0.1, 1)
    assert damaged_video.lost(stream, 0.1, 1) != damaged_video.lost(stream, 0.1, 2)
    kept = sum(map(len, damaged_video.lost(stream, 0.1, 1)))
    assert 850 < kept < 950
    assert damaged_video.cut(b"abcde", 2) == [b"ab", b"cd", b"e"]


def test_the_ratio_of_signal_to_noise() -> None:
    grey = np.full((4, 4, 3), 100, np.uint8)
    assert damaged_video.psnr(grey, grey) == damaged_video.SAME_DB
    assert damaged_video.psnr(grey, grey + 1) == pytest.approx(48.13, abs=0.01)
