"""Recordings of H.264, written like the recorder's: with its translation, into its file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from skyloop.clock import NS_PER_S
from skyloop.messages import CameraInfo, Capabilities, Encoding, FrameHeader
from skyloop.messages.frame import H264
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import VERSION, ClockPair, DroneRecord, End, FrameRecord, Start, to_plain
from skyloop.recording.translation import TranslatedImage, Translator
from skyloop.recording.writer import RecordingFile
from skyloop.vehicles.emulation.video import Encoder, Format

MS = 1_000_000
BEGIN_NS = 5_000_000_000
STEP_NS = 40 * MS  #: from one image to the next
GROUP = 5  #: images from one key frame to the next
CAPABILITIES = Capabilities("sim", frozenset(), (CameraInfo("front", 64, 48, 25.0, stream=H264),))


@dataclass(frozen=True)
class Unit:
    """One image of the stream."""

    number: int
    data: bytes
    key: bool
    captured_ns: int
    width: int = 64
    height: int = 48
    format: str = H264
    received_ns: int = field(default=0, kw_only=True)

    def with_data(self, data: bytes) -> Unit:
        return replace(self, data=data)


@cache
def film(count: int = 20, width: int = 64, height: int = 48, first: int = 1, seed: int = 1) -> tuple[Unit, ...]:
    """Encode a moving bar over noise, with a key frame every five images."""
    encoder = Encoder(Format("h264", width, height, 0), 25.0, 500, group=GROUP)
    picture = np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)
    units = []
    for n in range(count):
        shown = picture.copy()
        shown[:, n * 2 % width :][:, :8] = 255
        unit = encoder.encode(shown)
        assert unit is not None
        number = first + n
        units.append(Unit(number, unit.payload, unit.key, BEGIN_NS + number * STEP_NS, width, height))
    return tuple(units)


def write_film(path: Path, units: Iterable[Unit], *, closed: bool = True) -> Path:
    """Write a recording of only drone ``alpha`` with camera ``front``; a chunk every five images."""
    clock = ClockPair(BEGIN_NS, 1_760_000_000 * NS_PER_S, 1)
    translator = Translator("alpha", CAPABILITIES, clock)
    start = Start(VERSION, "test", (DroneRecord("alpha", "sim://", to_plain(CAPABILITIES)),), clock.unix_ns)
    file = RecordingFile(path, start, clock)
    for n, unit in enumerate(units):
        size = unit.width * unit.height * 3
        header = FrameHeader(
            "front",
            unit.number,
            unit.captured_ns,
            unit.captured_ns + MS,
            unit.width,
            unit.height,
            Encoding.BGR8,
            size,
        )
        at_ns = unit.received_ns or unit.captured_ns + 2 * MS
        picture = TranslatedImage(FrameRecord(header, at_ns, unit.format, unit.key), unit.data)
        for message in translator.messages(Item(0, "video.front", Rank.FRAME, at_ns, picture, len(unit.data))):
            file.write(message)
        if n % GROUP == GROUP - 1:
            file.commit()
    if closed:
        file.close(End("closed", clock.unix_ns, dict(file.written)))
    else:
        file.commit()
        file.abandon()
    return path
