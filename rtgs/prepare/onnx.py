"""Networks as ONNX files: loaded through onnxruntime on the CPU, their inputs and outputs checked by name and shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.prepare.errors import PrepareError


@dataclass(frozen=True)
class Port:
    """An input or output of a graph."""

    name: str
    shape: tuple[int | None, ...]  # None: any size
    type: str  # onnxruntime's name, "tensor(float)"

    def __str__(self) -> str:
        return f"{self.name} ({', '.join('?' if size is None else str(size) for size in self.shape)})"


class Network:
    """One loaded graph."""

    def __init__(self, path: Path, threads: int = 0) -> None:
        """Load ``path``.

        Args:
            threads: of onnxruntime; 0: its own choice.

        Raises:
            PrepareError: no onnxruntime, or no readable ONNX file.
        """
        try:
            import onnxruntime
        except ImportError as error:
            raise PrepareError(
                f"{path.name} needs the package onnxruntime: pip install -e '.[prepare]' in the clone of rtgs, or "
                "bring the maps yourself"
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises kinds of its own, one for each defect
            raise PrepareError(
                f"{path} is no ONNX file onnxruntime can run ({_first_line(error)}): export or copy it again; "
                "`rtgs weights status` says how"
            ) from error
        self.path = path
        self.inputs = tuple(_port(item) for item in self._session.get_inputs())
        self.outputs = tuple(_port(item) for item in self._session.get_outputs())

    def input(self, name: str) -> Port:
        """The input of this name; the only one, or the first, for an empty name.

        Raises:
            PrepareError: there is none; lists what there is.
        """
        return self._find("input", name, self.inputs)

    def output(self, name: str) -> Port:
        """The output of this name; the first for an empty name.

        Raises:
            PrepareError: there is none; lists what there is.
        """
        return self._find("output", name, self.outputs)

    def _find(self, kind: str, name: str, ports: Sequence[Port]) -> Port:
        for port in ports:
            if not name or port.name == name:
                return port
        raise PrepareError(
            f"{self.path} has no {kind} {name!r}, but {', '.join(map(str, ports))}: it is another model, or exported "
            "with other names; set the adapter's names (docs/networks.md)"
        )

    def require(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Check that all names are there.

        Raises:
            PrepareError: as :meth:`input` and :meth:`output`.
        """
        for name in inputs:
            self.input(name)
        for name in outputs:
            self.output(name)

    def run(self, values: Mapping[str, np.ndarray], outputs: Sequence[str]) -> list[np.ndarray]:
        """The named outputs for inputs by name, converted to the types the graph wants.

        Raises:
            PrepareError: shapes do not fit.
        """
        feeds = {port.name: _as_type(values[port.name], port.type) for port in self.inputs if port.name in values}
        missing = [port.name for port in self.inputs if port.name not in values]
        if missing:
            raise PrepareError(
                f"{self.path} also wants {', '.join(missing)}: it is another model than the one declared"
            )
        try:
            result: Any = self._session.run(list(outputs), feeds)
        except Exception as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in feeds.items())
            raise PrepareError(
                f"{self.path} does not run on {shapes} ({_first_line(error)}): it wants "
                f"{', '.join(map(str, self.inputs))}; set the adapter's size or export it again"
            ) from error
        return [np.asarray(value) for value in result]


def _port(item: Any) -> Port:
    return Port(item.name, tuple(size if isinstance(size, int) else None for size in item.shape), item.type)


_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
    "tensor(uint8)": np.uint8,
}


def _as_type(value: np.ndarray, wanted: str) -> np.ndarray:
    return np.ascontiguousarray(value.astype(_TYPES.get(wanted, np.float32), copy=False))


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__
