"""Recorded streams, damaged: nothing raises, only sent pictures are shown, and missing ones are counted."""

from __future__ import annotations

import bisect
import itertools
import random
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.drivers.live_video import Coded
from skyloop.errors import UnsupportedError
from skyloop.vehicles.ardrone.emulator.video import MP4_360P
from skyloop.vehicles.ardrone.video import PaveAssembly, PaveVideo
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, PaveFrame
from skyloop.vehicles.emulation.video import Encoder
from tests.vehicles.ardrone.video_ports import LONG, SHORT, Digest, digest, frames, pieces, recording, true_pictures

NAMES = st.sampled_from((LONG, SHORT))
FRAMES = 20  # of the long recording: an interval between key frames, and a little more
KEY_INTERVAL = 15
HEADER = 64
FEW = settings(max_examples=60, deadline=None)


@dataclass
class Outcome:
    """The result for a stream."""

    seen: list[tuple[int, Digest]] = field(default_factory=list)
    received: int = 0
    refused: int = 0
    waited: int = 0
    damaged: int = 0
    broken: int = 0
    lost_bytes: int = 0

    @property
    def numbers(self) -> list[int]:
        return [number for number, _ in self.seen]

    @property
    def false(self) -> list[int]:
        """Numbers of shown pictures that were not sent."""
        true = set(true_pictures(LONG).values()) | set(true_pictures(SHORT).values())
        return [number for number, content in self.seen if content not in true]

    def check_counts(self) -> None:
        """Check that every whole frame was shown or counted."""
        assert len(self.seen) + self.refused + self.waited + self.damaged == self.received


def play(data: bytes, piece: int = 4000) -> Outcome:
    """Decode everything between socket and screen, frame by frame."""
    assembly, decoder, outcome = PaveAssembly(0), PaveVideo(), Outcome()
    for start in range(0, len(data), piece):
        for coded in assembly.feed(data[start : start + piece], start):
            outcome.received += 1
            try:
                decoded = decoder.decode(coded, show=True)
            except UnsupportedError:
                outcome.refused += 1
                continue
            if decoded is not None:
                outcome.seen.append((decoded[0], digest(decoded[1].tobytes())))
    assembly.end()
    outcome.waited, outcome.damaged = decoder.waited, decoder.damaged
    outcome.broken, outcome.lost_bytes = assembly.broken, assembly.lost_bytes
    return outcome


def stream(name: str) -> list[bytes]:
    return list(pieces(name)[:FRAMES])


@FEW
@given(NAMES, st.data())
def test_missing_bytes(name: str, draw: st.DataObject) -> None:
    whole = b"".join(stream(name))
    start = draw.draw(st.integers(0, len(whole)), label="start")
    count = draw.draw(st.integers(0, len(whole) - start) | st.integers(0, min(2000, len(whole) - start)), label="count")
    outcome = play(whole[:start] + whole[start + count :])
    assert not outcome.false
    outcome.check_counts()


@FEW
@given(NAMES, st.randoms(use_true_random=False))
def test_frames_out_of_order_repeated_and_missing(name: str, rng: random.Random) -> None:
    sent = stream(name)
    for _ in range(rng.randrange(1, 5)):
        at, to = rng.randrange(len(sent)), rng.randrange(len(sent))
        kind = rng.randrange(3)
        if kind == 0:
            sent.insert(to, sent.pop(at))
        elif kind == 1:
            sent.insert(to, sent[at])
        else:
            del sent[at]
    outcome = play(b"".join(sent))
    assert not outcome.false
    assert outcome.lost_bytes == 0
    outcome.check_counts()


@FEW
@given(NAMES, st.data())
def test_flipped_bits_of_headers(name: str, draw: st.DataObject) -> None:
    sent = stream(name)
    for _ in range(draw.draw(st.integers(1, 4), label="how many")):
        n = draw.draw(st.integers(0, len(sent) - 1), label="frame")
        sent[n] = flipped(sent[n], draw.draw(st.integers(0, 8 * HEADER - 1), label="bit"))
    outcome = play(b"".join(sent))
    assert not outcome.false
    outcome.check_counts()


@FEW
@given(NAMES, st.data())
def test_a_flipped_payload_bit_has_no_effect_beyond_the_next_key_frame(name: str, draw: st.DataObject) -> None:
    sent = stream(name)
    n = draw.draw(st.integers(0, len(sent) - 1), label="frame")
    sent[n] = flipped(sent[n], draw.draw(st.integers(8 * HEADER, 8 * len(sent[n]) - 1), label="bit"))
    check_reach(name, b"".join(sent), n, n)


@FEW
@given(NAMES, st.integers(500, 20_000), st.data())
def test_blocks_in_the_wrong_order_have_no_effect_beyond_it_either(name: str, size: int, draw: st.DataObject) -> None:
    sent = stream(name)
    whole = b"".join(sent)
    at = draw.draw(st.integers(0, len(whole) - 2), label="where")
    size = min(size, (len(whole) - at) // 2)
    end = at + 2 * size
    swapped = whole[:at] + whole[at + size : end] + whole[at : at + size] + whole[end:]
    ends = list(itertools.accumulate(len(piece) for piece in sent))
    check_reach(name, swapped, bisect.bisect_right(ends, at), bisect.bisect_left(ends, end))


def check_reach(name: str, data: bytes, first: int, last: int) -> None:
    """Check that frames before ``first``, and from the next key frame after ``last`` on, are shown.

    H.264 has no checksum: damaged bytes may make another valid stream, which no decoder can detect. The promise is
    therefore weaker than for other damage; over TCP such damage does not go unnoticed.
    """
    outcome = play(data)
    sent = frames(name)[:FRAMES]
    key = next((n for n in range(last + 1, len(sent)) if sent[n].is_key), len(sent))
    touched = {frame.number for frame in sent[max(0, first) : key]}
    assert set(outcome.false) <= touched
    untouched = {frame.number for frame in (*sent[: max(0, first - 1)], *sent[key:])}
    assert untouched & true_pictures(name).keys() <= set(outcome.numbers)
    outcome.check_counts()


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@FEW
@given(st.binary(max_size=3000), st.integers(0, 40_000))
def test_inserted_bytes_cost_only_the_pictures_up_to_the_next_key_frame(noise: bytes, at: int) -> None:
    whole = b"".join(stream(LONG))
    outcome = play(whole[:at] + noise + whole[at:])
    assert not outcome.false
    assert set(outcome.numbers) >= {frame.number for frame in frames(LONG)[KEY_INTERVAL:FRAMES]}
    outcome.check_counts()


@given(st.binary(max_size=2000), st.integers(1, 100))
def test_noise_shows_nothing(noise: bytes, piece: int) -> None:
    outcome = play(noise, piece)
    assert not outcome.seen
    outcome.check_counts()


@pytest.mark.parametrize("name", [LONG, SHORT])
def test_an_undamaged_stream_is_shown_completely(name: str) -> None:
    outcome = play(recording(name))
    assert dict(outcome.seen) == true_pictures(name)
    assert (outcome.refused, outcome.damaged, outcome.lost_bytes) == (0, 0, 0)
    outcome.check_counts()


def test_mpeg4_as_the_emulated_drone_encodes_it() -> None:
    """Moving slopes with grain, so that frames end in every number of padding bits, some of which FFmpeg refuses."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:360, 0:640]
    encoder = Encoder(MP4_360P, 30, 4000)
    decoder = PaveVideo()
    for number in range(100):
        slopes = np.stack([(x + 3 * number) % 256 * 0.5 + 60, (y * 2 + number) % 256 * 0.6, (x + y) % 200], axis=-1)
        shown = np.clip(slopes + rng.normal(0, 2 + number % 5, (360, 640, 1)), 0, 255).astype(np.uint8)
        encoded = encoder.encode(shown)
        assert encoded is not None
        kind = FrameType.IDR if encoded.key else FrameType.P
        frame = PaveFrame(Codec.MPEG4_VISUAL, kind, number, 33 * number, 640, 360, 0, encoded.payload, False)
        decoded = decoder.decode(Coded(frame, encoded.key, 0, 0, 0), show=True)
        assert decoded is not None, number
        assert abs(float(decoded[1].mean()) - float(shown.mean())) < 4
