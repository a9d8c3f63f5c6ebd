"""Calibration of exactly known cameras, from images of boards with noise."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from skyloop.calibration import Calibration, load_calibration
from skyloop.drivers.live_camera import check_intrinsics, intrinsics_of
from skyloop.drivers.uri import parse_uri
from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.messages import Intrinsics
from skyloop.vision import Board, BoardFinder, BoardView, Collector, calibrate, unproject
from tests.support.board_pictures import FISHEYE, PINHOLE, SIZE, photograph, poses

CHARUCO, CHESSBOARD = Board(), Board(kind="chessboard")
FILE = Calibration(width=640, height=480, model="pinhole", fx=500.0, fy=501.0, cx=320.0, cy=240.0, rms_px=0.2, views=9)


@cache
def views(board: Board, lens: Intrinsics, count: int, near: float, far: float, wide: float) -> tuple[BoardView, ...]:
    finder, rng = BoardFinder(board), np.random.default_rng(1)
    found = [
        finder.find(photograph(board, lens, turn, middle, rng), f"picture {n}")
        for n, (turn, middle) in enumerate(poses(count, 3, near=near, far=far, wide=wide))
    ]
    return tuple(view for view in found if view is not None)


def angle_errors(found: Intrinsics, true: Intrinsics, margin: float) -> np.ndarray:
    """Return angles between two models' directions of pixels [deg], away from the image's edge."""
    width, height = SIZE
    x, y = np.meshgrid(
        np.linspace(margin * width, (1 - margin) * width, 12), np.linspace(margin * height, (1 - margin) * height, 9)
    )
    grid = np.column_stack([x.ravel(), y.ravel()])
    cosine = (unproject(grid, found) * unproject(grid, true)).sum(axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@pytest.mark.parametrize(
    ("board", "lens", "model", "reach", "margin"),
    [
        (CHARUCO, PINHOLE, "pinhole", (0.3, 0.6, 0.35), 0.1),
        (CHESSBOARD, PINHOLE, "pinhole", (0.4, 0.6, 0.2), 0.15),
        (CHARUCO, FISHEYE, "fisheye", (0.18, 0.3, 0.7), 0.25),
    ],
    ids=["charuco", "chessboard", "fisheye"],
)
def test_a_known_camera_is_found_again(
    board: Board, lens: Intrinsics, model: str, reach: tuple[float, float, float], margin: float
) -> None:
    found, _ = calibrate(views(board, lens, 14, *reach), *SIZE, model=model, camera="front")  # type: ignore[arg-type]
    assert found.fx == pytest.approx(lens.fx, rel=0.005)
    assert found.fy == pytest.approx(lens.fy, rel=0.005)
    assert (found.cx, found.cy) == pytest.approx((lens.cx, lens.cy), abs=2.0)
    assert found.rms_px is not None
    assert found.rms_px < 0.2
    assert found.coverage is not None
    assert 0.2 < found.coverage <= 1.0
    errors = angle_errors(found.intrinsics, lens, margin)
    assert np.mean(errors) < 0.1
    assert np.max(errors) < 0.3
    assert (found.model, found.camera) == (model, "front")
    assert 10 <= found.views <= 14


def test_views_that_do_not_fit_the_others_are_removed() -> None:
    good = list(views(CHARUCO, PINHOLE, 14, 0.3, 0.6, 0.35))
    wrong = BoardView(
        good[0].points, good[0].pixels + np.random.default_rng(2).normal(0, 6, good[0].pixels.shape), "wrong"
    )
    found, rejected = calibrate([*good[1:], wrong], *SIZE)
    assert [view.name for view in rejected] == ["wrong"]
    assert found.rejected == 1
    assert found.fx == pytest.approx(PINHOLE.fx, rel=0.005)


def test_too_few_views_are_reported() -> None:
    some = views(CHARUCO, PINHOLE, 14, 0.3, 0.6, 0.35)
    with pytest.raises(UsageError, match="too few"):
        calibrate(some[:4], *SIZE)
    with pytest.raises(UsageError, match="model"):
        calibrate(some, *SIZE, model="mirror")  # type: ignore[arg-type]
    flat = np.array([[x, y, 0.0] for x in range(5) for y in range(4)]) * 0.03
    nowhere = [BoardView(flat, np.full((len(flat), 2), 7.0)) for _ in range(7)]
    with pytest.raises(UsageError, match="tilted"):
        calibrate(nowhere, *SIZE, model="fisheye")


def test_a_collector_takes_new_views() -> None:
    some = views(CHARUCO, PINHOLE, 14, 0.3, 0.6, 0.35)
    collector = Collector(*SIZE)
    assert collector.coverage == 0.0
    assert collector.offer(some[0])
    nudged = BoardView(some[0].points, some[0].pixels + 3.0)
    assert not collector.offer(nudged), "nearly the same as before"
    taken = [collector.offer(view) for view in some[1:]]
    assert sum(taken) >= 11
    assert len(collector.views) == 1 + sum(taken)
    assert 0.3 < collector.coverage < 1.0


def test_an_absent_board_is_not_found() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    assert BoardFinder(CHARUCO).find(noise) is None
    assert BoardFinder(CHESSBOARD).find(noise) is None
    with pytest.raises(UsageError, match="uint8"):
        BoardFinder(CHARUCO).find(np.zeros((4, 4)))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wrong",
    [{"columns": 2}, {"rows": True}, {"square_m": 0.0}, {"kind": "dots"}],
)
def test_invalid_boards(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Board(**wrong)  # type: ignore[arg-type]


def test_a_board_needs_enough_markers() -> None:
    with pytest.raises(UsageError, match="needs 60 markers"):
        Board(12, 10).picture()
    assert Board(12, 10, dictionary="DICT_5X5_100").picture(40).shape == (11 * 40, 13 * 40)
    with pytest.raises(UnknownNameError, match="did you mean"):
        BoardFinder(Board(dictionary="4x4_5"))


def test_boards_are_written_at_their_true_size(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="boards are written with Pillow")
    CHARUCO.save(tmp_path / "board.png", dpi=150)
    with image.open(tmp_path / "board.png") as written:
        width_m = written.width / written.info["dpi"][0] * 0.0254
        assert width_m == pytest.approx(8 * 0.033, rel=0.002)
        pixels = np.asarray(written.convert("L"))
    found = BoardFinder(CHARUCO).find(pixels)
    assert found is not None
    assert len(found.pixels) == CHARUCO.corners
    CHESSBOARD.save(tmp_path / "board.pdf", dpi=100)
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    for name, dpi, why in (
        ("board.gif", 100, "must end"),
        ("no/board.png", 100, "written"),
        ("board.png", 1, "pixels"),
    ):
        with pytest.raises(UsageError, match=why):
            CHARUCO.save(tmp_path / name, dpi=dpi)


def test_files_round_trip(tmp_path: Path) -> None:
    FILE.save(tmp_path / "front.json")
    assert load_calibration(tmp_path / "front.json") == FILE
    half = FILE.intrinsics_for(320, 240)
    assert (half.fx, half.cx, half.cy) == pytest.approx((250.0, 159.75, 119.75))
    assert FILE.intrinsics_for(640, 480) == FILE.intrinsics
    with pytest.raises(UsageError, match="same aspect ratio"):
        FILE.intrinsics_for(640, 360)
    with pytest.raises(UsageError, match="written"):
        FILE.save(tmp_path / "no" / "front.json")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not a camera calibration"),
        ("{}", "missing required field"),
        ('{"width": 0, "height": 480, "model": "pinhole", "fx": 1, "fy": 1, "cx": 0, "cy": 0}', "width"),
        ('{"width": 640, "height": 480, "model": "mirror", "fx": 1, "fy": 1, "cx": 0, "cy": 0}', "mirror"),
        ('{"width": 640, "height": 480, "model": "pinhole", "fx": 0, "fy": 1, "cx": 0, "cy": 0}', "above 0"),
        (
            '{"width": 640, "height": 480, "model": "fisheye", "fx": 1, "fy": 1, "cx": 0, "cy": 0, "distortion": [1]}',
            "0 or 4",
        ),
        (
            '{"width": 640, "height": 480, "model": "pinhole", "fx": 1, "fy": 1, "cx": 0, "cy": 0, "k": 1}',
            "unknown field",
        ),
    ],
)
def test_invalid_calibration_files(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "front.json"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=why):
        load_calibration(file)


def test_an_address_can_name_a_calibration(tmp_path: Path) -> None:
    file = tmp_path / "front.json"
    FILE.save(file)
    uri = parse_uri(f"video://0?calibration={file}")
    check_intrinsics(uri)
    assert intrinsics_of(uri, 640, 480) == FILE.intrinsics
    assert intrinsics_of(uri, 640, 360) is None
    with pytest.raises(UsageError, match="can't be combined with calibration"):
        check_intrinsics(parse_uri(f"video://0?calibration={file}&fx=3"))
    with pytest.raises(FileFormatError, match="can't be read"):
        check_intrinsics(parse_uri("video://0?calibration=/no/such/file"))
