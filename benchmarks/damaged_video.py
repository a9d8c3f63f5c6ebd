"""Measure how much of a video is shown after a loss of datagrams, and how much of that correctly.

The film of a real AR.Drone 2 (``ardrone2/video-8s.pave`` of the recordings, ``tests/support/recordings.py``) is sent in
three ways: in pieces of the drone's stream; re-encoded in the emulated Tello's datagrams at its bit rate; and in pieces
of an RTP packet's size to the decoder for network cameras. Each time a random fraction of the pieces is lost. For
comparison, FFmpeg's own decoder with its error concealment gets the remaining pieces, already split into frames, which
FFmpeg alone could not do as reliably. A frame counts as right if its PSNR against the undamaged one is 40 dB or more.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.drivers.h264 import Inspector
from skyloop.drivers.live_container import LiveDecoder, Piece
from skyloop.drivers.live_video import Coded
from skyloop.vehicles.ardrone.pave_decoder import av
from skyloop.vehicles.ardrone.video import PaveAssembly, PaveVideo
from skyloop.vehicles.ardrone.wire.pave import PaveFrame, PaveParser
from skyloop.vehicles.emulation.video import OneCamera
from skyloop.vehicles.tello.emulator import TelloPacker, automatic_kbps
from skyloop.vehicles.tello.video import TelloVideo
from skyloop.vehicles.tello.wire import Assembly, pieces
from tests.support.recordings import FIXTURES

LOSSES: Final = (0.01, 0.05, 0.10)
RIGHT_DB: Final = 40.0
SEGMENT: Final = 1448  #: bytes of a TCP segment or an RTP packet that fits Ethernet
FPS: Final = 30.0
CONCEALED: Final = 2
SAME_DB: Final = 99.0
_FILM: Final = FIXTURES / "ardrone2" / "video-8s.pave"

Pixels = NDArray[np.uint8]
#: Pictures by their numbers.
Shown = dict[int, Pixels]
#: The remaining pieces of each picture.
Remains = list[list[bytes]]


@dataclass(frozen=True, slots=True)
class Row:
    """The pictures shown of one stream at one rate of loss, over all seeds."""

    stream: str
    loss: float
    decoder: str
    shown: float  #: fraction of the pictures
    right: float  #: fraction of those shown
    worst_db: float  #: lowest PSNR of a picture shown [dB]


def psnr(one: Pixels, other: Pixels) -> float:
    """Return the peak signal-to-noise ratio of two pictures [dB], at most :data:`SAME_DB`."""
    error = float(np.mean((one.astype(np.float32) - other) ** 2))
    return SAME_DB if error == 0 else min(SAME_DB, 10 * float(np.log10(255**2 / error)))


def cut(data: bytes, size: int) -> list[bytes]:
    """Cut bytes into pieces of this size."""
    return [data[at : at + size] for at in range(0, len(data), size)]


def lost(stream: list[list[bytes]], share: float, seed: int) -> Remains:
    """Return the pieces of pictures that remain after losing this fraction."""
    chance = random.Random(seed)
    return [[piece for piece in picture if chance.random() >= share] for picture in stream]


# Decoders ------------------------------------------------------------------------------------------------------------


def by_ffmpeg(stream: Remains) -> Shown:
    """Decode with FFmpeg's decoder, unchanged."""
    context = av.CodecContext.create("h264", "r")
    context.thread_count = 1
    shown: Shown = {}
    for number, picture in enumerate(stream):
        packet = av.Packet(b"".join(picture))
        packet.pts = number
        try:
            images = context.decode(packet) if packet.size else []
        except (av.error.FFmpegError, ValueError):
            continue
        shown.update((image.pts, _bgr(image)) for image in images if image.pts is not None)
    return shown


def by_ardrone(stream: Remains) -> Shown:
    """Decode with the AR.Drone 2's driver."""
    assembly, decoder = PaveAssembly(0), PaveVideo()
    shown: Shown = {}
    for number, picture in enumerate(stream):
        for coded in assembly.feed(b"".join(picture), number):
            decoded = decoder.decode(coded, show=True)
            if decoded is not None:
                assert isinstance(coded.data, PaveFrame)
                shown[coded.data.number] = decoded.pixels
    first = PaveParser().feed(_FILM.read_bytes())[0].number
    return {number - first: pixels for number, pixels in shown.items()}


def by_tello(stream: Remains, concealed: int = 0) -> Shown:
    """Decode with the Tello's driver."""
    assembly, decoder = Assembly(), TelloVideo(concealed)
    shown: Shown = {}
    for number, picture in enumerate(stream):
        for piece in picture:
            for unit in assembly.feed(piece, number):
                decoded = decoder.decode(Coded(unit, unit.is_key, unit.arrived_ns, number, 0), show=True)
                if decoded is not None:
                    shown[unit.arrived_ns] = decoded.pixels
    return shown


def by_camera(stream: Remains) -> Shown:
    """Decode with the decoder of network cameras."""
    inspector, decoder = Inspector(), LiveDecoder()
    context: Any = av.CodecContext.create("h264", "r")
    shown: Shown = {}
    for number, picture in enumerate(stream):
        data = b"".join(picture)
        unit = inspector.inspect(data)
        if not data:
            continue
        packet: Any = av.Packet(data)
        decoded = decoder.decode(Coded(Piece(packet, context, number, unit), False, number, number, 0), show=True)
        if decoded is not None:
            shown[number] = decoded.pixels
    return shown


# Streams -------------------------------------------------------------------------------------------------------------


def ardrone_stream() -> tuple[list[list[bytes]], list[list[bytes]]]:
    """Return the film's pieces, picture by picture: with the drone's headers, and H.264 alone."""
    film = _FILM.read_bytes()
    starts = [at for at in range(len(film)) if film.startswith(b"PaVE", at)]
    whole = [film[start:end] for start, end in zip(starts, [*starts[1:], len(film)], strict=True)]
    return [cut(each, SEGMENT) for each in whole], [cut(each.payload, SEGMENT) for each in PaveParser().feed(film)]


def tello_stream(kbps: int) -> list[list[bytes]]:
    """Return the film as sent by the emulated Tello at this bit rate, in its datagrams, picture by picture."""
    packer, settings = TelloPacker(), OneCamera("front", FPS, kbps)
    packed = [packer.pack(pixels, settings, 0) for pixels in film_pictures()]
    return [pieces(each.data) for each in packed if each is not None]


def film_pictures() -> Iterator[Pixels]:
    """Yield the film's pictures."""
    shown = by_ffmpeg([[each.payload] for each in PaveParser().feed(_FILM.read_bytes())])
    yield from (shown[number] for number in sorted(shown))


# Measuring -----------------------------------------------------------------------------------------------------------


def measured(
    name: str, decoder: str, decode: Callable[[Remains], Shown], damaged: list[Remains], right: Shown, loss: float
) -> Row:
    """Decode each of the damaged streams, and compare with the undamaged one."""
    ratios = [
        psnr(pixels, right[number])
        for stream in damaged
        for number, pixels in decode(stream).items()
        if pixels.shape == right[number].shape
    ]
    total = len(right) * len(damaged)
    good = sum(ratio >= RIGHT_DB for ratio in ratios)
    return Row(name, loss, decoder, len(ratios) / total, good / max(1, len(ratios)), min(ratios, default=0.0))


def run(losses: tuple[float, ...], seeds: int) -> Iterator[Row]:
    """Measure every stream, loss and decoder."""
    framed, bare = ardrone_stream()
    right = by_ffmpeg(bare)
    for loss in losses:
        numbers = range(seeds)
        ours, theirs = ([lost(stream, loss, seed) for seed in numbers] for stream in (framed, bare))
        yield measured("AR.Drone 2", "Skyloop", by_ardrone, ours, right, loss)
        yield measured("AR.Drone 2", "FFmpeg", by_ffmpeg, theirs, right, loss)
        yield measured("the same over RTP", "Skyloop", by_camera, theirs, right, loss)
        sent = tello_stream(automatic_kbps(loss))
        damaged, undamaged = [lost(sent, loss, seed) for seed in numbers], by_ffmpeg(sent)
        name = f"Tello, {automatic_kbps(loss) / 1000:g} Mbit/s"
        yield measured(name, "Skyloop", by_tello, damaged, undamaged, loss)
        concealing = partial(by_tello, concealed=CONCEALED)
        yield measured(name, f"Skyloop, concealed={CONCEALED}", concealing, damaged, undamaged, loss)
        yield measured(name, "FFmpeg", by_ffmpeg, damaged, undamaged, loss)


def table(rows: list[Row]) -> str:
    """Return the rows as a table in Markdown."""
    lines = ["| stream | lost | decoder | shown | of them right | worst |", "|---|---|---|---|---|---|"]
    for row in rows:
        worst = "identical" if row.worst_db >= SAME_DB else f"{row.worst_db:.0f} dB"
        shares = f"{100 * row.shown:.1f} % | {100 * row.right:.1f} %"
        lines.append(f"| {row.stream} | {100 * row.loss:g} % | {row.decoder} | {shares} | {worst} |")
    return "\n".join(lines)


def _bgr(image: av.VideoFrame) -> Pixels:
    return np.asarray(image.to_ndarray(format="bgr24"), np.uint8)


def main() -> None:
    """Measure, print a table, and write it if requested."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.damaged_video", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="runs with each loss [default: 10]")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="folder for damaged_video.json")
    given = parser.parse_args()
    if not _FILM.is_file():
        raise SystemExit(f"there is no {_FILM}: set SKYLOOP_FIXTURES to the folder of the recordings")
    rows = list(run(LOSSES, given.seeds))
    print(table(rows))
    if given.output is not None:
        given.output.mkdir(parents=True, exist_ok=True)
        (given.output / "damaged_video.json").write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
