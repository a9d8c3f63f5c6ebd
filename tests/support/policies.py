"""Policies as ONNX files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from skyloop.messages.rows import ACTIONS

NAMES = ["altitude_m", "yaw_rad"]
#: Forward by the red, left by the green, up by the altitude, yaw rate by the yaw.
MIXED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def write(
    path: Path,
    *,
    weights: Sequence[Sequence[float]] = MIXED,
    names: Any = NAMES,
    action: Any = ACTIONS["velocity"],
    picture: str = "observation.images.front",
    size: Sequence[Any] = (1, 3, 12, 16),
    more: Sequence[str] = (),
    output: str = "action",
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write a policy: the mean of each colour, and the state, times weights."""
    inputs = [helper.make_tensor_value_info(picture, TensorProto.FLOAT, list(size))]
    inputs += [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1]) for name in more]
    nodes = [
        helper.make_node("ReduceMean", [picture], ["means"], axes=[2, 3], keepdims=0),
        helper.make_node("MatMul", ["all" if names else "means", "weights"], [output]),
    ]
    if names:
        inputs.append(helper.make_tensor_value_info("observation.state", TensorProto.FLOAT, [1, len(names)]))
        nodes.insert(1, helper.make_node("Concat", ["means", "observation.state"], ["all"], axis=1))
    table = np.array(weights, np.float32)
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, table.shape[1]])]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, [numpy_helper.from_array(table, "weights")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    about = {"skyloop.state": json.dumps(names), "skyloop.action": json.dumps(action)}
    helper.set_model_props(model, about if metadata is None else metadata)
    path.write_bytes(model.SerializeToString())
    return path
