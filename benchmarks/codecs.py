"""Measure the processor time of the AR.Drones' video and navdata on one core: ``python -m benchmarks.codecs``.

Measured in a process limited to one core from its start, because libraries start a thread for each core they find.
Counts processor time, without that of other programs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import msgspec
import numpy as np

from benchmarks.measuring.contract import Image, picture
from benchmarks.measuring.schedule import SMALL
from benchmarks.measuring.workers import STARTS_WITHIN_S, Workers
from benchmarks.one_core import codecs_on_one_core
from skyloop.bench import BenchFlight, Machine, Spread, rounds, spread
from skyloop.drivers.live_video import Coded
from skyloop.errors import MissingExtraError
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vehicles.ardrone.emulator.video import H264_360P
from skyloop.vehicles.ardrone.emulator.video import encode as encode_uvlc
from skyloop.vehicles.ardrone.video import PaveVideo
from skyloop.vehicles.ardrone.wire import navdata
from skyloop.vehicles.ardrone.wire.navdata import LAYOUTS
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, PaveFrame
from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder
from skyloop.vehicles.emulation.video import GROUP, Encoder

UVLC_PER_S: Final = 15.0  #: target: the frame rate of an AR.Drone 1
PICTURES: Final = 2 * GROUP  #: two groups of H.264 pictures, each with a key frame
UVLC_PICTURES: Final = 6  #: each is independent of the others
BITRATE_KBPS: Final = 4000  #: of H.264, the maximum requested from the drone
FPS: Final = 30.0

Work = Callable[[], object]


class CodecRow(msgspec.Struct, frozen=True):
    """One kind of work. ``once``: processor time for one picture or datagram."""

    what: str
    of: str
    size: int  #: mean encoded size [bytes]
    once: Spread
    per_s: float  #: on one core
    target: float | None = None


class CodecResults(msgspec.Struct, frozen=True):
    """A whole run."""

    machine: Machine
    rows: list[CodecRow]
    skipped: dict[str, str]  #: reasons for omitted parts


Progress = Callable[[float], None]


def measure(seconds: float, progress: Progress = lambda _: None) -> CodecResults:
    """Measure in a separate process, on one core.

    Args:
        seconds: Approximate duration, plus the time for drawing the pictures [s].
        progress: Called with the fraction done, 0 to 1.
    """
    machine = Machine.here()  # with all its cores
    with Workers() as workers:
        worker = workers.start(codecs_on_one_core, seconds)
        while not isinstance(told := worker.answer(seconds + STARTS_WITHIN_S), CodecResults):
            progress(told)
    return msgspec.structs.replace(told, machine=machine)


def measure_here(seconds: float, progress: Progress = lambda _: None) -> CodecResults:
    """Measure in this process, with its cores.

    Args:
        seconds: Approximate duration, plus the time for drawing the pictures [s].
        progress: Called with the fraction done, 0 to 1.
    """
    rows: list[CodecRow] = []
    skipped: dict[str, str] = {}
    small, large = rendered(PICTURES)
    share_s = seconds / 6

    def add(what: str, of: str, sizes: Sequence[int], work: Sequence[Work], target: float | None = None) -> None:
        begun = len(rows) / 6
        times = timed(work, share_s, lambda share: progress(begun + share / 6))
        rate = len(times) / (sum(times) * 1e-9)
        rows.append(CodecRow(what, of, round(float(np.mean(sizes))), spread(times), rate, target))

    for kind, pictures in (("a rendered picture", small[:UVLC_PICTURES]), ("noise", [picture(SMALL)])):
        packets = [encode_uvlc(image, number) for number, image in enumerate(pictures, 1)]
        sizes = [len(packet) for packet in packets]
        title = f"{kind}, {SMALL}"
        add("UVLC, encode", title, sizes, [partial(encode_uvlc, image, 1) for image in pictures], UVLC_PER_S)
        decode = UvlcDecoder().decode
        add("UVLC, decode to BGR", title, sizes, [partial(decode, packet) for packet in packets], UVLC_PER_S)
    try:
        stream = h264(large)
        title = f"a rendered picture, {H264_360P.width}×{H264_360P.height}"
        # The first may follow the last, because it is a key frame.
        show = partial(PaveVideo().decode, show=True)
        come = [Coded(frame, frame.is_key, 0, 0, 0) for frame in stream]
        add("H.264, decode to BGR", title, [len(f.payload) for f in stream], [partial(show, one) for one in come])
    except MissingExtraError as error:
        skipped["H.264"] = str(error)
    datagram = full_navdata()
    add("navdata, decode", f"all {len(LAYOUTS)} options", [len(datagram)], [partial(navdata.decode, datagram)])
    return CodecResults(Machine.here(), rows, skipped)


def timed(work: Sequence[Work], seconds: float, progress: Progress) -> list[int]:
    """Return the processor time of each call [ns], repeating all the work in order."""
    work[0]()  # the first call creates tables and buffers
    times = []
    for _ in rounds(seconds, progress):
        for call in work:
            begin = time.process_time_ns()
            call()
            times.append(time.process_time_ns() - begin)
    return times


def rendered(number: int) -> tuple[list[Image], list[Image]]:
    """Return pictures of a circling drone's front camera, 320×240, and others twice as wide."""
    flight = BenchFlight(1, [(0, FRONT_CAMERA), (0, FRONT_CAMERA.scaled(2.0))])

    def draw(at: int) -> Image:
        flight.draw(at)
        return flight.picture.copy()

    pairs = [(draw(0), draw(1)) for _ in range(number)]
    return [small for small, _ in pairs], [large for _, large in pairs]


def h264(pictures: Sequence[Image]) -> list[PaveFrame]:
    """Encode pictures like an AR.Drone 2.

    Raises:
        MissingExtraError: PyAV is not installed.
    """
    encoder = Encoder(H264_360P, FPS, BITRATE_KBPS)
    form = H264_360P
    frames = []
    for number, image in enumerate(pictures, 1):
        encoded = encoder.encode(image[: image.shape[1] * form.height // form.width])
        assert encoded is not None  # without delay, each picture yields a frame at once
        kind = FrameType.IDR if encoded.key else FrameType.P
        stamp_ms = round(number * 1e3 / FPS)
        frames.append(
            PaveFrame(
                Codec.MPEG4_AVC, kind, number, stamp_ms, form.width, form.height, form.stream_id, encoded.payload, False
            )
        )
    return frames


def full_navdata() -> bytes:
    """Return a datagram with every known option."""
    return navdata.encode(navdata.State.FLYING, 1, [kind() for kind in LAYOUTS])


if __name__ == "__main__":
    from benchmarks.command import main

    main("codecs")
