"""ONNX graphs of a few nodes with the ports of the real networks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rtgs.prepare.adapters import NormalAdapter


def save(path: Path, nodes, inputs, outputs, constants: dict[str, np.ndarray]) -> Path:
    """Write a graph; inputs and outputs are (name, shape) or (name, shape, type)."""

    def port(name, shape, kind=TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, shape)

    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(
        nodes, "tiny", [port(*item) for item in inputs], [port(*item) for item in outputs], tensors
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(path))
    return path


def color_reader(path: Path, adapter: NormalAdapter, channels: int = 3, names=("image", "normal")) -> Path:
    """A "normal network" that reads canonical normals painted as (n + 1) / 2 and tells them its family's way."""
    weights, bias = reader_weights(adapter, channels)
    inputs = [(names[0], [1, 3, "h", "w"])]
    nodes = [helper.make_node("Conv", [names[0], "weights", "bias"], ["told"])]
    last = "told"
    if adapter.intrinsics:
        inputs.append((adapter.intrinsics, [1, 3, 3]))
        nodes += [
            helper.make_node("ReduceSum", [adapter.intrinsics], ["sum"], keepdims=0),
            helper.make_node("Mul", ["sum", "nothing"], ["zero"]),
            helper.make_node("Add", ["told", "zero"], ["moved"]),
        ]
        last = "moved"
    output = adapter.output or names[1]
    nodes.append(helper.make_node("Identity", [last], [output]))
    constants = {"weights": weights, "bias": bias, "nothing": np.float32(0)}
    return save(path, nodes, inputs, [(output, [1, channels, "h", "w"])], constants)


def reader_weights(adapter: NormalAdapter, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """1x1 convolution from the normalised picture to the family's numbers."""
    mean, std = np.asarray(adapter.mean), np.asarray(adapter.std)
    back = adapter.matrix.T.astype(np.float64)  # canonical to channels
    weights, bias = back * (2 * std), back @ (2 * mean - 1)
    if adapter.unit_range:
        weights, bias = weights / 2, bias / 2 + 0.5
    rest = channels - 3
    weights = np.concatenate([weights, np.zeros((rest, 3))])[..., None, None]
    return weights.astype(np.float32), np.concatenate([bias, np.full(rest, 7.0)]).astype(np.float32)
