"""ONNX graphs of a few nodes with the ports of the real networks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rtgs.prepare.normals.adapters import NormalAdapter


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


def color_reader(path: Path, adapter: NormalAdapter, blurred: bool = False, beside: tuple[str, ...] = ()) -> Path:
    """A "normal network" that reads canonical normals painted as (n + 1) / 2 and tells them its family's way.

    ``blurred``: the mean over its whole input, everywhere. ``beside``: outputs of one channel beside the normals.
    """
    weights, bias = reader_weights(adapter)
    picture = adapter.input or "image"
    inputs = [(picture, [1, 3, "h", "w"])]
    nodes = [helper.make_node("Conv", [picture, "weights", "bias"], ["told"])]
    last = "told"
    if blurred:
        nodes += [
            helper.make_node("GlobalAveragePool", ["told"], ["mean"]),
            helper.make_node("Mul", ["told", "nothing"], ["blank"]),
            helper.make_node("Add", ["blank", "mean"], ["even"]),
        ]
        last = "even"
    if adapter.intrinsics:
        inputs.append((adapter.intrinsics, [1, 3, 3]))
        nodes += [
            helper.make_node("ReduceSum", [adapter.intrinsics], ["sum"], keepdims=0),
            helper.make_node("Mul", ["sum", "nothing"], ["zero"]),
            helper.make_node("Add", [last, "zero"], ["moved"]),
        ]
        last = "moved"
    output = adapter.output or "normal"
    nodes.append(helper.make_node("Identity", [last], [output]))
    nodes += [helper.make_node("ReduceMax", ["told"], [name], axes=[1]) for name in beside]
    outputs = [(output, [1, 3, "h", "w"]), *((name, [1, 1, "h", "w"]) for name in beside)]
    constants = {"weights": weights, "bias": bias, "nothing": np.float32(0)}
    return save(path, nodes, inputs, outputs[::-1], constants)  # the normals are not the first


def reader_weights(adapter: NormalAdapter) -> tuple[np.ndarray, np.ndarray]:
    """1x1 convolution from the normalised picture to the family's numbers."""
    mean, std = np.asarray(adapter.mean), np.asarray(adapter.std)
    back = adapter.matrix.T.astype(np.float64)  # canonical to channels
    weights, bias = back * (2 * std), back @ (2 * mean - 1)
    if adapter.unit_range:
        weights, bias = weights / 2, bias / 2 + 0.5
    return weights[..., None, None].astype(np.float32), bias.astype(np.float32)
