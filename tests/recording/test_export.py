"""``skyloop log export``: CSV, Parquet, NumPy and MP4 hold the recorded data."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from skyloop.errors import FileFormatError, MissingExtraError, UnknownNameError, UsageError
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review import video
from skyloop.recording.review.report import write_report
from skyloop.recording.review.tables import Table, export_csv, export_npz, export_parquet, read, tables
from skyloop.recording.review.video import export_mp4
from tests.support.commands import Ended
from tests.support.recorded_flights import BEGIN_NS, MS, Plan, write_flight

Log = Callable[..., Ended]
TABLES = {"feedback", "commands", "events", "parameters", "logs", "results", "frames.front", "drops"}


def test_tables_hold_every_sample(flight: Path) -> None:
    found = tables(Recording.open(flight), "alpha")
    assert set(found) == TABLES
    assert {name: len(table) for name, table in found.items()} == {
        "feedback": 96,
        "commands": 40,
        "events": 7,
        "parameters": 3,
        "logs": 3,
        "results": 1,
        "frames.front": 20,
        "drops": 1,
    }
    feedback = found["feedback"]
    assert feedback["t_s"][:3] == pytest.approx([0.0, 0.02, 0.04])
    assert feedback["captured_ns"].dtype == np.int64
    assert feedback["captured_ns"][0] == BEGIN_NS - 4 * MS
    assert np.isnan(feedback.numbers("battery_v")).all()
    assert not feedback.known("battery_v")
    assert feedback["native.note"][0] == "fine"
    assert feedback["owner"][0] == "pilot.py"
    commands = found["commands"]
    assert set(commands["asked"]) == {"takeoff", "velocity", "land"}
    flying = commands["asked"] == "velocity"
    assert commands["applied_forward"][flying] == pytest.approx(0.4)
    assert np.isnan(commands["applied_forward"][~flying]).all()
    assert found["logs"]["values"].tolist().count("1 2") == 1
    assert found["results"]["value.score"].tolist() == [0.5]
    assert found["results"]["value.boxes"].tolist() == ["[[1,2]]"]
    assert np.nanmax(found["events"].numbers("data.speed_m_s")) == 0.3


def test_a_table_without_a_column() -> None:
    assert len(Table("x")) == 0
    assert np.isnan(Table("x", {"t_s": np.zeros(3)}).numbers("y")).all()


def test_csv(log: Log, flight: Path, tmp_path: Path) -> None:
    folder = tmp_path / "made" / "csv"
    ended = log("export", flight, "--to", "csv", "-o", folder)
    assert ended.code == 0
    assert "96 × feedback" in ended.err
    assert {path.stem for path in folder.iterdir()} == TABLES
    with (folder / "feedback.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 96
    assert rows[0]["battery_v"] == ""
    assert float(rows[10]["position_x_m"]) == tables(Recording.open(flight), "alpha")["feedback"]["position_x_m"][10]
    assert int(rows[1]["captured_ns"]) == BEGIN_NS + 16 * MS


def test_parquet(log: Log, flight: Path, tmp_path: Path) -> None:
    assert log("export", flight, "--to", "parquet", "-o", tmp_path, "--channel", "feedback").code == 0
    table = pq.read_table(tmp_path / "feedback.parquet")
    assert table.num_rows == 96
    assert table["battery_v"].null_count == 96
    assert table["state"][0].as_py() == "landed"
    assert not (tmp_path / "commands.parquet").exists()


def test_numpy(log: Log, flight: Path, tmp_path: Path) -> None:
    ended = log("export", flight, "--to", "npz", "-o", tmp_path / "flight.npz")
    assert ended.code == 0
    with np.load(tmp_path / "flight.npz") as arrays:
        assert arrays["feedback/altitude_m"].max() == pytest.approx(1.2)
        assert arrays["events/text"].tolist().count("touched a chair") == 1


@pytest.mark.parametrize("burn", [False, True])
def test_mp4_keeps_each_frames_time(log: Log, flight: Path, tmp_path: Path, burn: bool) -> None:
    path = tmp_path / "front.mp4"
    ended = log("export", flight, "--to", "mp4", "-o", path, *(["--burn-time"] if burn else []))
    assert ended.code == 0
    assert "20 frames of front" in ended.err
    with av.open(str(path)) as container:
        pictures = list(container.decode(video=0))
    assert len(pictures) == 20
    times = [float(picture.pts * picture.time_base) for picture in pictures]  # type: ignore[operator]
    assert times == pytest.approx([0.1 * number for number in range(20)], abs=0.001)
    image = pictures[5].to_ndarray(format="bgr24")
    assert image.shape == (48, 64, 3)
    corner = image[34:, 24:40].max()
    assert corner > 200 if burn else corner < 160  # white digits on a dark ramp, away from the bright column


def test_mp4_has_its_ending_and_finds_a_place_in_a_folder(log: Log, flight: Path, tmp_path: Path) -> None:
    for output, written in ((tmp_path / "film", "film.mp4"), (tmp_path, f"{flight.stem}-front.mp4")):
        assert log("export", flight, "--to", "mp4", "-o", output).code == 0
        assert (tmp_path / written).is_file()


def jpeg(width: int, height: int) -> bytes:
    return cv2.imencode(".jpg", np.full((height, width, 3), 90, np.uint8))[1].tobytes()


def videos(path: Path, target: Path) -> tuple[int, int]:
    found = export_mp4(Recording.open(path), "alpha", "front", target)
    assert [(one.path, one.copied) for one in found.videos] == [(target, False)]
    return found.frames, found.left_out


def test_damaged_images_and_images_of_another_size_are_left_out(tmp_path: Path) -> None:
    """A video has one size, that of its first image, made even; the others keep their times."""
    odd = {number: jpeg(65, 49) for number in range(1, 21)} | {3: b"no picture", 4: b"\xff\xd8\xff", 6: jpeg(32, 24)}
    path = write_flight(tmp_path / "flight.mcap", Plan(packed=odd.get))
    assert videos(path, tmp_path / "x.mp4") == (17, 3)
    with av.open(str(tmp_path / "x.mp4")) as container:
        pictures = list(container.decode(video=0))
    assert {(picture.width, picture.height) for picture in pictures} == {(64, 48)}
    tenths = [round(float(picture.pts * picture.time_base) * 10) for picture in pictures]  # type: ignore[operator]
    assert tenths == [0, 1, 4, *range(6, 20)]


def test_a_camera_without_decodable_frames(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "flight.mcap", Plan(packed=lambda number: b"no picture"))
    with pytest.raises(FileFormatError, match="no frame of front can be decoded"):
        export_mp4(Recording.open(path), "alpha", "front", tmp_path / "x.mp4")
    assert not (tmp_path / "x.mp4").exists()


def test_without_h264_mpeg4_is_used(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not every build of FFmpeg has x264."""
    monkeypatch.setattr(video, "_CODECS", ("no codec of that name", "mpeg4"))
    assert export_mp4(Recording.open(flight), "alpha", "front", tmp_path / "x.mp4", burn_time=True).frames == 20
    with av.open(str(tmp_path / "x.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
    monkeypatch.setattr(video, "_CODECS", ("no codec of that name",))
    with pytest.raises(MissingExtraError, match="no codec of that name"):
        export_mp4(Recording.open(flight), "alpha", "front", tmp_path / "y.mp4")


@pytest.mark.parametrize(("missing", "to", "extra"), [("pyarrow", "parquet", "parquet"), ("av", "mp4", "video")])
def test_missing_packages_are_named(
    log: Log, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str, to: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    ended = log("export", flight, "--to", to, "-o", tmp_path / "out")
    assert ended.code == 1
    assert f"skyloop install {extra}" in ended.err


def test_burning_times_needs_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match="vision"):
        video._burn(image, 1.0)


def test_missing_frames(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "flight.mcap", Plan(frame_ms=0))
    with pytest.raises(UnknownNameError, match="camera of alpha"):
        export_mp4(Recording.open(path), "alpha", "front", tmp_path / "x.mp4")


def test_wrong_words(log: Log, flight: Path, tmp_path: Path) -> None:
    for arguments, words in (
        (["--channel", "feedbak"], "did you mean 'feedback'"),
        (["--drone", "beta"], "no drone in"),
        (["--to", "mp4", "--camera", "sideways", "-o", tmp_path / "x.mp4"], "known: front"),
        (["--to", "mp4", "--channel", "feedback"], "--channel has no effect on mp4"),
        (["--burn-time"], "--burn-time has no effect on csv"),
        (["--channel", "annotations"], "contains none of these channels"),
        (["-o", "/proc/nothing/here"], "can't be created"),
        (["--to", "xlsx"], "--to"),
    ):
        ended = log("export", flight, *arguments)
        assert (ended.code, ended.out) == (2, "")
        assert words in ended.err, ended.err


def test_unwritable_paths_are_refused(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "feedback.csv").mkdir()
    found = read(Recording.open(flight), "alpha", (Channel.FEEDBACK,))
    with pytest.raises(Exception, match="can't be written: Is a directory"):
        export_csv(found, tmp_path)
    (tmp_path / "feedback.parquet").mkdir()
    with pytest.raises(UsageError, match=r"feedback\.parquet can't be written"):
        export_parquet(found, tmp_path)
    (tmp_path / "x.npz").mkdir()
    with pytest.raises(UsageError, match=r"x\.npz can't be written: Is a directory"):
        export_npz(found, tmp_path / "x")
    with pytest.raises(UsageError, match="can't be written: No such file"):
        export_mp4(Recording.open(flight), "alpha", "front", tmp_path / "nowhere" / "x.mp4")
    with pytest.raises(FileFormatError, match="contains none"):
        read(Recording.open(flight), "alpha", (Channel.ANNOTATIONS,))


def test_a_failed_export_leaves_an_existing_file_alone(tmp_path: Path, flight: Path, log: Log) -> None:
    target = tmp_path / "film.mp4"
    target.write_bytes(b"an earlier export")
    ended = log("export", flight, "--to", "mp4", "--camera", "wrong", "-o", target)
    assert ended.code == 2
    assert "no camera of alpha" in ended.err
    bad = write_flight(tmp_path / "bad.mcap", Plan(seconds=0.5, packed=lambda _: b"no picture"))
    assert log("export", bad, "--to", "mp4", "-o", target).code == 2
    assert target.read_bytes() == b"an earlier export"
    assert {path.name for path in tmp_path.iterdir()} == {"film.mp4", "bad.mcap"}


def full_disk(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_disk_leaves_an_existing_file_alone(
    tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = read(Recording.open(flight), "alpha", [Channel.LOGS])
    for name in ("logs.csv", "logs.parquet", "logs.npz", "report.html"):
        (tmp_path / name).write_bytes(b"an earlier export")
    monkeypatch.setattr(os, "fsync", full_disk)
    for write, path in (
        (export_csv, tmp_path),
        (export_parquet, tmp_path),
        (export_npz, tmp_path / "logs.npz"),
        (lambda _, path: write_report(Recording.open(flight), "alpha", path), tmp_path / "report.html"),
    ):
        with pytest.raises(UsageError, match="No space left"):
            write(found, path)
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"an earlier export"}
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ('=HYPERLINK("http://x")', '\'=HYPERLINK("http://x")'),
        ("+1+cmd|' /C calc'!A0", "'+1+cmd|' /C calc'!A0"),
        ("-2+3", "'-2+3"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1", "'\t=1"),
        ("＝1", "'＝1"),
        ("-0.5 1.25 -3e-07", "-0.5 1.25 -3e-07"),
        ("-inf", "-inf"),
        ("-12", "-12"),
        ("a=b", "a=b"),
    ],
)
def test_cells_are_never_formulas(tmp_path: Path, given: str, written: str) -> None:
    table = Table("logs", {"text": np.array([given]), given: np.array([1.0])})
    export_csv({"logs": table}, tmp_path)
    with (tmp_path / "logs.csv").open(newline="", encoding="utf-8") as file:
        assert list(csv.reader(file)) == [["text", written], [written, "1.0"]]
