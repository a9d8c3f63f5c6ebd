"""``skyloop camera``: boards and calibrations from files, and from a vehicle that shows a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from skyloop.calibration import load_calibration
from skyloop.vision import Board
from tests.support.board_pictures import PINHOLE, photograph, poses
from tests.support.commands import Run
from tests.support.systems import only_on


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Pictures of the standard board, followed by one of a wall."""
    folder, rng = tmp_path_factory.mktemp("pictures"), np.random.default_rng(1)
    names = []
    for number, (turn, middle) in enumerate(poses(9, 3, near=0.3, far=0.6, wide=0.35)):
        names.append(str(folder / f"{number}.png"))
        cv2.imwrite(names[-1], photograph(Board(), PINHOLE, turn, middle, rng))
    names.append(str(folder / "wall.png"))
    cv2.imwrite(names[-1], np.full((480, 640), 90, np.uint8))
    return names


def test_a_board_is_written(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("PIL", reason="boards are written with Pillow")
    ended = run("camera", "board", "-o", str(tmp_path / "board.pdf"), "--dpi", "72")
    assert ended.code == 0
    assert "7 × 5 squares of 33 mm, 264 × 198 mm" in ended.out
    assert (tmp_path / "board.pdf").stat().st_size > 1000
    refused = run("camera", "board", "-o", str(tmp_path / "board.txt"))
    assert refused.code == 2
    assert ".png or .pdf" in refused.err


def test_pictures_calibrate(run: Run, tmp_path: Path, pictures: list[str]) -> None:
    output = tmp_path / "front.json"
    ended = run("camera", "calibrate", *pictures, "-o", str(output), "--camera", "front")
    assert ended.code == 0, ended.err
    found = load_calibration(output)
    assert found.fx == pytest.approx(PINHOLE.fx, rel=0.01)
    assert (found.views, found.camera) == (9, "front")
    assert "wall.png: the board is not visible" in ended.err
    assert f"fx {found.fx:.1f} ± {found.fx_deviation:.1f}" in ended.out
    assert "RMS over 9 views" in ended.out
    again = run("camera", "calibrate", *pictures, "-o", str(output))
    assert again.code == 2
    assert "--overwrite" in again.err


def test_a_video_calibrates_by_views_that_differ(run: Run, tmp_path: Path, pictures: list[str]) -> None:
    video = cv2.VideoWriter(str(tmp_path / "board.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 15.0, (640, 480))
    for name in pictures:
        for _ in range(3):
            picture = cv2.imread(name)
            assert picture is not None
            video.write(picture)
    video.release()
    output = tmp_path / "camera.json"
    ended = run("camera", "calibrate", str(tmp_path / "board.avi"), "-o", str(output), "--views", "8")
    assert ended.code == 0, ended.err
    assert load_calibration(output).views + load_calibration(output).rejected == 8
    assert "view 8:" in ended.err
    assert "view 9:" not in ended.err


def test_a_vehicle_without_a_board_is_reported(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="the simulator draws with OpenCV")
    output = str(tmp_path / "camera.json")
    ended = run("camera", "calibrate", "sim://?world=empty&cameras=front&fps=20", "-o", output, "--seconds", "1")
    assert "looking for a board of 7 × 5 squares for at most 1 s; Ctrl-C ends that earlier" in ended.err
    assert ended.code == 2
    assert "1 s are over" in ended.err
    assert "0 views of the board are too few" in ended.err


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["nobody"], "neither a file nor a running proxy"),
        ([__file__, "nobody"], "no file 'nobody'"),
        (["nobody", "nothing"], "no file 'nobody'"),
        ([__file__], "can't be read as a video"),
    ],
)
def test_invalid_sources_are_refused(run: Run, tmp_path: Path, arguments: list[str], why: str) -> None:
    ended = run("camera", "calibrate", *arguments, "-o", str(tmp_path / "camera.json"))
    assert ended.code == 2
    assert why in ended.err


def test_pictures_of_two_sizes(run: Run, tmp_path: Path, pictures: list[str]) -> None:
    small = str(tmp_path / "small.png")
    cv2.imwrite(small, np.full((240, 320), 90, np.uint8))
    ended = run("camera", "calibrate", pictures[0], small, "-o", str(tmp_path / "camera.json"))
    assert ended.code == 2
    assert "320x240" in ended.err
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    assert "can't be read as an image" in run("camera", "calibrate", str(broken), "-o", str(tmp_path / "x.json")).err


def test_a_vehicle_that_shows_a_board_calibrates(run: Run, tmp_path: Path, pictures: list[str]) -> None:
    pytest.importorskip("av", reason="videos are played with PyAV")
    video = cv2.VideoWriter(str(tmp_path / "board.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (640, 480))
    for name in pictures:
        picture = cv2.imread(name)
        assert picture is not None
        for _ in range(2):
            video.write(picture)
    video.release()
    output = tmp_path / "camera.json"
    source = f"video://{tmp_path / 'board.avi'}?loop=1"
    ended = run("camera", "calibrate", source, "-o", str(output), "--views", "7", "--seconds", "60")
    assert ended.code == 0, ended.err
    assert load_calibration(output).fx == pytest.approx(PINHOLE.fx, rel=0.02)


@only_on("linux", reason="cameras have no nodes in /dev to list formats of")
def test_the_cameras_of_this_machine_are_listed(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("av")
    from skyloop.vehicles.video import v4l2

    monkeypatch.setattr(v4l2, "cameras", list)
    assert run("camera", "list").out.strip() == "no camera is connected to this machine"
    (tmp_path / "video0").touch()
    found = [v4l2.CameraDevice(tmp_path / "video0", "HD Webcam", True)]
    monkeypatch.setattr(v4l2, "cameras", lambda: found)
    lines = run("camera", "list").out.splitlines()
    assert lines[0] == f"video://{tmp_path}/video0 (HD Webcam)"
    assert lines[1].startswith("  can't be opened: ")
