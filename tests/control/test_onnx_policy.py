"""A learned policy: its network's inputs, its set-points, and invalid files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from skyloop.client.frame import Frame
from skyloop.control import OnnxPolicy, PolicyNetwork, PolicyPhase
from skyloop.errors import FileFormatError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import Attitude, Feedback, Severity, Velocity
from skyloop.messages.rows import ACTIONS, STATE, set_point, state_row
from tests.control.recorder import Recorder, frame, state
from tests.support.policies import MIXED, NAMES, write


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return write(tmp_path / "policy.onnx")


@pytest.fixture
def drone() -> Recorder:
    return Recorder()


def fly(drone: Recorder, path: Path, **options: Any) -> OnnxPolicy:
    return OnnxPolicy(drone, path, **options)  # type: ignore[arg-type]


def test_the_input_is_red_green_blue_and_the_state_by_name(policy: Path) -> None:
    network = PolicyNetwork(policy)
    assert (network.camera, network.size, network.state, network.action) == (
        "front",
        (16, 12),
        ("altitude_m", "yaw_rad"),
        "velocity",
    )
    image = np.zeros((120, 160, 3), np.uint8)
    image[:, :, 2] = 255
    image[:, :, 1] = 51
    flown = network(image, [1.5, -0.5])
    assert isinstance(flown, Velocity)
    assert (flown.forward, flown.left, flown.up, flown.yaw_rate) == pytest.approx((1.0, 0.2, 1.5, -0.5))
    assert network(np.full((12, 16), 255, np.uint8), [0, 0]) == Velocity(1.0, 1.0), "a grey image"


def test_a_set_point_comes_from_the_image_and_the_state_at_its_capture(drone: Recorder, policy: Path) -> None:
    pilot = fly(drone, policy)
    assert pilot.camera == "front"
    pilot.on_frame(frame(1_000_000_000, []))
    (sent,) = drone.velocities
    assert sent["up"] == pytest.approx(1.0), "the altitude"
    assert 0 < sent["forward"] <= 1.0
    assert pilot.phase is PolicyPhase.FLYING
    assert drone.hovers == 0
    assert "forward +" in drone.drawn[0][0].text


def counting(
    path: Path, *, shape: Sequence[Any] = (1, 4), after: Sequence[int] = (1, 4), step: float = 1.0, output: str = ""
) -> Path:
    """Write a policy with a memory that counts images: its action is the count."""
    picture = helper.make_tensor_value_info("observation.images.front", TensorProto.FLOAT, [1, 3, 12, 16])
    memory = helper.make_tensor_value_info("memory", TensorProto.FLOAT, list(shape))
    output = output or "next_memory"
    weights = [numpy_helper.from_array(np.full((1, 4), step, np.float32), "step")]
    weights.append(numpy_helper.from_array(np.array(after), "after"))
    nodes = [
        helper.make_node("Add", ["memory", "step"], ["action"]),
        helper.make_node("Expand", ["action", "after"], [output]),
    ]
    outputs = [
        helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, 4]),
        helper.make_tensor_value_info(output, TensorProto.FLOAT, list(after)),
    ]
    graph = helper.make_graph(nodes, "policy", [picture, memory], outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {"skyloop.action": json.dumps(ACTIONS["velocity"])})
    path.write_bytes(model.SerializeToString())
    return path


def test_a_networks_memory_returns_with_the_next_image(tmp_path: Path) -> None:
    network = PolicyNetwork(counting(tmp_path / "policy.onnx"))
    image = np.zeros((12, 16), np.uint8)
    assert [network(image, []).yaw_rate for _ in range(3)] == [1, 2, 3]
    network.forget()
    assert network(image, []).yaw_rate == 1
    endless = PolicyNetwork(counting(tmp_path / "endless.onnx", step=3e38))
    assert [endless(image, []).finite for _ in range(3)] == [True, False, True], "NaN and infinity are forgotten"


def test_after_a_gap_in_the_frames_the_memory_restarts(drone: Recorder, tmp_path: Path) -> None:
    pilot = fly(drone, counting(tmp_path / "policy.onnx"))
    for at_s in (1.0, 1.1, 1.2, 1.8):
        pilot.on_frame(frame(round(at_s * 1e9), []))
    assert [sent["forward"] for sent in drone.velocities] == [1, 2, 3, 1]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"output": "kept"}, "both the input memory and the output next_memory, or neither"),
        ({"shape": (1, "n")}, "must take float32 of a fixed shape"),
        ({"shape": (1 << 21, 1)}, "at most 1048576 values"),
        ({"after": (2, 4)}, r"takes memory as \(1, 4\) and gives next_memory as \(2, 4\): the two must match"),
    ],
)
def test_an_unusable_memory_is_refused(tmp_path: Path, how: dict[str, Any], words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        PolicyNetwork(counting(tmp_path / "policy.onnx", **how))


def test_it_hovers_while_a_needed_value_is_missing(drone: Recorder, tmp_path: Path) -> None:
    pilot = fly(drone, write(tmp_path / "policy.onnx"))
    pilot.on_frame(frame(1_000_000_000, [], known=False))
    assert (drone.velocities, drone.hovers) == ([], 1)
    pilot.on_frame(frame(1_100_000_000, []))
    assert len(drone.velocities) == 1
    pilot.on_frame(frame(1_200_000_000, [], known=False))
    missing = "policy: the drone does not report all values that the policy needs: hovering"
    assert drone.told[-1] == (missing, Severity.WARNING)


def test_it_hovers_if_the_state_is_much_older_than_the_image(
    drone: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pilot = fly(drone, write(tmp_path / "policy.onnx"))
    monkeypatch.setattr(Frame, "feedback", state(1_400_000_000))
    pilot.on_frame(frame(2_000_000_000, []))
    assert (drone.velocities, drone.hovers, pilot.phase) == ([], 1, PolicyPhase.NO_STATE)


def test_it_hovers_if_the_action_is_not_finite(drone: Recorder, tmp_path: Path) -> None:
    pilot = fly(drone, write(tmp_path / "policy.onnx", weights=[[float("nan")] * 4] * 5))
    pilot.on_frame(frame(1_000_000_000, []))
    assert (drone.velocities, drone.hovers, pilot.phase) == ([], 1, PolicyPhase.NO_ACTION)


def test_a_policy_may_fly_by_attitude_and_without_state(tmp_path: Path) -> None:
    path = write(tmp_path / "policy.onnx", names=[], weights=MIXED[:3], action=ACTIONS["attitude"])
    network = PolicyNetwork(path)
    assert network.state == ()
    assert network(np.full((12, 16, 3), 255, np.uint8), []) == Attitude(1.0, 1.0)
    with pytest.raises(UsageError, match=r"takes no observation\.state: leave state out"):
        PolicyNetwork(path, state=NAMES)


def test_names_can_be_given_if_the_file_has_none(tmp_path: Path) -> None:
    path = write(tmp_path / "policy.onnx", metadata={})
    network = PolicyNetwork(path, state=NAMES, action="velocity")
    assert network.state == tuple(NAMES)
    with pytest.raises(FileFormatError, match=r"skyloop\.state in its metadata: give state="):
        PolicyNetwork(path)
    with pytest.raises(FileFormatError, match=r"skyloop\.action in its metadata: give action="):
        PolicyNetwork(path, state=NAMES)
    with pytest.raises(UnknownNameError, match="altitude"):
        PolicyNetwork(path, state=["altitude", "yaw_rad"], action="velocity")
    with pytest.raises(UnknownNameError, match="position"):
        PolicyNetwork(path, state=NAMES, action="position")
    with pytest.raises(FileFormatError, match=r"not \(1, 3\)"):
        PolicyNetwork(path, state=[*NAMES, "roll_rad"], action="velocity")


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"picture": "image"}, "must have one image"),
        ({"more": ["noise"]}, "the inputs .*noise"),
        ({"size": (1, 3, "height", 16)}, "must take float32"),
        ({"size": (1, 3, 5000, 16)}, "at most 4096"),
        ({"output": "logits"}, "one output with the name action"),
        ({"action": ["forward"]}, "names the action forward"),
        ({"action": "velocity"}, "no JSON list of names as skyloop.action"),
        ({"metadata": {"skyloop.state": "[" * 10_000}}, "no JSON list of names as skyloop.state"),
        ({"weights": [row[:3] for row in MIXED]}, "a set-point of velocity has 4 numbers .* not 3"),
    ],
)
def test_files_that_are_not_policies_are_refused(tmp_path: Path, how: dict[str, Any], words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        PolicyNetwork(write(tmp_path / "policy.onnx", **how))


def test_missing_files_and_values_out_of_range_are_refused(
    drone: Recorder, tmp_path: Path, policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match="there is no file"):
        PolicyNetwork(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    with pytest.raises(FileFormatError, match="can't be loaded as an ONNX file"):
        PolicyNetwork(tmp_path / "bad.onnx")
    with pytest.raises(UsageError, match="threads is 0"):
        PolicyNetwork(policy, threads=0)
    with pytest.raises(UnknownNameError, match="left"):
        fly(drone, policy, camera="left")
    assert fly(drone, policy, camera="bottom").camera == "bottom"
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match="skyloop install detect"):
        PolicyNetwork(policy)


def test_rows_have_the_numbers_by_name_or_none() -> None:
    known = msgspec.structs.replace(state(1), altitude_m=2.0, velocity_m_s=(0.1, 0.2, 0.3))
    assert state_row(known, STATE) == [0.0, 0.0, 0.0, 2.0, 0.1, 0.2, 0.3]
    assert state_row(Feedback(captured_ns=1), ["velocity_up_m_s"]) is None
    assert state_row(Feedback(captured_ns=1), []) == []
    with pytest.raises(UnknownNameError, match="height"):
        state_row(known, ["height"])
    assert set_point("attitude", [0.1, 0.2, 0.3, 0.4]) == Attitude(0.1, 0.2, 0.3, 0.4)
    with pytest.raises(UsageError, match="has 4 numbers"):
        set_point("velocity", [1.0])
