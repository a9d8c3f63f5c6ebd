"""MP4 by copying: the video shows the recorded images bit by bit, and nothing undecodable is copied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.drivers.h264 import START, unit_type, units
from skyloop.errors import FileFormatError, UsageError
from skyloop.recording.reader import Recording
from skyloop.recording.review import video as copying
from skyloop.recording.review.video import Videos, contents, export_mp4, numbered
from tests.recording.streams import GROUP, STEP_NS, Unit, film, write_film
from tests.support.commands import Ended

Image = NDArray[np.uint8]
STEP_S = STEP_NS / 1e9


def exported(folder: Path, stream: Sequence[Unit], **options: Any) -> Videos:
    path = write_film(folder / "flight.mcap", stream)
    return export_mp4(Recording.open(path), "alpha", "front", folder / "front.mp4", **options)


def shown(path: Path) -> dict[int, Image]:
    """Return a video's images by number of recording steps after the first."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        times = [float(frame.pts * frame.time_base) / STEP_S for frame in frames]  # type: ignore[operator]
        assert times == pytest.approx([round(time) for time in times], abs=1e-3)
        images = [np.asarray(frame.to_ndarray(format="bgr24"), np.uint8) for frame in frames]
        return dict(zip(map(round, times), images, strict=True))


def recorded(folder: Path) -> dict[int, Image]:
    """Return the recording's decodable images by number."""
    pictures = Recording.open(folder / "flight.mcap").pictures("alpha", "front")
    return {picture.header.seq: picture.pixels() for picture in pictures if picture.can_be_decoded}


def assert_shows(path: Path, expected: dict[int, Image]) -> None:
    """Assert that the video shows these images, counted from the first one's number."""
    found, first = shown(path), min(expected)
    assert {first + number for number in found} == set(expected)
    assert all(np.array_equal(image, expected[first + number]) for number, image in found.items())


# Copying -------------------------------------------------------------------------------------------------------------


def test_every_image_is_shown_as_recorded_at_its_time(tmp_path: Path) -> None:
    found = exported(tmp_path, film())
    assert (found.frames, found.left_out) == (20, 0)
    (video,) = found.videos
    assert (video.path, video.width, video.height, video.copied, video.begin_s) == (
        tmp_path / "front.mp4",
        64,
        48,
        True,
        0.0,
    )
    assert_shows(video.path, recorded(tmp_path))
    with av.open(str(video.path)) as container:
        assert container.streams.video[0].codec_context.codec_tag == "avc1"
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert [packet.is_keyframe for packet in packets] == [unit.key for unit in film()]
    assert packets[-1].duration == pytest.approx(1 / 30 / float(packets[-1].time_base), rel=0.01)


def test_a_gap_shows_the_last_image_up_to_the_next_key_frame(tmp_path: Path) -> None:
    stream = [unit for unit in film() if unit.number not in (8, 9)]  # of the group 6 to 10
    found = exported(tmp_path, stream)
    assert (found.frames, found.left_out) == (17, 1)
    assert_shows(tmp_path / "front.mp4", recorded(tmp_path))
    assert set(shown(tmp_path / "front.mp4")) == {n - 1 for n in range(1, 21) if n not in (8, 9, 10)}


def test_a_recording_from_between_two_key_frames_starts_with_the_next(tmp_path: Path) -> None:
    found = exported(tmp_path, film()[2:])
    assert (found.frames, found.left_out) == (15, 3)
    assert_shows(tmp_path / "front.mp4", recorded(tmp_path))


@pytest.mark.parametrize("spoilt", [b"", b"\0\0\0\1", b"\0\0\1\x67\x42", b"no H.264 at all", b"\0\0\1\x09\x10"])
def test_a_key_frame_without_parameters_or_image_is_left_out_with_its_dependents(tmp_path: Path, spoilt: bytes) -> None:
    stream = [unit.with_data(spoilt) if unit.number == 6 else unit for unit in film()]
    found = exported(tmp_path, stream)
    assert (found.frames, found.left_out) == (15, 5)
    assert set(shown(tmp_path / "front.mp4")) == {0, 1, 2, 3, 4, *range(10, 20)}


def test_a_key_frame_that_lost_its_parameters_is_left_out_with_its_dependents(tmp_path: Path) -> None:
    bare = b"".join(START + unit for unit in units(film()[5].data) if unit_type(unit) == 5)
    assert bare
    found = exported(tmp_path, [unit.with_data(bare) if unit.number == 6 else unit for unit in film()])
    assert (found.frames, found.left_out) == (15, 5)


def test_an_image_without_any_slice_ends_its_group(tmp_path: Path) -> None:
    stream = [unit.with_data(b"\0\0\1\x06\x05") if unit.number == 8 else unit for unit in film()]
    found = exported(tmp_path, stream)
    assert (found.frames, found.left_out) == (17, 3)


def test_an_unreadable_parameter_set_is_left_out(tmp_path: Path) -> None:
    broken = b"\0\0\1\x67\xff\xff\xff\0\0\1\x68\xff\0\0\1\x65\x88\x80"
    stream = [unit.with_data(broken) if unit.number == 1 else unit for unit in film()]
    found = exported(tmp_path, stream)
    assert (found.frames, found.left_out) == (15, 5)


def test_times_that_do_not_increase_move_to_the_next_possible(tmp_path: Path) -> None:
    stream = [replace(unit, captured_ns=film()[0].captured_ns) for unit in film()]
    assert exported(tmp_path, stream).frames == 20
    with av.open(str(tmp_path / "front.mp4")) as container:
        stamps = [frame.pts for frame in container.decode(video=0)]
    assert stamps == list(range(20))


def test_a_pause_of_a_day_is_shortened_to_an_hour(tmp_path: Path) -> None:
    day_ns = 86_400 * 1_000_000_000
    stream = [replace(unit, captured_ns=unit.captured_ns + day_ns * (unit.number > GROUP)) for unit in film()]
    assert exported(tmp_path, stream).frames == 20
    with av.open(str(tmp_path / "front.mp4")) as container:
        times = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]  # type: ignore[operator]
    steps = np.diff(times)
    assert steps[GROUP - 1] == pytest.approx(3600)
    assert np.delete(steps, GROUP - 1) == pytest.approx([STEP_S] * 18, abs=1e-4)


# A stream that changes -----------------------------------------------------------------------------------------------


def changing() -> list[Unit]:
    return [*film(10), *film(10, 96, 64, 11), *film(5, first=21)]


def test_another_size_starts_another_file(tmp_path: Path, log: Callable[..., Ended]) -> None:
    found = exported(tmp_path, changing())
    names = [(video.path.name, video.frames, video.width, video.height) for video in found.videos]
    assert names == [("front.mp4", 10, 64, 48), ("front-2.mp4", 10, 96, 64), ("front-3.mp4", 5, 64, 48)]
    assert [video.begin_s for video in found.videos] == pytest.approx([0.0, 10 * STEP_S, 20 * STEP_S])
    images = recorded(tmp_path)
    for video, first in zip(found.videos, (1, 11, 21), strict=True):
        assert_shows(video.path, {n: images[n] for n in range(first, first + video.frames)})
    ended = log("export", tmp_path / "flight.mcap", "--to", "mp4", "-o", tmp_path / "x.mp4")
    assert ended.code == 0
    assert f"{tmp_path}/x-2.mp4: 10 frames of front, from 0.400 s on, 96×64, as it was recorded" in ended.err


def test_returning_to_the_same_parameters_starts_no_file(tmp_path: Path) -> None:
    assert len(exported(tmp_path, [*film(10), *film(10, first=11, seed=2)]).videos) == 1


def test_a_stream_that_changes_too_often_is_refused_without_any_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(copying, "MAX_FILES", 2)
    with pytest.raises(FileFormatError, match="front can't be copied: the stream changes more than 2 times"):
        exported(tmp_path, changing())
    assert {path.name for path in tmp_path.iterdir()} == {"flight.mcap"}
    recording = Recording.open(tmp_path / "flight.mcap")
    found = export_mp4(recording, "alpha", "front", tmp_path / "front.mp4", encode=True)
    assert [(video.frames, video.copied) for video in found.videos] == [(15, False)]
    assert found.left_out == 10


@given(st.integers(1, 99))
def test_names(number: int) -> None:
    path = numbered(Path("a/b.c.mp4"), number)
    assert path.name == ("b.c.mp4" if number == 1 else f"b.c-{number}.mp4")
    assert path.parent == Path("a")


# Encoding ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"burn_time": True}, {"encode": True}])
def test_frames_drawn_into_or_encoded_on_request(tmp_path: Path, options: dict[str, bool]) -> None:
    found = exported(tmp_path, film(), **options)
    assert [(video.frames, video.copied) for video in found.videos] == [(20, False)]
    assert set(shown(tmp_path / "front.mp4")) == set(range(20))


def test_a_camera_with_some_jpeg_frames_is_encoded(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    stream = [replace(unit, data=jpeg, format="jpeg", key=True) if 6 <= unit.number <= 10 else unit for unit in film()]
    found = exported(tmp_path, stream)
    assert [(video.frames, video.copied) for video in found.videos] == [(20, False)]
    assert shown(tmp_path / "front.mp4")[7].mean() == pytest.approx(90, abs=4)


# Damage --------------------------------------------------------------------------------------------------------------


def test_the_existing_part_of_a_truncated_recording_is_exported(tmp_path: Path) -> None:
    data = write_film(tmp_path / "whole.mcap", film(), closed=False).read_bytes()
    (tmp_path / "flight.mcap").write_bytes(data[: len(data) * 2 // 3])
    found = export_mp4(Recording.open(tmp_path / "flight.mcap"), "alpha", "front", tmp_path / "front.mp4")
    assert 5 <= found.frames < 20
    assert_shows(tmp_path / "front.mp4", recorded(tmp_path))


def test_the_intact_part_of_a_damaged_recording_is_exported(tmp_path: Path) -> None:
    path = write_film(tmp_path / "flight.mcap", film())
    data = bytearray(path.read_bytes())
    piece = Recording.open(path).found.pieces[1]
    data[piece.offset + piece.size // 2] ^= 0xFF
    path.write_bytes(data)
    recording = Recording.open(path)
    found = export_mp4(recording, "alpha", "front", tmp_path / "front.mp4")
    assert (found.frames, found.left_out) == (15, 0)
    assert recording.damaged
    assert_shows(tmp_path / "front.mp4", recorded(tmp_path))


def test_a_camera_without_decodable_frames(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no frame of front can be decoded"):
        exported(tmp_path, film()[1:5])
    assert not (tmp_path / "front.mp4").exists()


def test_unwritable_paths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "front.mp4").mkdir()
    with pytest.raises(UsageError, match=r"front\.mp4 can't be written: Is a directory"):
        exported(tmp_path, film())


# Contents of a unit --------------------------------------------------------------------------------------------------

BODY = st.binary(min_size=1, max_size=20).map(lambda data: data.replace(b"\0", b"\1"))  # no start code in it
NAL = st.tuples(st.integers(0, 31), BODY).map(lambda parts: bytes([0x60 | parts[0]]) + parts[1])


@given(st.lists(st.tuples(NAL, st.sampled_from([b"\0\0\1", b"\0\0\0\1"])), max_size=8))
def test_contents_of_a_unit(nals: list[tuple[bytes, bytes]]) -> None:
    found = contents(b"".join(start + nal for nal, start in nals))
    kinds = [nal[0] & 31 for nal, _ in nals]
    assert found.is_picture == bool({1, 5} & set(kinds))
    expected = [nal for nal, _ in nals if nal[0] & 31 in (7, 8)] if {7, 8} <= set(kinds) else []
    assert units(found.parameters) == expected


@given(st.binary(max_size=200))
def test_anything_has_contents(data: bytes) -> None:
    assert contents(contents(data).parameters).parameters == contents(data).parameters
