"""Cameras played by GStreamer, as in PX4's simulation, on Jetsons and companion computers: RTSP, RTP and MPEG-TS.

They need Debian's gstreamer1.0-tools, -plugins-base, -good, -bad and -ugly, and for RTSP python3-gi and
gir1.2-gst-rtsp-server-1.0; without these they are skipped.
"""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.messages import LinkState
from skyloop.pyav import new_decoder
from tests.support.rtsp_server import HOST, free_port

av = pytest.importorskip("av")
pytestmark = pytest.mark.process

WIDTH, HEIGHT = 320, 240
SOURCE = f"videotestsrc is-live=true pattern=ball ! video/x-raw,width={WIDTH},height={HEIGHT},framerate=30/1"
ENCODER = "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 bitrate=800"
PATIENCE_S = 30.0
SERVER = Path(__file__).parent / "gst_rtsp_server.py"


@functools.cache
def launcher() -> str:
    """Return ``gst-launch-1.0`` if it has the tests' plugins; else skip."""
    program, inspect = shutil.which("gst-launch-1.0"), shutil.which("gst-inspect-1.0")
    if program is None or inspect is None:
        pytest.skip("needs GStreamer: apt install gstreamer1.0-tools gstreamer1.0-plugins-{base,good,bad,ugly}")
    for element in ("videotestsrc", "x264enc", "h264parse", "rtph264pay", "mpegtsmux", "udpsink"):
        if subprocess.run([inspect, "--exists", element], capture_output=True, check=False).returncode:
            pytest.skip(f"GStreamer has no {element}: apt install gstreamer1.0-plugins-{{base,good,bad,ugly}}")
    return program


@functools.cache
def python_with_bindings() -> str:
    """Return a Python with GStreamer's RTSP server; else skip."""
    needed = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
    for program in dict.fromkeys((sys.executable, "/usr/bin/python3")):
        if (
            Path(program).exists()
            and not subprocess.run([program, "-c", needed], capture_output=True, check=False).returncode
        ):
            return program
    pytest.skip("needs GStreamer's RTSP server: apt install python3-gi gir1.2-gst-rtsp-server-1.0")


@contextmanager
def running(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def serving(port: int, way: str, encoder: str = ENCODER) -> Iterator[int]:
    """Run GStreamer's RTSP server, killed at the end. Yields its port."""
    launcher()
    pipeline = f"{SOURCE} ! {encoder} ! rtph264pay name=pay0 pt=96"
    with running([python_with_bindings(), str(SERVER), str(port), way, pipeline]) as process:
        assert process.stdout is not None
        yield int(process.stdout.readline())


@contextmanager
def watching(address: str) -> Iterator[RecordingSink]:
    sink = RecordingSink(record=True)
    driver = make_driver(f"video://{address}?width={WIDTH}&height={HEIGHT}&fps=30")
    driver.open(sink)
    try:
        yield sink
    finally:
        driver.close()
    assert not sink.problems


def told(sink: RecordingSink) -> object:
    return sink.links, list(sink.events)


def comes(sink: RecordingSink, count: int = 45) -> None:
    """Check that this many frames and images arrive, decode, and have the same times."""
    pictures, frames = len(sink.pictures) + count, sink.frame_counts["front"] + count
    assert sink.wait(lambda: len(sink.pictures) >= pictures and sink.frame_counts["front"] >= frames, PATIENCE_S), told(
        sink
    )
    taken, shown = list(sink.pictures), list(sink.frames)  # more arrive meanwhile
    assert taken[0].key
    assert {(picture.width, picture.height) for picture in taken} == {(WIDTH, HEIGHT)}
    assert {(frame.width, frame.height) for frame in shown} == {(WIDTH, HEIGHT)}
    assert min(frame.pixels.std() for frame in shown) > 10  # the white ball on black
    times = {frame.captured_ns for frame in shown}
    shared = sum(picture.captured_ns in times for picture in taken)
    assert shared > count // 2
    context = new_decoder("h264", "a test")
    begin = max(n for n, picture in enumerate(taken) if picture.key)
    decoded = [image for picture in taken[begin:] for image in context.decode(av.Packet(picture.data))]
    assert len(decoded) == len(taken) - begin


@pytest.mark.parametrize("way", ["tcp", "udp"])
def test_gstreamers_rtsp_server_is_seen_killed_and_found_again(way: str) -> None:
    with ExitStack() as after:
        with serving(0, way) as port:
            sink = after.enter_context(watching(f"rtsp://{HOST}:{port}/live"))
            comes(sink)
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S), told(sink)
        with serving(port, way):
            comes(sink)
            assert sink.link_state is LinkState.UP


def test_rtp_over_udp_as_px4_sends_it() -> None:
    port = free_port()
    sender = (
        f"{launcher()} -q {SOURCE} ! {ENCODER} ! rtph264pay config-interval=1 pt=96 ! udpsink host={HOST} port={port}"
    )
    with watching(f"rtp://{HOST}:{port}") as sink:
        with running(sender.split()):
            comes(sink)
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S), told(sink)
        with running(sender.split()):
            comes(sink)


def test_a_transport_stream_over_udp() -> None:
    port = free_port()
    sender = f"{launcher()} -q {SOURCE} ! {ENCODER} ! h264parse config-interval=1 ! mpegtsmux alignment=7"
    with running(f"{sender} ! udpsink host={HOST} port={port}".split()), watching(f"udp://{HOST}:{port}") as sink:
        comes(sink)


def test_a_sender_with_b_frames_is_shown_but_not_passed_on() -> None:
    port = free_port()
    encoder = "x264enc speed-preset=veryfast bframes=2 b-adapt=false key-int-max=15 bitrate=800"
    sender = f"{launcher()} -q {SOURCE} ! {encoder} ! rtph264pay config-interval=1 ! udpsink host={HOST} port={port}"
    with running(sender.split()), watching(f"rtp://{HOST}:{port}") as sink:
        assert sink.wait(lambda: sink.frame_counts["front"] > 20, PATIENCE_S), told(sink)
        assert sink.wait(lambda: any("B-frames" in event.text for event in sink.events), PATIENCE_S), told(sink)
        times = [frame.captured_ns for frame in list(sink.frames)]
    assert times == sorted(times)
    assert len(sink.pictures) <= 2  # before the first B-frame
