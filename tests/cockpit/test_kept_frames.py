"""The frames of the last seconds: which ones are kept, found, and tracked next."""

from __future__ import annotations

import numpy as np
import pytest

from skyloop.client.frame import FeedbackHistory, ReceivedFrame, compressed
from skyloop.cockpit.target_tracker import KEPT_S, STRIDE_S, KeptFrames
from skyloop.errors import RefusedError
from skyloop.messages import Encoding, FrameHeader

MS = 1_000_000


def frame(at_ms: int, size: int = 1000) -> ReceivedFrame:
    header = FrameHeader("front", at_ms, at_ms * MS, at_ms * MS, 32, 24, Encoding.JPEG, size)
    return ReceivedFrame(header, np.zeros(size, np.uint8), at_ms * MS, 0, FeedbackHistory())


def kept(*at_ms: int, most_bytes: int = 1_000_000) -> KeptFrames:
    frames = KeptFrames(most_bytes)
    for at in at_ms:
        frames.add(frame(at))
    return frames


def test_the_last_seconds_are_kept_and_no_more_bytes_than_allowed() -> None:
    frames = kept(*range(0, 10_000, 100))
    assert len(frames) == KEPT_S * 10 + 1
    assert frames.find(round(10_000 - 100 - KEPT_S * 1000) * MS)
    few = kept(*range(0, 1000, 100), most_bytes=3500)
    assert (len(few), few.bytes) == (3, 3000)
    few.add(frame(1000, size=9000))
    assert (len(few), few.bytes) == (1, 9000), "the newest is kept, however large"


def test_the_frame_of_the_box_is_found_or_the_refusal_says_why_not() -> None:
    frames = kept(*range(1000, 8000, 100))
    assert frames.find(5000 * MS).header.seq == 5000
    for at_ms, words in (
        (1000, "6.9 s old when its box arrived, and only the last 3.0 s"),
        (5050, "did not"),
        (9000, "newer"),
    ):
        with pytest.raises(RefusedError, match=words):
            frames.find(at_ms * MS)
    with pytest.raises(RefusedError, match="no frame has arrived"):
        KeptFrames().find(0)


def test_a_restarted_proxy_counts_from_its_own_start() -> None:
    frames = kept(5000, 5100, 20)
    assert len(frames) == 1
    assert frames.bytes == 1000


def test_catching_up_takes_each_frame_but_those_closer_than_a_stride() -> None:
    frames = kept(*range(0, 1000, 33))
    taken, at_ns = [], -1
    while (one := frames.next_after(at_ns)) is not None:
        taken.append(one.header.seq)
        at_ns = one.header.captured_ns
    assert taken[0] == 33 * 2, "66 ms after the last"
    assert taken[-1] == 990
    steps = np.diff(taken)
    assert max(steps) <= STRIDE_S * 1000
    sparse = kept(0, 500, 1000)
    assert [sparse.next_after(at * MS) is None for at in (0, 500, 1000)] == [False, False, True]


def test_a_frame_kept_as_jpeg_can_be_restored() -> None:
    pixels = np.full((24, 32, 3), (200, 40, 90), np.uint8)
    header = FrameHeader("front", 3, 70, 80, 32, 24, Encoding.BGR8, pixels.size)
    original = ReceivedFrame(header, pixels.reshape(-1), 90, 5, FeedbackHistory()).frame()
    again = compressed(original).frame()
    assert (again.camera, again.seq, again.captured_ns, again.received_ns) == ("front", 3, 70, 90)
    assert again.shape == original.shape
    assert abs(np.asarray(again).astype(int) - np.asarray(original).astype(int)).max() < 6
    assert compressed(original).header.size < pixels.size
