"""Small ONNX files whose outputs are constants, in the layouts of real exports; decoded by the tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper


def write(
    path: Path,
    outputs: Mapping[str, Any],
    *,
    shape: Sequence[int | str] = (1, 3, 64, 96),
    kind: int = TensorProto.FLOAT,
    metadata: Mapping[str, str] | None = None,
    sizes: bool = False,
) -> Path:
    """Write a network that returns the outputs, whatever the image."""
    inputs = [helper.make_tensor_value_info("images", kind, list(shape))]
    if sizes:
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [1, 2]))
    nodes, infos = [], []
    for name, value in outputs.items():
        array = np.asarray(value)
        nodes.append(helper.make_node("Constant", [], [name], value=numpy_helper.from_array(array)))
        infos.append(
            helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(array.dtype), list(array.shape))
        )
    graph = helper.make_graph(nodes, "constants", inputs, infos)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    path.write_bytes(model.SerializeToString())
    return path
