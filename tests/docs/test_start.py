"""The pages for newcomers: one program on all of them, and the steps that a block of code alone can't show."""

from __future__ import annotations

import importlib.util
import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import skyloop
from skyloop.control.loading import load_controller
from tests.support.pages import ROOT, Block, blocks

START = ROOT / "docs" / "start"
MOST_LINES = 130  # two screens of text, and a table of problems


def program(page: str) -> Block:
    """The page's first example in Python."""
    return next(block for block in blocks("python") if block.page == ROOT / page)


@pytest.mark.parametrize("page", ["docs/index.md", "docs/start/no-drone.md"])
def test_the_first_program_is_the_same_everywhere(page: str) -> None:
    def without_address(code: str) -> str:
        return re.sub(r'connect\("[^"]+"\).*', "connect()", code)

    assert without_address(program(page).code) == without_address(program("README.md").code)


def test_it_can_be_flown_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "follow.py").write_text(program("docs/start/no-drone.md").code)
    assert load_controller(tmp_path / "follow.py", None).__name__ == "Follow"


@pytest.mark.parametrize("page", sorted(START.glob("*.md")), ids=lambda page: page.stem)
def test_a_page_is_short_pictured_and_says_what_goes_wrong(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    if page.stem != "install":
        assert "## What goes wrong" in text
        assert "](../pictures/" in text


def test_a_webcam_finds_the_printed_marker(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a video that shows the marker; its frames end after a few."""
    pytest.importorskip("av")
    frames = skyloop.Drone.frames

    def few(self: skyloop.Drone, **how: Any) -> Iterator[skyloop.Frame]:
        for number, frame in enumerate(frames(self, timeout_s=30.0, **how)):
            yield frame
            if number == 4:
                return

    monkeypatch.setattr(skyloop.Drone, "frames", few)
    clip = tmp_path / "clip.mp4"
    film(clip)
    code = program("docs/start/webcam.md").code
    assert "video:///dev/video0?" in code
    exec(compile(code.replace("video:///dev/video0?", f"video://{clip}?loop=1&"), "see.py", "exec"), {})
    said = re.findall(r"marker 7: ([\d.]+) m ahead", capsys.readouterr().out)
    assert said
    assert all(float(metres) == pytest.approx(0.10 * 640 / 128, rel=0.05) for metres in said)


def film(path: Path) -> None:
    """A second of a marker whose black square is 128 of 640 pixels wide."""
    import av

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    picture = np.full((480, 640, 3), 255, np.uint8)
    picture[176:304, 256:384] = cv2.aruco.generateImageMarker(dictionary, 7, 128)[:, :, None]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height = 640, 480
        for _ in range(30):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())


def test_the_worked_example_of_learning_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """As printed it flew its lessons, and ended in a ModuleNotFoundError (issue 28, C7)."""
    real = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None if name == "torch" else real(name, *rest))
    with pytest.raises(SystemExit, match=r"needs torch.*: skyloop install all, and pip install torch onnx"):
        runpy.run_path(str(ROOT / "scripts" / "clone_follower.py"), run_name="__main__")
