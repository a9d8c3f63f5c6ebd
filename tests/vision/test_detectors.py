"""Detectors: layouts recognised and decoded, files of each family, and invalid files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from onnx import TensorProto

from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.vision import Layout, ObjectDetector, OnnxDetector
from skyloop.vision.object_tracks import suppress
from skyloop.vision.onnx_detector import class_count, decode, grid_places, tell_layout
from tests.support.networks import write

W, H = 96, 64
N = grid_places(W, H)[0]
IMAGE = np.zeros((H, W, 3), np.uint8)
BOX, SCORE, CLASS = (10.0, 20.0, 30.0, 24.0), 0.9, 1  # x, y, width, height
CENTRED = np.array([25.0, 32.0, 30.0, 24.0])
SHARES = CENTRED / [W, H, W, H]
ROW = 5  # of the output that holds it


def rows(count: int, columns: int, box: Any, score_at: int, *, objectness: bool = False) -> np.ndarray[Any, Any]:
    made = np.zeros((1, count, columns), np.float32)
    made[0, ROW, :4] = box
    made[0, ROW, score_at] = SCORE
    if objectness:
        made[0, ROW, 4] = 1.0
    return made


def yolox() -> np.ndarray[Any, Any]:
    made = rows(N, 8, 0, 6, objectness=True)  # place 5 of the grid of stride 8: x = 40, y = 0
    made[0, ROW, :4] = [(25 - 40) / 8, 32 / 8, np.log(30 / 8), np.log(24 / 8)]
    return made


def decoded() -> np.ndarray[Any, Any]:
    made = rows(N, 8, 0, 6, objectness=True)
    y, x = np.mgrid[0:8, 0:12]
    made[0, :96, 0], made[0, :96, 1] = x.ravel() * 8, y.ravel() * 8
    made[0, ROW, :4] = CENTRED
    return made


def detr(logits: bool, name: str = "logits", boxes: str = "pred_boxes") -> dict[str, Any]:
    scores = rows(100, 3, 0, CLASS)
    if logits:
        scores = np.where(scores == 0, -9.0, np.log(SCORE / (1 - SCORE))).astype(np.float32)
    return {name: scores, boxes: rows(100, 4, SHARES, 0)[:, :, :4] * 0 + boxed()}


def boxed() -> np.ndarray[Any, Any]:
    made = np.zeros((1, 100, 4), np.float32)
    made[0, ROW] = SHARES
    return made


def lists() -> dict[str, Any]:
    corners = np.array([[[10, 20, 40, 44]]], np.float32)
    return {
        "labels": np.array([[CLASS]], np.int64),
        "boxes": corners,
        "scores": np.array([[SCORE]], np.float32),
    }


END = np.zeros((1, 300, 6), np.float32)
END[0, ROW] = [10, 20, 40, 44, SCORE, CLASS]

FAMILIES: dict[str, tuple[Layout, dict[str, Any]]] = {
    "yolov5": (Layout.YOLO5, {"output0": rows(3 * N, 8, CENTRED, 6, objectness=True)}),
    "yolov8": (Layout.YOLO8, {"output0": rows(N, 7, CENTRED, 5).transpose(0, 2, 1)}),
    "yolov10": (Layout.END_TO_END, {"output0": END}),
    "yolox": (Layout.YOLOX, {"output": yolox()}),
    "ultralytics rt-detr": (Layout.RT_DETR, {"output0": rows(300, 7, SHARES, 5)}),
    "rt-detr": (Layout.DETR, detr(logits=True)),
    "detr, scores": (Layout.DETR, detr(logits=False)),
    "rf-detr": (Layout.RF_DETR, detr(logits=True, name="labels", boxes="dets")),
    "torchvision": (Layout.LISTS, lists()),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_a_file_of_each_family_is_recognised_by_its_outputs_and_read(family: str, tmp_path: Path) -> None:
    layout, outputs = FAMILIES[family]
    detector = OnnxDetector(write(tmp_path / "a.onnx", outputs), names=["person", "car", "box"])
    assert isinstance(detector, ObjectDetector)
    assert detector.layout is layout
    assert detector.size == (W, H)
    (found,) = detector.detect(IMAGE)
    assert found.box == pytest.approx(BOX, abs=1e-3)
    assert found.score == pytest.approx(SCORE, abs=1e-4)
    assert (found.class_id, found.class_name) == (1, "car")
    assert found.outline[2] == pytest.approx((40.0, 44.0), abs=1e-3)
    assert found.centre == pytest.approx((24.5, 31.5), abs=1e-3)
    assert detector.dropped == 0


def test_an_image_of_another_size_is_letterboxed_and_grey_is_allowed(tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", FAMILIES["yolov8"][1])
    (found,) = OnnxDetector(path).detect(np.zeros((2 * H, W), np.uint8))  # halved, with 24 columns at each side
    assert found.box == pytest.approx((0.0, 40.0, 32.0, 48.0), abs=1e-3)
    assert found.class_name == "1"
    stretched = OnnxDetector(write(tmp_path / "b.onnx", FAMILIES["rt-detr"][1])).detect(np.zeros((2 * H, W), np.uint8))
    assert stretched[0].box == pytest.approx((10.0, 40.0, 30.0, 48.0), abs=1e-3)


@pytest.mark.parametrize(("kind", "dtype"), [(TensorProto.FLOAT16, np.float16), (TensorProto.UINT8, np.float32)])
def test_inputs_of_half_precision_and_bytes_work(kind: int, dtype: Any, tmp_path: Path) -> None:
    outputs = {"output0": FAMILIES["yolov8"][1]["output0"].astype(dtype)}
    (found,) = OnnxDetector(write(tmp_path / "a.onnx", outputs, kind=kind)).detect(IMAGE)
    assert found.box == pytest.approx(BOX, abs=0.05)


def test_the_size_of_a_flexible_network_is_given_or_in_its_metadata(tmp_path: Path) -> None:
    outputs = FAMILIES["yolov8"][1]
    free = write(tmp_path / "a.onnx", outputs, shape=(1, 3, "height", "width"))
    assert OnnxDetector(free, size=(W, H)).detect(IMAGE)[0].box == pytest.approx(BOX)
    named = write(tmp_path / "b.onnx", outputs, shape=("n", 3, "h", "w"), metadata={"imgsz": "[64, 96]"})
    assert OnnxDetector(named).size == (W, H)
    with pytest.raises(UsageError, match="leave size out"):
        OnnxDetector(write(tmp_path / "c.onnx", outputs), size=(64, 64))


def test_names_come_from_metadata_a_list_a_mapping_or_a_file(tmp_path: Path) -> None:
    outputs = FAMILIES["yolov8"][1]
    path = write(tmp_path / "a.onnx", outputs, metadata={"names": "{0: 'person', 1: 'car', 2: 'box'}"})
    assert OnnxDetector(path).detect(IMAGE)[0].class_name == "car"
    assert OnnxDetector(path, names={1: "lorry"}).detect(IMAGE)[0].class_name == "lorry"
    file = tmp_path / "names.txt"
    file.write_text("a\nb\nc\n")
    assert OnnxDetector(path, names=file).names == {0: "a", 1: "b", 2: "c"}
    listed = write(tmp_path / "b.onnx", outputs, metadata={"names": "['a', 'b', 'c']"})
    assert OnnxDetector(listed).names[2] == "c"
    with pytest.raises(FileFormatError, match="3 classes, but 4 names"):
        OnnxDetector(path, names=["a", "b", "c", "d"])
    for bad in ([], [1], {"a": "b"}, tmp_path / "none.txt"):
        with pytest.raises(UsageError, match="names is"):
            OnnxDetector(path, names=bad)  # type: ignore[arg-type]
    for text in ("__import__('os')", "{", "{0: 1}", "7", "(" * 5000):
        with pytest.raises(FileFormatError, match="give names="):
            OnnxDetector(write(tmp_path / "c.onnx", outputs, metadata={"names": text}))


def test_an_ambiguous_layout_has_to_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", {"output": decoded()})
    with pytest.raises(FileFormatError, match=r"YOLOX or YOLOv6.*layout='yolox-decoded'"):
        OnnxDetector(path)
    for layout in ("yolox-decoded", "yolo5"):
        assert OnnxDetector(path, layout=layout).detect(IMAGE)[0].box == pytest.approx(BOX)
    two = write(tmp_path / "b.onnx", {"output0": rows(300, 6, SHARES, 5)}, metadata={"names": "{0: 'a', 1: 'b'}"})
    with pytest.raises(FileFormatError, match="layout='end-to-end' or layout='rt-detr'"):
        OnnxDetector(two)
    assert OnnxDetector(two, layout=Layout.RT_DETR).detect(IMAGE)[0].class_name == "b"
    with pytest.raises(UsageError, match="must be one of yolo5, yolo8"):
        OnnxDetector(path, layout="yolo99")


@pytest.mark.parametrize(
    "outputs",
    [
        {"output0": np.zeros((1, 7), np.float32)},
        {"output0": np.zeros((2, 7, N), np.float32)},
        {"output0": np.zeros((1, 5000, 3), np.float32)},
        {"output0": np.zeros((1, 7, N), np.float32), "output1": np.zeros((1, 32, 16, 24), np.float32)},
        {"a": np.zeros((1, 9, 4), np.float32), "b": np.zeros((1, 9, 4), np.float32)},
        {"boxes": np.zeros((7,), np.float32), "scores": np.zeros(2, np.float32), "labels": np.zeros(2, np.int64)},
        {"a": np.zeros(4, np.float32), "b": np.zeros(1, np.float32), "c": np.zeros(1, np.float32)},
        {str(k): np.zeros((1, 3, 8, 12, 85), np.float32) for k in range(4)},
    ],
    ids=range(8),
)
def test_other_outputs_are_refused_with_what_is_supported(outputs: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"no known layout.*give layout="):
        OnnxDetector(write(tmp_path / "a.onnx", outputs))


@pytest.mark.parametrize("layout", Layout)
def test_a_layout_that_does_not_fit_is_refused(layout: Layout) -> None:
    with pytest.raises(FileFormatError, match=r"layout"):
        decode(layout, {"a": np.zeros((1, 9, 3), np.float32)}, W, H)


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"shape": (1, 3, 64)}, "must have"),
        ({"shape": (1, 1, 64, 96)}, "must have"),
        ({"shape": (4, 3, 64, 96)}, "4 images at a time"),
        ({"shape": (1, 3, 64, 9000)}, "limit is 4096"),
        ({"kind": TensorProto.INT32}, "must have"),
        ({"metadata": {"task": "pose"}}, "'pose'"),
    ],
)
def test_networks_for_something_else_are_refused(options: dict[str, Any], wanted: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=wanted):
        OnnxDetector(write(tmp_path / "a.onnx", FAMILIES["yolov8"][1], **options))


def test_rt_detr_with_its_postprocessor_gets_the_size(tmp_path: Path) -> None:
    assert OnnxDetector(write(tmp_path / "a.onnx", lists(), sizes=True)).detect(IMAGE)[0].box == pytest.approx(BOX)


@pytest.mark.parametrize("content", [b"", b"no network", b"\x08\x08" * 500, bytes(range(256))])
def test_a_file_that_is_not_a_network_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"a\.onnx"):
        OnnxDetector(path)


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", FAMILIES["yolov8"][1])
    path.write_bytes(path.read_bytes()[:-700])
    with pytest.raises(FileFormatError, match="can't be loaded"):
        OnnxDetector(path)


@pytest.mark.parametrize(
    "options",
    [
        {"score": 2},
        {"score": float("nan")},
        {"iou": -1},
        {"iou": True},
        {"threads": 0},
        {"threads": 1.5},
        {"size": 3},
        {"size": (0, 64)},
    ],
)
def test_arguments_are_checked(options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=next(iter(options))):
        OnnxDetector(tmp_path / "a.onnx", **options)


def test_a_missing_file_or_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="there is no file"):
        OnnxDetector(tmp_path / "a.onnx")
    path = write(tmp_path / "a.onnx", FAMILIES["yolov8"][1])
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match="skyloop install detect"):
        OnnxDetector(path)


def test_detections_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    output = FAMILIES["yolov8"][1]["output0"].copy()
    output[0, :, 7] = [np.nan, 1, 1, 1, 0.9, 0, 0]
    output[0, :, 8] = [20, 20, np.inf, 10, 0.9, 0, 0]
    output[0, :, 9] = [20, 20, 10, 10, 0, np.nan, 0]
    output[0, :, 10] = [20, 20, 10, 10, 70, 0, 0]
    detector = OnnxDetector(write(tmp_path / "a.onnx", {"o": output}))
    assert len(detector.detect(IMAGE)) == 1
    assert detector.dropped == 4


def test_boxes_of_one_class_that_overlap_are_one_detection(tmp_path: Path) -> None:
    output = FAMILIES["yolov8"][1]["output0"].copy()
    output[0, :, 7] = [26, 32, 30, 24, 0, 0.8, 0]  # the same thing
    output[0, :, 8] = [25, 32, 30, 24, 0.7, 0, 0]  # another class
    output[0, :, 9] = [300, 32, 30, 24, 0.7, 0, 0]  # outside the image
    path = write(tmp_path / "a.onnx", {"o": output})
    assert [(each.class_id, round(each.score, 1)) for each in OnnxDetector(path).detect(IMAGE)] == [(1, 0.9), (0, 0.7)]
    assert len(OnnxDetector(path, iou=1.0).detect(IMAGE)) == 3
    assert OnnxDetector(path, score=0.95).detect(IMAGE) == []


@given(st.data())
def test_known_boxes_decode_from_every_layout(data: st.DataObject) -> None:
    x, y = data.draw(st.floats(20, 70)), data.draw(st.floats(20, 40))
    w, h = data.draw(st.floats(4, 40)), data.draw(st.floats(4, 40))
    number, score = data.draw(st.integers(0, 2)), data.draw(st.floats(0.3, 1.0))
    layout = data.draw(st.sampled_from([Layout.YOLO5, Layout.YOLO8, Layout.RT_DETR, Layout.YOLOX]))
    row = data.draw(st.integers(0, N - 1))
    first = 4 if layout in (Layout.YOLO8, Layout.RT_DETR) else 5
    made = np.zeros((1, N, first + 3))
    made[0, row, :4] = np.array([x, y, w, h]) / ([W, H, W, H] if layout is Layout.RT_DETR else 1)
    made[0, row, first + number] = score
    if first == 5:
        made[0, row, 4] = 1.0
    if layout is Layout.YOLOX:
        stride = 8 if row < 96 else 16 if row < 96 + 24 else 32
        place = row - (0 if stride == 8 else 96 if stride == 16 else 120)
        column, line = place % (W // stride), place // (W // stride)
        made[0, row, :4] = [x / stride - column, y / stride - line, np.log(w / stride), np.log(h / stride)]
    output = made.transpose(0, 2, 1) if layout is Layout.YOLO8 else made
    found = decode(layout, {"o": output}, W, H)
    assert class_count(layout, {"o": output}) == 3
    assert found.scores[row] == pytest.approx(score)
    assert found.classes[row] == number
    assert found.corners[row] == pytest.approx([x - w / 2, y - h / 2, x + w / 2, y + h / 2])


@given(
    arrays(np.float32, st.tuples(st.just(1), st.integers(0, 9), st.integers(0, 9))),
    st.sampled_from(Layout),
    st.integers(0, 9),
)
def test_hostile_outputs_are_decoded_or_refused(output: Any, layout: Layout, classes: int) -> None:
    for attempt in (
        lambda: tell_layout({"o": output}, W, H, classes),
        lambda: decode(layout, {"o": output}, W, H),
        lambda: decode(Layout.DETR, {"boxes": output, "logits": output}, W, H),
    ):
        try:
            attempt()
        except FileFormatError:
            continue


@given(
    st.lists(st.tuples(st.floats(0, 90), st.floats(0, 60), st.floats(1, 30), st.floats(1, 30)), max_size=12), st.data()
)
def test_suppression_keeps_one_of_each_cluster(boxes: list[tuple[float, ...]], data: st.DataObject) -> None:
    corners = np.array([(x, y, x + w, y + h) for x, y, w, h in boxes]).reshape(-1, 4)
    scores = np.array(data.draw(st.lists(st.floats(0, 1), min_size=len(boxes), max_size=len(boxes))))
    classes = np.zeros(len(boxes), np.int64)
    kept = suppress(corners, scores, classes, 0.5)
    assert list(scores[kept]) == sorted(scores[kept], reverse=True)
    twice = suppress(corners[kept], scores[kept], classes[kept], 0.5)
    assert list(twice) == list(range(len(kept)))
    assert (len(kept) > 0) == (len(boxes) > 0)
