"""PLY import and export of surfels in the layout of 3DGS, which the common viewers open.

Float32 vertex properties: x y z nx ny nz f_dc_0..2 f_rest_0..3K-1 opacity scale_0 scale_1 [scale_2] rot_0..3. Values
are raw (logit of opacity, log of scales, quaternion w x y z of any length); f_rest is channel-major: all
coefficients of red, then green, then blue.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import plyfile
import torch
from torch import Tensor

from rtgs.errors import RtgsError
from rtgs.gaussians.surfels import Surfels, tangents

THIRD_LOG_SCALE = math.log(1e-6)  # what viewers get as the thickness of a surfel
THICKEST_LOG_SCALE = -10.0  # a third scale above this is no surfel's
COMMENT = "surfels (2D Gaussians): scale_0, scale_1 along columns 0, 1 of the rotation"


def write_ply(path: str | Path, surfels: Surfels, third_scale: bool = True) -> None:
    """Write N surfels, binary little-endian; an existing file is replaced in one step.

    Args:
        third_scale: add the constant scale_2 = log(1e-6) that viewers of 3D Gaussians need; without it the file is the
            native two-scale one. :func:`read_ply` takes both and gives back the same bits.

    Raises:
        ValueError: a parameter holds NaN or inf.
    """
    path = Path(path)
    values = {name: tensor.detach() for name, tensor in surfels.items()}
    for name, tensor in values.items():
        if bad := int((~torch.isfinite(tensor)).sum()):
            raise ValueError(f"{path} is not written: {bad} values of {name} are NaN or inf")
    tangent_u, tangent_v = tangents(values["quaternions"])
    columns: dict[str, Tensor] = {}
    _add(columns, ("x", "y", "z"), values["means"])
    _add(columns, ("nx", "ny", "nz"), torch.linalg.cross(tangent_u, tangent_v, dim=1))
    _add(columns, _numbered("f_dc", 3), values["sh_dc"])
    rest = values["sh_rest"].transpose(1, 2).flatten(1)
    _add(columns, _numbered("f_rest", rest.shape[1]), rest)
    columns["opacity"] = values["opacity_logits"]
    _add(columns, _numbered("scale", 2), values["log_scales"])
    if third_scale:
        columns["scale_2"] = torch.full((len(surfels),), THIRD_LOG_SCALE)
    _add(columns, _numbered("rot", 4), values["quaternions"])

    vertices = np.empty(len(surfels), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column.numpy()
    element = plyfile.PlyElement.describe(vertices, "vertex")
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        plyfile.PlyData([element], text=False, byte_order="<", comments=[COMMENT]).write(str(partial))
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_ply(path: str | Path) -> Surfels:
    """Read surfels from a file of :func:`write_ply`, of 2DGS or of another tool with this layout (text or binary).

    Other properties, the normals among them, are ignored.

    Returns:
        Surfels, float32, without gradient.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: not a PLY, truncated, a property is missing, NaN or inf, or the Gaussians are not flat.
    """
    path = Path(path)
    vertices = _read_vertices(path)
    names = [p.name for p in vertices.properties if not isinstance(p, plyfile.PlyListProperty)]
    rest_count = sum(name.startswith("f_rest_") for name in names)
    if rest_count not in (0, 9, 24, 45):
        raise RtgsError(f"{path}: {rest_count} properties f_rest_*; SH of degree 0, 1, 2, 3 has 0, 9, 24, 45")

    def columns(*wanted: str) -> Tensor:
        if missing := [name for name in wanted if name not in names]:
            raise RtgsError(f"{path}: property {', '.join(missing)} missing; it has {', '.join(names) or 'none'}")
        out = np.empty((vertices.count, len(wanted)), np.float32)
        for k, name in enumerate(wanted):
            out[:, k] = vertices[name]
        if bad := np.flatnonzero(~np.isfinite(out).all(axis=1)).tolist():
            raise RtgsError(f"{path}: NaN or inf in {', '.join(wanted)} of {len(bad)} vertices, the first {bad[0]}")
        return torch.from_numpy(out)

    if "scale_2" in names and len(thick := (columns("scale_2") > THICKEST_LOG_SCALE).nonzero()):
        raise RtgsError(
            f"{path}: {len(thick)} of {vertices.count} Gaussians have a third scale (log > {THICKEST_LOG_SCALE:g}), "
            "so they are 3D Gaussians, not surfels; convert them first"
        )
    rest = columns(*_numbered("f_rest", rest_count)).reshape(vertices.count, 3, rest_count // 3)
    return Surfels(
        means=columns("x", "y", "z"),
        log_scales=columns(*_numbered("scale", 2)),
        quaternions=columns(*_numbered("rot", 4)),
        opacity_logits=columns("opacity").flatten(),
        sh_dc=columns(*_numbered("f_dc", 3)),
        sh_rest=rest.transpose(1, 2).contiguous(),
    )


def _add(columns: dict[str, Tensor], names: tuple[str, ...], values: Tensor) -> None:
    columns.update(zip(names, values.unbind(1), strict=True))


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{k}" for k in range(count))


def _read_vertices(path: Path) -> plyfile.PlyElement:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        ply = plyfile.PlyData.read(str(path))
    except (plyfile.PlyHeaderParseError, UnicodeDecodeError) as error:
        raise RtgsError(f"{path} is not a PLY file: {error}") from error
    except (plyfile.PlyParseError, ValueError, MemoryError, OverflowError) as error:
        raise RtgsError(f"{path} is damaged or truncated: {error}") from error
    if "vertex" not in ply:
        raise RtgsError(f"{path}: no element 'vertex'; it has {', '.join(e.name for e in ply.elements) or 'none'}")
    if (unread := _unread_bytes(path, ply)) > 0:
        raise RtgsError(
            f"{path} is damaged: {unread} bytes after the {ply['vertex'].count} vertices its header announces"
        )
    return ply["vertex"]


def _unread_bytes(path: Path, ply: plyfile.PlyData) -> int:
    """Bytes after the data of a binary file whose rows have one length (else 0: the parser has counted)."""
    if ply.text or any(isinstance(p, plyfile.PlyListProperty) for e in ply.elements for p in e.properties):
        return 0
    with path.open("rb") as file:
        while file.readline().strip() != b"end_header":
            pass
        header = file.tell()
    return path.stat().st_size - header - sum(e.count * e.data.dtype.itemsize for e in ply.elements)
