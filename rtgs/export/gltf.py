"""GLB files: Gaussians by KHR_gaussian_splatting, and the glass as a mesh of a material that lets light pass.

Of the extension (Khronos): a primitive of points with ROTATION (x y z w, unit), SCALE (linear, as its writers have it
since 2026), OPACITY (0 to 1) and SH_DEGREE_d_COEF_n, in the order and with the signs of 3DGS; COLOR_0 for programs that
show points only. glTF is +Y up: the node over all turns the frame of the capture, whose numbers stay as they are.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rtgs.core.documents import DocumentError, parse_json
from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.export.glass import GlassObject
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import sh_dc_to_rgb
from rtgs.gaussians.ply import THICKEST_LOG_SCALE, THIRD_LOG_SCALE
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels

SPLATS = "KHR_gaussian_splatting"
GLASS = ("KHR_materials_transmission", "KHR_materials_ior", "KHR_materials_volume")
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_OPACITY_LOGIT = 18.0  # sigmoid of more is 1 in float32
_SMALLEST_SCALE = 1e-20  # what a scale of 0 is read as


@dataclass(frozen=True)
class Glb:
    """What a file holds.

    Attributes:
        splats: in the frame of the capture.
        turn: (3, 3) from there to +Y up.
        vertices, faces: (V, 3) float32 and (F, 3) uint32 of the glass; without rows where there is none.
    """

    splats: Surfels | Ellipsoids
    turn: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray


def write_glb(
    path: Path, splats: Surfels | Ellipsoids, frame: np.ndarray | None = None, glass: GlassObject | None = None
) -> None:
    """Write Gaussians, and the glass if there is any.

    Parameters
    ----------
    path : Path
        Replaced in one step.
    splats : Surfels or Ellipsoids
        Their channels are left out.
    frame : (3, 3) array, optional
        Rows right, up and backward in the frame of the capture; None: its y is up.
    glass : GlassObject, optional
        What light passes through.
    """
    file = _File()
    primitive = {
        "attributes": {name: file.add(values, *kind) for name, (values, *kind) in _attributes(splats).items()},
        "mode": 0,
        "extensions": {
            SPLATS: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    turn = np.eye(3) if frame is None else np.asarray(frame, float)
    quaternion = [float(value) for value in Rotation.from_matrix(turn).as_quat()]
    nodes: list[dict[str, Any]] = [{"name": "capture", "rotation": quaternion, "children": [1]}]
    nodes.append({"name": "splats", "mesh": 0})
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "rtgs"},
        "extensionsUsed": [SPLATS],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"name": "splats", "primitives": [primitive]}],
    }
    if glass is not None:
        nodes[0]["children"].append(2)
        nodes.append({"name": "glass", "mesh": 1})
        document["extensionsUsed"] += GLASS
        document["materials"] = [_material(glass)]
        attributes = {"POSITION": file.add(glass.vertices, "VEC3"), "NORMAL": file.add(glass.normals, "VEC3")}
        indices = file.add(glass.faces.astype(np.uint32).reshape(-1), "SCALAR", _INDEX)
        surface = {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}
        document["meshes"].append({"name": "glass", "primitives": [surface]})
    file.write(path, document)


def read_glb(path: Path) -> Glb:
    """Read the Gaussians, and the first mesh of triangles, of a file with float attributes and a buffer of its own.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: no GLB, damaged, without Gaussians of the extension, or values that are NaN, inf or out of range.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return _Reader(path.read_bytes()).glb()
    except (DocumentError, KeyError, IndexError, TypeError, ValueError, AttributeError, struct.error) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise RtgsError(f"{path} is no GLB with Gaussians that can be read: {what[:300]}") from error


def _attributes(splats: Surfels | Ellipsoids) -> Mapping[str, tuple]:
    """Arrays of the primitive, their type, and their component type where it is no float."""
    scales = splats.log_scales.detach()
    if scales.shape[1] == 2:
        scales = torch.nn.functional.pad(scales, (0, 1), value=THIRD_LOG_SCALE)
    quaternions = unit_or_zero(splats.quaternions.detach())
    quaternions = torch.where(quaternions.any(1, keepdim=True), quaternions, torch.tensor([1.0, 0, 0, 0]))
    opacity = splats.opacity_logits.detach().sigmoid()
    shown = torch.cat((sh_dc_to_rgb(splats.sh_dc.detach()), opacity[:, None]), 1)
    found: dict[str, tuple] = {
        "POSITION": (_array(splats.means), "VEC3"),
        "COLOR_0": ((shown.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), "VEC4", _BYTE),
        f"{SPLATS}:ROTATION": (_array(quaternions[:, [1, 2, 3, 0]]), "VEC4"),
        f"{SPLATS}:SCALE": (_array(scales.exp()), "VEC3"),
        f"{SPLATS}:OPACITY": (_array(opacity), "SCALAR"),
        _coefficient(0, 0): (_array(splats.sh_dc), "VEC3"),
    }
    for degree in range(1, splats.sh_degree + 1):
        for number in range(2 * degree + 1):
            rows = splats.sh_rest[:, degree * degree - 1 + number]
            found[_coefficient(degree, number)] = (_array(rows), "VEC3")
    return found


def _coefficient(degree: int, number: int) -> str:
    return f"{SPLATS}:SH_DEGREE_{degree}_COEF_{number}"


def _array(values: Tensor) -> np.ndarray:
    return values.detach().float().contiguous().numpy()


def _material(glass: GlassObject) -> dict[str, Any]:
    """Thin walls: what is behind is seen straight through, as the model does."""
    return {
        "name": "glass",
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*glass.tint, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": glass.roughness,
        },
        "extensions": dict(zip(GLASS, ({"transmissionFactor": 1.0}, {"ior": glass.index}, {"thicknessFactor": 0.0}))),
    }


class _File:
    """Arrays one after another in the buffer, each with a view and an accessor of its own."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._length = 0

    def add(self, values: np.ndarray, kind: str, component: int = _FLOAT) -> int:
        data = np.ascontiguousarray(values).tobytes()
        target = 34963 if component == _INDEX else 34962
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data), "target": target}
        accessor = {"bufferView": len(self._views), "componentType": component, "count": len(values), "type": kind}
        if component == _BYTE:
            accessor["normalized"] = True
        if kind == "VEC3" and len(values):
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self._views.append(view)
        self._accessors.append(accessor)
        self._parts.append(data + bytes(-len(data) % 4))
        self._length += len(self._parts[-1])
        return len(self._accessors) - 1

    def write(self, path: Path, document: dict[str, Any]) -> None:
        document |= {"accessors": self._accessors, "bufferViews": self._views}
        document["buffers"] = [{"byteLength": self._length}]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self._length
        with whole_file(path) as partial, partial.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, 2, total))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", self._length, _BIN))
            file.writelines(self._parts)


class _Reader:
    """One file. Every length is held against the bytes that are there."""

    def __init__(self, data: bytes) -> None:
        magic, version, total = struct.unpack_from("<III", data)
        if magic != _MAGIC or version != 2:
            raise ValueError("its first bytes are not those of glTF 2")
        if total != len(data):
            raise ValueError(f"it says that it has {total} bytes, and has {len(data)}")
        text = self._chunk(data, 12, _JSON)
        self._buffer = self._chunk(data, 20 + len(text), _BIN)
        self._document = parse_json(text.decode("utf-8"))

    @staticmethod
    def _chunk(data: bytes, at: int, kind: int) -> bytes:
        length, found = struct.unpack_from("<II", data, at)
        if found != kind or at + 8 + length > len(data):
            raise ValueError(f"the chunk at byte {at} is of another kind or longer than the file")
        return data[at + 8 : at + 8 + length]

    def glb(self) -> Glb:
        primitives = [each for mesh in self._document["meshes"] for each in mesh["primitives"]]
        splats = next((each for each in primitives if SPLATS in each.get("extensions", {})), None)
        if splats is None:
            raise ValueError(f"no primitive has {SPLATS}")
        vertices, faces = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
        surface = next((each for each in primitives if each.get("mode", 4) == 4), None)
        if surface is not None:
            vertices = self._values(surface["attributes"]["POSITION"], 3)
            faces = self._indices(surface["indices"], len(vertices))
        return Glb(self._splats(splats["attributes"]), self._turn(), vertices, faces)

    def _turn(self) -> np.ndarray:
        quaternion = np.array(self._document["nodes"][0].get("rotation", (0.0, 0.0, 0.0, 1.0)), float)
        if quaternion.shape != (4,) or not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
            raise ValueError(f"the rotation {quaternion.tolist()} is no unit quaternion")
        return Rotation.from_quat(quaternion).as_matrix()

    def _splats(self, attributes: Mapping[str, int]) -> Surfels | Ellipsoids:
        means = self._values(attributes["POSITION"], 3)
        degree = max(k for k in range(4) if k == 0 or _coefficient(k, 0) in attributes)
        names = [_coefficient(k, number) for k in range(1, degree + 1) for number in range(2 * k + 1)]
        rest = [self._values(attributes[name], 3) for name in names]
        scales = self._values(attributes[f"{SPLATS}:SCALE"], 3)
        opacity = self._values(attributes[f"{SPLATS}:OPACITY"], 1)[:, 0]
        if (scales < 0).any() or (opacity < 0).any() or (opacity > 1).any():
            raise ValueError("a scale is negative, or an opacity not between 0 and 1")
        log_scales = np.log(np.maximum(scales, _SMALLEST_SCALE))
        flat = bool((log_scales[:, 2] <= THICKEST_LOG_SCALE).all())
        columns = {
            "means": means,
            "log_scales": log_scales[:, :2] if flat else log_scales,
            "quaternions": self._values(attributes[f"{SPLATS}:ROTATION"], 4)[:, [3, 0, 1, 2]],
            "opacity_logits": _logits(opacity),
            "sh_dc": self._values(attributes[_coefficient(0, 0)], 3),
            "sh_rest": np.stack(rest, 1) if rest else np.zeros((len(means), 0, 3)),
        }
        if unequal := [name for name, values in columns.items() if len(values) != len(means)]:
            raise ValueError(f"{unequal[0]} has {len(columns[unequal[0]])} rows, there are {len(means)} positions")
        kind = Surfels if flat else Ellipsoids
        rows = {name: torch.from_numpy(np.ascontiguousarray(v, dtype=np.float32)) for name, v in columns.items()}
        return kind.of(rows)

    def _values(self, number: int, columns: int) -> np.ndarray:
        """(N, columns) finite floats of an accessor."""
        found = self._raw(number, columns, _FLOAT, "<f4")
        if not np.isfinite(found).all():
            raise ValueError(f"accessor {number} holds NaN or inf")
        return found.astype(np.float32)

    def _indices(self, number: int, vertices: int) -> np.ndarray:
        found = self._raw(number, 1, _INDEX, "<u4").reshape(-1)
        if len(found) % 3 or (len(found) and int(found.max()) >= vertices):
            raise ValueError(f"accessor {number} holds no triangles of {vertices} vertices")
        return found.astype(np.uint32).reshape(-1, 3)

    def _raw(self, number: int, columns: int, component: int, dtype: str) -> np.ndarray:
        accessor = self._document["accessors"][_index(number)]
        view = self._document["bufferViews"][_index(accessor["bufferView"])]
        if accessor["componentType"] != component or _COLUMNS.get(accessor["type"]) != columns:
            raise ValueError(f"accessor {number} is {accessor['type']} of type {accessor['componentType']}")
        if accessor.get("sparse") is not None or view.get("byteStride", 4 * columns) != 4 * columns:
            raise ValueError(f"accessor {number} is sparse or strided")
        count, first = _index(accessor["count"]), _index(accessor.get("byteOffset", 0))
        start = _index(view.get("byteOffset", 0))
        if first + 4 * count * columns > _index(view["byteLength"]) or start + view["byteLength"] > len(self._buffer):
            raise ValueError(f"accessor {number} reaches over the end of its bytes")
        return np.frombuffer(self._buffer, dtype, count * columns, start + first).reshape(count, columns)


def _index(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{str(value)[:40]} is no whole number from 0 on")
    return value


def _logits(opacity: np.ndarray) -> np.ndarray:
    """Of float32 opacities; 0 and 1 are those that float32 cannot tell from them."""
    values = opacity.astype(np.float64).clip(1e-30, 1 - 1e-12)
    return np.log(values / (1 - values)).clip(-math.inf, _OPACITY_LOGIT)
