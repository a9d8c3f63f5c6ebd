"""ONNX files that block or fill the process that loads them, and reports that dependencies might send about users."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from skyloop.control import PolicyNetwork
from skyloop.errors import FileFormatError
from skyloop.vision import LearnedTracker, OnnxDetector, onnx
from skyloop.vision.simulated import SIMULATED_WEIGHTS
from tests.support.policies import write as write_policy

pytestmark = pytest.mark.process
TRY_ALONE = onnx.try_alone  # taken before the other tests' shortcut replaces it


@pytest.fixture(autouse=True)
def limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx, "try_alone", TRY_ALONE)


def network(path: Path, nodes: list[Any], constants: dict[str, Any]) -> Path:
    """Write a network from an image of 4 x 4 pixels to a number, ``action``."""
    graph = helper.make_graph(
        [helper.make_node("ReduceMean", ["observation.images.front"], ["mean"], keepdims=0), *nodes],
        "hostile",
        [helper.make_tensor_value_info("observation.images.front", TensorProto.FLOAT, [1, 3, 4, 4])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.array(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    assert path.stat().st_size < 1000
    return path


def endless(path: Path) -> Path:
    """Write a network with a loop of 2^62 rounds."""
    info = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [info("i", TensorProto.INT64, []), info("go", TensorProto.BOOL, []), info("x", TensorProto.FLOAT, [])],
        [info("goes", TensorProto.BOOL, []), info("y", TensorProto.FLOAT, [])],
    )
    return network(
        path, [helper.make_node("Loop", ["n", "true", "mean"], ["action"], body=body)], {"n": 2**62, "true": True}
    )


def huge(path: Path) -> Path:
    """Write a network with a tensor of 8 GiB."""
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["much"]),
        helper.make_node("ReduceMean", ["much"], ["zero"], keepdims=0),
        helper.make_node("Add", ["mean", "zero"], ["action"]),
    ]
    return network(path, nodes, {"shape": [1 << 31, 1]})


def test_a_file_beside_a_network_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python searches the working directory first for modules in a child process that gets its program there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one])
    (tmp_path / "numpy.py").write_text("open('was_run', 'w')")
    write_policy(Path("policy.onnx"))
    PolicyNetwork("policy.onnx")
    assert not (tmp_path / "was_run").exists()


def test_a_user_with_low_limits_can_still_load_networks(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    write_policy(path)
    program = (
        "import resource, sys; from pathlib import Path; from skyloop.vision.onnx import try_alone;"
        "resource.setrlimit(resource.RLIMIT_CPU, (15, 15)); try_alone(Path(sys.argv[1]))"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=True, timeout=120)


def test_a_loop_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx, "CPU_S", 4)
    with pytest.raises(FileFormatError, match=r"endless\.onnx is refused: it takes more than 4 s.*signal"):
        PolicyNetwork(endless(tmp_path / "endless.onnx"))


def test_a_tensor_of_gigabytes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"huge\.onnx is refused: it takes more than .* 4 GiB"):
        PolicyNetwork(huge(tmp_path / "huge.onnx"))


@pytest.mark.parametrize("make", [endless, huge])
def test_weights_of_a_tracker_are_also_tried_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], Path]
) -> None:
    """OpenCV loads them, which has its own limits for some of this, and none for the rest."""
    pytest.importorskip("cv2")
    monkeypatch.setattr(onnx, "CPU_S", 4)
    with pytest.raises(FileFormatError, match=r"weights\.onnx (is refused|can't be loaded as the weights of)"):
        LearnedTracker(make(tmp_path / "weights.onnx"))


def test_a_file_that_is_not_a_network_is_reported_as_before(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(FileFormatError, match=r"text\.onnx can't be loaded as an ONNX file: "):
        OnnxDetector(tmp_path / "text.onnx")


def test_valid_networks_are_loaded_as_before(tmp_path: Path) -> None:
    assert PolicyNetwork(write_policy(tmp_path / "policy.onnx")).camera == "front"
    copied = tmp_path / "figures.onnx"
    copied.write_bytes(Path(SIMULATED_WEIGHTS).read_bytes())
    assert OnnxDetector(copied).size


@pytest.mark.skipif(not find_spec("onnxruntime"), reason="ONNX Runtime is not installed")
def test_no_dependency_reports(tmp_path: Path) -> None:
    """Each was imported, and a network loaded, with an empty home directory: only our files are in it."""
    code = (
        "import skyloop, os; from skyloop.cli.doctor import _extras; list(_extras());"
        "from skyloop.vision import OnnxDetector; from skyloop.vision.simulated import SIMULATED_WEIGHTS;"
        "OnnxDetector(SIMULATED_WEIGHTS); print(os.environ['RAY_USAGE_STATS_ENABLED'])"
    )
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "MPLCONFIGDIR": str(tmp_path / "mpl")}
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "RAY_"))}
    ended = subprocess.run([sys.executable, "-c", code], env=plain | home, check=True, capture_output=True, text=True)
    assert ended.stdout == "0\n"
    written = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()]
    assert not [name for name in written if not name.startswith(("mpl/", ".cache/matplotlib", ".cache/skyloop"))]
