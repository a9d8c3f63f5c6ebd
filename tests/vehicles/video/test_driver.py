"""``video://``: files played in order and on time, devices, and files that are invalid."""

from __future__ import annotations

import os
import random
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np
import pytest

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.errors import FileFormatError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import Hover, LinkState
from skyloop.pyav import new_decoder
from skyloop.vehicles.ardrone.wire.pave import PaveParser
from skyloop.vehicles.video.v4l2 import cameras, described
from tests.support.recordings import recorded
from tests.support.systems import STEP_NS, only_on

LONG, TORN = "ardrone2/video-8s.pave", "ardrone2/video-64-byte-headers.pave"
FAST = "speed=1000"
FRAMES = 24


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip of 24 grey images, 64×48 at 25 a second; image n has brightness 40 + 8 n."""
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.bit_rate = 2_000_000
        for n in range(FRAMES):
            picture = np.full((48, 64, 3), 40 + 8 * n, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    return path


@contextmanager
def playing(uri: str, sink: RecordingSink) -> Iterator[Driver]:
    driver = make_driver(uri)
    driver.open(sink)
    try:
        yield driver
    finally:
        driver.close()
    assert not sink.problems


def play(uri: str, *, keep_pixels: bool = False, timeout_s: float = 20.0) -> RecordingSink:
    """Play a whole recording."""
    sink = RecordingSink(keep_pixels=keep_pixels)
    with playing(uri, sink):
        ended = sink.wait(lambda: sink.link_state in (LinkState.CLOSED, LinkState.LOST), timeout_s)
        assert ended, sink.links
    return sink


# Recordings ------------------------------------------------------------------------------------------------------


def test_all_240_images_of_a_real_drone_arrive_in_order() -> None:
    sink = play(f"video://{recorded(LONG)}?{FAST}")
    assert sink.frame_counts == {"front": 240}
    assert sink.links == [(LinkState.UP, ""), (LinkState.CLOSED, "end of the recording after 240 frames")]
    assert {(frame.width, frame.height, frame.intrinsics) for frame in sink.frames} == {(640, 360, None)}
    newest = sink.newest
    assert newest is not None
    assert newest.native is not None
    assert (newest.native["video.frames"], newest.native["video.damaged"]) == (240, 0)


def test_encoded_images_of_a_real_drone_are_passed_on_unchanged() -> None:
    sink = RecordingSink(watch=set(), record=True)  # starts it without viewers
    with playing(f"video://{recorded(LONG)}?{FAST}", sink) as driver:
        assert [camera.stream for camera in driver.capabilities().cameras] == ["h264"]
        assert sink.wait(lambda: len(sink.pictures) == 240, 20.0)
    sent = PaveParser().feed(recorded(LONG).read_bytes())
    assert [(seen.data, seen.key) for seen in sink.pictures] == [(frame.payload, frame.is_key) for frame in sent]
    assert not sink.frames


def test_a_late_subscriber_gets_images_from_the_next_key_frame_on() -> None:
    sink = RecordingSink(keep_pixels=False)
    with playing(f"video://{recorded(LONG)}?speed=20&fx=500", sink):
        assert sink.wait(lambda: sink.frame_counts["front"] > 3, 20.0)
        sink.record = True
        assert sink.wait(lambda: len(sink.pictures) > 20, 20.0)
    times = {frame.captured_ns: frame.intrinsics for frame in sink.frames}
    assert all(times[seen.captured_ns] == seen.intrinsics for seen in sink.pictures if seen.captured_ns in times)
    assert sink.pictures[0].key


def test_a_clip_of_another_codec_has_no_stream(clip: Path) -> None:
    assert [camera.stream for camera in make_driver(f"video://{clip}").capabilities().cameras] == [""]


def h264_clip(path: Path, b_frames: int) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.max_b_frames = b_frames
        stream.options = {"x264-params": "keyint=8:scenecut=0:b-adapt=0"}
        for n in range(FRAMES):
            picture = np.full((48, 64, 3), 40 + 8 * n, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    return path


def test_h264_in_a_file_is_passed_on_with_its_frame_times(tmp_path: Path) -> None:
    path = h264_clip(tmp_path / "clip.mp4", 0)
    assert [camera.stream for camera in make_driver(f"video://{path}").capabilities().cameras] == ["h264"]
    sink = RecordingSink(record=True)
    with playing(f"video://{path}?speed=20&loop=1", sink):
        assert sink.wait(lambda: len(sink.pictures) >= 2 * FRAMES, 20.0)
    pictures = list(sink.pictures)[: 2 * FRAMES]
    context = new_decoder("h264", "a test")
    decoded = [image for picture in pictures for image in context.decode(av.Packet(picture.data))]
    assert len(decoded) == len(pictures)
    assert [n for n, picture in enumerate(pictures) if picture.key][:4] == [0, 8, 16, 24]
    assert {(picture.width, picture.height) for picture in pictures} == {(64, 48)}
    frames = [frame.captured_ns for frame in sink.frames]
    assert [picture.captured_ns for picture in pictures[:FRAMES]] == frames[:FRAMES]


def test_h264_with_b_frames_has_no_stream_and_plays(tmp_path: Path) -> None:
    path = h264_clip(tmp_path / "clip.mp4", 2)
    assert [camera.stream for camera in make_driver(f"video://{path}").capabilities().cameras] == [""]
    sink = play(f"video://{path}?{FAST}")
    assert sink.frame_counts == {"front": FRAMES}


def test_a_torn_start_is_skipped() -> None:
    sink = play(f"video://{recorded(TORN)}?{FAST}", keep_pixels=True)
    assert sink.frame_counts == {"front": 17}
    assert sink.frames[0].pixels.std() > 20  # an image, not the grey of a decoder without its key frame


def test_images_arrive_at_the_times_of_their_stamps() -> None:
    begun_ns = monotonic_ns()
    sink = play(f"video://{recorded(TORN)}?camera=nose")
    took_s = (monotonic_ns() - begun_ns) / 1e9
    captured = np.array([frame.captured_ns for frame in sink.frames])
    stamps_ms = np.array([248, 271, 303])  # of the header, less 1792577000: see the parser's test
    assert sink.frame_counts == {"nose": 17}
    np.testing.assert_allclose(np.diff(captured[:3]) / 1e6, np.diff(stamps_ms))
    assert 0.4 < (captured[-1] - captured[0]) / 1e9 < 0.6
    assert took_s > 0.4
    late = np.array([frame.arrived_ns - frame.captured_ns for frame in sink.frames]) / 1e9
    assert (late >= 0).all()
    assert np.median(late) < 0.02 + STEP_NS / 1e9


def test_a_clip_plays_in_order_with_its_intrinsics(clip: Path) -> None:
    sink = play(f"video://{clip}?{FAST}&fx=50&cx=30&distortion=0.1,0,0,0", keep_pixels=True)
    brightness = [int(frame.pixels.mean()) for frame in sink.frames]
    assert brightness == pytest.approx([40 + 8 * n for n in range(FRAMES)], abs=4)
    intrinsics = sink.frames[0].intrinsics
    assert intrinsics is not None
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (50, 50, 30, 23.5)
    assert intrinsics.distortion == (0.1, 0, 0, 0)


def test_the_capabilities_have_the_size_before_it_is_opened(clip: Path) -> None:
    capabilities = make_driver(f"video://{clip}?fx=50").capabilities()
    camera = capabilities.cameras[0]
    assert (camera.name, camera.width, camera.height, camera.fps) == ("front", 64, 48, 25)
    assert camera.intrinsics is not None
    assert not capabilities.actions
    assert "not a vehicle" in capabilities.why_not


def test_it_accepts_no_command_and_is_always_safe(clip: Path) -> None:
    with playing(f"video://{clip}", RecordingSink()) as driver:
        with pytest.raises(UsageError, match="video does not support hover"):
            driver.apply(Hover())
        assert driver.failsafe(Hover())


def test_it_starts_with_a_viewer(clip: Path) -> None:
    sink = RecordingSink(watch=set())
    with playing(f"video://{clip}?{FAST}", sink):
        assert sink.wait(lambda: sink.feedback_count >= 3, 5.0)
        assert not sink.frame_counts
        sink.watch = None
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, 5.0)
    assert sink.frame_counts == {"front": FRAMES}


def test_without_wait_it_plays_without_viewers(clip: Path) -> None:
    sink = RecordingSink(watch=set())
    with playing(f"video://{clip}?{FAST}&wait=0", sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, 5.0)
    assert not sink.frame_counts


def test_a_loop_starts_over(clip: Path) -> None:
    sink = RecordingSink(keep_pixels=False)
    with playing(f"video://{clip}?{FAST}&loop=1", sink):
        assert sink.wait(lambda: sink.frame_counts["front"] > 3 * FRAMES, 10.0)
    assert [state for state, _ in sink.links] == [LinkState.UP]


def test_a_loop_whose_file_is_gone_is_reported(clip: Path, tmp_path: Path) -> None:
    copy = tmp_path / "gone.mp4"
    copy.write_bytes(clip.read_bytes())
    sink = RecordingSink(watch=set())
    with playing(f"video://{copy}?{FAST}&loop=1", sink):
        assert sink.wait(lambda: sink.link_state is LinkState.UP, 5.0)
        copy.unlink()
        sink.watch = None
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 5.0)
    assert "cannot start over" in sink.links[-1][1]


def test_numbered_images_play_as_well(tmp_path: Path) -> None:
    for n in range(5):
        with av.open(str(tmp_path / f"shot{n:03}.png"), "w", format="image2", options={"update": "1"}) as container:
            stream = container.add_stream("png", rate=1)
            stream.width, stream.height, stream.pix_fmt = 32, 24, "rgb24"
            picture = av.VideoFrame.from_ndarray(np.full((24, 32, 3), 50 * n, np.uint8), format="bgr24")
            container.mux(stream.encode(picture.reformat(format="rgb24")))
            container.mux(stream.encode(None))
    sink = play(f"video://{tmp_path}/shot%25003d.png?{FAST}", keep_pixels=True)
    assert [int(frame.pixels.mean()) for frame in sink.frames] == [0, 50, 100, 150, 200]


# Invalid addresses and files -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("sped=2", "no option of video:// named 'sped'; did you mean 'speed'"),
        ("speed=0", "option speed is '0' and must be a number from 0.01"),
        ("width=320", "only a device or a stream has width"),
        ("cx=3", "option cx also needs fx"),
        ("fx=0", "option fx is '0'"),
        ("fx=9&fy=0", "option fy is '0'"),
        ("fx=9&distortion=1,2", "must be 4, 5 or 8 numbers"),
        ("loop=maybe", "must be true or false"),
    ],
)
def test_bad_options_are_refused(query: str, message: str) -> None:
    with pytest.raises((UsageError, UnknownNameError), match=message):
        make_driver(f"video:///tmp/x.mp4?{query}")


def test_an_address_without_a_file_is_refused() -> None:
    with pytest.raises(UsageError, match="names neither a file nor a camera"):
        make_driver("video://")


def _text(folder: Path) -> Path:
    path = folder / "notes.mp4"
    path.write_text("this is no video at all\n" * 50)
    return path


def _empty(folder: Path) -> Path:
    path = folder / "empty.mkv"
    path.touch()
    return path


def _no_pave(folder: Path) -> Path:
    path = folder / "noise.pave"
    path.write_bytes(random.Random(1).randbytes(20_000))
    return path


def _sound(folder: Path) -> Path:
    path = folder / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        samples.sample_rate = 8000
        container.mux(stream.encode(samples))
    return path


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda folder: folder / "missing.mp4", UsageError, "missing.mp4: No such file"),
        (lambda folder: folder, UsageError, "Is a directory"),
        (lambda folder: folder / "shot%2503d.png", UsageError, "shot%03d.png cannot be opened"),
        (_text, FileFormatError, "notes.mp4 cannot be opened as a video"),
        (_empty, FileFormatError, "empty.mkv cannot be opened as a video"),
        (_no_pave, FileFormatError, "noise.pave contains no PaVE frame"),
        (_sound, FileFormatError, "sound.wav contains no video stream"),
    ],
)
def test_a_bad_file_is_reported_on_opening(
    tmp_path: Path, make: Callable[[Path], Path], error: type[Exception], message: str
) -> None:
    driver = make_driver(f"video://{make(tmp_path)}")
    assert driver.capabilities().cameras[0].name == "front"  # asking for capabilities raises nothing
    with pytest.raises(error, match=message):
        driver.open(RecordingSink())
    driver.close()


def test_without_pyav_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [
        name
        for name in sys.modules
        if name.startswith(("skyloop.vehicles.video", "skyloop.vehicles.ardrone.pave_decoder", "av."))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install video"):
        make_driver("video:///tmp/x.mp4")


# Damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_truncated_stream_plays_to_its_end(tmp_path: Path, share: float) -> None:
    whole = recorded(LONG).read_bytes()
    path = tmp_path / "cut.pave"
    path.write_bytes(whole[: int(len(whole) * share)])
    sink = play(f"video://{path}?{FAST}")
    assert sink.frame_counts["front"] == pytest.approx(240 * share, abs=12)
    assert sink.link_state is LinkState.CLOSED


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", [TORN, "clip.mp4"])
def test_flipped_bits_cause_no_error(tmp_path: Path, clip: Path, name: str, seed: int) -> None:
    data = bytearray((clip if name == "clip.mp4" else recorded(name)).read_bytes())
    chance = random.Random(seed)
    for _ in range(12):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    path = tmp_path / Path(name).name
    path.write_bytes(data)
    try:
        sink = play(f"video://{path}?{FAST}")
    except FileFormatError:
        return  # too damaged to open: clearly reported
    assert sink.link_state in (LinkState.CLOSED, LinkState.LOST)
    assert not [event for event in sink.events if event.kind == "driver_error"]


def test_damaged_images_are_dropped_up_to_the_next_key_frame(tmp_path: Path) -> None:
    data = bytearray(recorded(LONG).read_bytes())
    at = data.find(b"PaVE", 20_000)
    data[at : at + 4] = b"xxxx"  # the header of the sixth frame or so
    path = tmp_path / "hole.pave"
    path.write_bytes(data)
    sink = play(f"video://{path}?{FAST}")
    assert 225 < sink.frame_counts["front"] < 238


def test_a_stream_without_a_key_frame_shows_nothing_and_reports_that(tmp_path: Path) -> None:
    torn = recorded(TORN).read_bytes()
    path = tmp_path / "headless.pave"
    path.write_bytes(torn[:7431])  # the stale frame and the two P frames after it
    sink = play(f"video://{path}?{FAST}")
    assert not sink.frame_counts
    assert sink.links[-1] == (LinkState.LOST, "no image of the recording can be decoded")


# Devices ---------------------------------------------------------------------------------------------------------


def test_a_missing_device_is_not_an_error() -> None:
    sink = RecordingSink()
    with playing("video:///dev/skyloop-no-such-camera?width=320&height=240&fps=15", sink) as driver:
        camera = driver.capabilities().cameras[0]
        assert (camera.width, camera.height, camera.fps, camera.stream) == (320, 240, 15, "")
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 5.0)
    assert [state for state, _ in sink.links] == [LinkState.CONNECTING, LinkState.LOST]
    why = f"there is no such device; {described(cameras())}"
    assert sink.links[-1][1] == f"/dev/skyloop-no-such-camera: {why}"
    assert not sink.events


def test_a_file_that_is_not_a_camera_is_reported() -> None:
    sink = RecordingSink()
    with playing("video:///dev/null?exposure=10&gain=3", sink):
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 5.0)
    assert "/dev/null: " in sink.links[-1][1]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A pipe below /dev to read raw images from, with the options that a camera needs."""
    if not Path("/dev/shm").is_dir():
        pytest.skip("a file that looks like a device needs /dev/shm")
    monkeypatch.setattr("skyloop.drivers.live_camera.DEVICE_FORMAT", "rawvideo")
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="skyloop-") as folder:
        yield Path(folder) / "video0"


@only_on("linux", reason="cameras have no nodes there")
def test_a_device_that_disappears_is_reopened_with_exposure_and_gain(device: Path) -> None:
    sink = RecordingSink()
    asked = f"video://{device}?width=64&height=48&fps=25&exposure=8&gain=auto"
    with playing(asked, sink):
        for _ in range(2):
            wanted = sink.frame_counts["front"] + 10
            os.mkfifo(device)
            with device.open("wb", buffering=0) as pipe:
                begun = monotonic_ns()
                while sink.frame_counts["front"] < wanted:
                    pipe.write(bytes(64 * 48 * 3 // 2))
                    assert monotonic_ns() - begun < 20e9, sink.links
                    time.sleep(0.02)
            device.unlink()
            assert sink.wait(lambda: sink.link_state is LinkState.LOST, 20.0)
        newest = sink.newest
    states = [state for state, _ in sink.links]
    assert states.count(LinkState.UP) == 2
    assert newest is not None
    assert newest.native is not None
    assert int(str(newest.native["camera.received"])) >= 10
    # A pipe is no Video4Linux device: each refused setting is reported once.
    assert [event.text.split(":")[0] for event in sink.events] == ["camera"] * 2
    assert any("exposure" in event.text for event in sink.events)
    assert any("gain" in event.text for event in sink.events)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("video:///dev/video0?loop=1", "loop and speed apply only to files, not to live cameras"),
        ("video:///dev/video0?speed=2", "loop and speed apply only to files, not to live cameras"),
        ("video:///tmp/x.mp4?gain=3", "only a device has gain"),
        ("video://rtp://:5600?format=mjpeg", "only a device has format"),
        ("video:///dev/video0?format=png", "format of video:// named 'png'"),
        ("video:///dev/video0?exposure=0", "option exposure is '0'"),
        ("video:///dev/video0?gain=0.5", "option gain is 0.5 and must be a whole number"),
        ("video://ftp://here", "must be one of rtsp://…"),
        ("video://rtsp:///live", "names no host"),
    ],
)
def test_unsuitable_options_are_refused(uri: str, message: str) -> None:
    with pytest.raises((UsageError, UnknownNameError), match=message):
        make_driver(uri)


def test_an_h264_source_announces_a_stream() -> None:
    for uri, stream in {
        "video://rtsp://user:secret@camera/live": "h264",
        "video://rtp://:5600": "h264",
        "video:///dev/video0?format=h264": "h264",
        "video:///dev/video0?format=mjpeg": "",
        "video://rtp://:5600?stream=0": "",
    }.items():
        capabilities = make_driver(uri).capabilities()
        assert [camera.stream for camera in capabilities.cameras] == [stream]
        assert "secret" not in capabilities.description


@pytest.mark.parametrize(("turned", "matrix"), [("clockwise", (0, 1, -1, 0)), ("upside down", (-1, 0, 0, -1))])
def test_a_phone_s_portrait_video_is_upright(tmp_path: Path, turned: str, matrix: tuple[int, int, int, int]) -> None:
    """The sensor lies on its side; the container stores the rotation."""
    path = tmp_path / "phone.mp4"
    picture = np.full((48, 64, 3), 40, np.uint8)
    picture[:24, :32] = 220  # the top left corner of the stored image
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44  # ISO 14496-12: a, b, u, c, d, v, x, y, w in 16.16, u, v and w in 2.30
    a, b, c, d = (one << 16 for one in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    sink = play(f"video://{path}?{FAST}", keep_pixels=True)
    seen = sink.frames[-1].pixels
    if turned == "clockwise":
        assert seen.shape == (64, 48, 3)
        assert seen[10, 40].mean() > 180, "its bright corner is now at the top right"
        assert seen[10, 8].mean() < 80
    else:
        assert seen.shape == (48, 64, 3)
        assert seen[40, 56].mean() > 180
    (camera,) = make_driver(f"video://{path}").capabilities().cameras
    assert (camera.height, camera.width) == seen.shape[:2]
    assert camera.stream == "", "the stored images lie on their side"
