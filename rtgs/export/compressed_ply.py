"""Compressed PLY, PlayCanvas' packed splats: 16 bytes a Gaussian, one for each SH number, bounds for each 256.

Positions and log-scales have 11, 10 and 11 bits between the bounds of their chunk, colours and opacity 8 each; of a
quaternion (w x y z) the largest component is left out and the others have 10 bits. SH: 8 bits from -4 to 4. Gaussians
are put into the order of a Morton curve, so that chunks are small.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
import torch

from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.core.ply_header import PlyHeaderError, check_ply
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import rest_count, rgb_to_sh_dc, sh_dc_to_rgb
from rtgs.gaussians.ply import RENDER_MODES, THICKEST_LOG_SCALE, THIRD_LOG_SCALE
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels

CHUNK = 256
_BITS = {"position": (11, 10, 11), "scale": (11, 10, 11), "color": (8, 8, 8)}
_BOUNDS = [
    f"{end}_{prefix}{axis}"
    for prefix, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    for end in ("min", "max")
    for axis in axes
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_RANGE = 8.0
_SCALE_LIMIT = 20.0


def write_compressed_ply(path: Path, splats: Surfels | Ellipsoids) -> None:
    """Write Gaussians without their channels; an existing file is replaced in one step.

    Raises:
        RtgsError: there is no Gaussian.
    """
    if not len(splats):
        raise RtgsError(f"{path} is not written: there is no Gaussian")
    order = _morton(splats.means.detach().numpy())
    rows = splats.like({name: values.detach()[torch.from_numpy(order)] for name, values in splats.items()})
    scales = torch.nn.functional.pad(rows.log_scales, (0, 3 - rows.log_scales.shape[1]), value=THIRD_LOG_SCALE)
    groups = {
        "position": rows.means.numpy(),
        "scale": scales.clamp(-_SCALE_LIMIT, _SCALE_LIMIT).numpy(),
        "color": sh_dc_to_rgb(rows.sh_dc).numpy(),
    }
    starts = np.arange(0, len(rows), CHUNK)
    chunk_of = np.arange(len(rows)) // CHUNK
    bounds, packed = [], {}
    for name, values in groups.items():
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        bounds += [low, high]
        reach = np.where(high > low, high - low, 1)[chunk_of]
        packed[name] = _joined((values - low[chunk_of]) / reach, _BITS[name])
    opacity = np.rint(rows.opacity_logits.sigmoid().numpy() * 255).astype(np.uint32)
    columns = (packed["position"], _packed(rows.quaternions), packed["scale"], packed["color"] << 8 | opacity)
    elements = [
        plyfile.PlyElement.describe(_table(np.concatenate(bounds, 1).T, _BOUNDS, "<f4"), "chunk"),
        plyfile.PlyElement.describe(_table(columns, _PACKED, "<u4"), "vertex"),
    ]
    if rows.sh_degree:
        rest = rows.sh_rest.transpose(1, 2).flatten(1).numpy().T
        levels = np.floor((rest / _SH_RANGE + 0.5) * 256).clip(0, 255)
        names = [f"f_rest_{number}" for number in range(len(levels))]
        elements.append(plyfile.PlyElement.describe(_table(levels, names, "u1"), "sh"))
    comments = [RENDER_MODES[isinstance(splats, Surfels)]]
    with whole_file(path) as partial:
        plyfile.PlyData(elements, text=False, byte_order="<", comments=comments).write(str(partial))


def read_compressed_ply(path: Path) -> Surfels | Ellipsoids:
    """Read a file of this layout, of any program.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: no such file, damaged, or with values that are NaN or inf.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        check_ply(path)
        return _gaussians_of(plyfile.PlyData.read(str(path)))
    except (PlyHeaderError, plyfile.PlyParseError, ValueError, KeyError, OSError, MemoryError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise RtgsError(f"{path} is no compressed PLY that can be read: {what}") from error


def _gaussians_of(ply: plyfile.PlyData) -> Surfels | Ellipsoids:
    vertex, count = ply["vertex"], ply["vertex"].count
    if not count or ply["chunk"].count != -(-count // CHUNK):
        raise ValueError(f"{ply['chunk'].count} chunks of {CHUNK} for {count} Gaussians")
    bounds = np.stack([np.asarray(ply["chunk"][name], np.float32) for name in _BOUNDS], 1).reshape(-1, 6, 3)
    if not np.isfinite(bounds).all():
        raise ValueError("bounds of a chunk are NaN or inf")
    position, rotation, scale, color = (np.asarray(vertex[name], np.uint32) for name in _PACKED)
    chunk_of = np.arange(count) // CHUNK

    def spread(packed: np.ndarray, name: str, first: int) -> torch.Tensor:
        low, high = bounds[chunk_of, first], bounds[chunk_of, first + 1]
        share = _parted(packed, _BITS[name])
        return _tensor(low * (1 - share) + high * share)

    scales = spread(scale, "scale", 2)
    flat = bool((scales[:, 2] <= THICKEST_LOG_SCALE).all())
    alpha = ((color & 255) / 255.0).clip(1e-6, 1 - 1e-6)
    found = {
        "means": spread(position, "position", 0),
        "log_scales": scales[:, :2].contiguous() if flat else scales,
        "quaternions": _unpacked(rotation),
        "opacity_logits": _tensor(np.log(alpha / (1 - alpha))),
        "sh_dc": rgb_to_sh_dc(spread(color >> 8, "color", 4)),
        "sh_rest": _rest(ply, count),
    }
    if bad := [name for name, values in found.items() if not bool(torch.isfinite(values).all())]:
        raise ValueError(f"{bad[0]} holds NaN or inf")
    return (Surfels if flat else Ellipsoids).of(found)


def _rest(ply: plyfile.PlyData, count: int) -> torch.Tensor:
    if "sh" not in ply:
        return torch.zeros(count, 0, 3)
    names = [each.name for each in ply["sh"].properties]
    if ply["sh"].count != count or len(names) not in (3 * rest_count(degree) for degree in (1, 2, 3)):
        raise ValueError(f"{ply['sh'].count} rows of {len(names)} SH numbers for {count} Gaussians")
    levels = np.stack([np.asarray(ply["sh"][f"f_rest_{k}"], np.float32) for k in range(len(names))], 1)
    share = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
    return _tensor((share - 0.5) * _SH_RANGE).reshape(count, 3, -1).transpose(1, 2).contiguous()


def _table(columns, names, dtype: str) -> np.ndarray:
    table = np.empty(len(columns[0]), dtype=[(name, dtype) for name in names])
    for name, column in zip(names, columns, strict=True):
        table[name] = column
    return table


def _joined(shares: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
    """(N,) numbers of three shares from 0 to 1, the first in the highest bits."""
    found = np.zeros(len(shares), np.uint32)
    for axis, width in enumerate(bits):
        most = (1 << width) - 1
        found = found << np.uint32(width) | np.rint(shares[:, axis] * most).clip(0, most).astype(np.uint32)
    return found


def _parted(packed: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
    columns = []
    for width in reversed(bits):
        columns.append((packed & np.uint32((1 << width) - 1)) / ((1 << width) - 1))
        packed = packed >> np.uint32(width)
    return np.stack(columns[::-1], 1)


def _packed(quaternions: torch.Tensor) -> np.ndarray:
    found = unit_or_zero(quaternions.double()).numpy().copy()
    found[~found.any(1)] = (1, 0, 0, 0)
    largest = np.abs(found).argmax(1)
    found *= np.where(np.take_along_axis(found, largest[:, None], 1) < 0, -1, 1)
    others = found[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest.astype(np.uint32) << 30 | _joined(others * np.sqrt(0.5) + 0.5, (10, 10, 10))


def _unpacked(packed: np.ndarray) -> torch.Tensor:
    others = (_parted(packed, (10, 10, 10)) - 0.5) / np.sqrt(0.5)
    missing = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    found = np.empty((len(packed), 4))
    largest = (packed >> 30)[:, None]
    found[np.arange(4) != largest] = others.reshape(-1)
    found[np.arange(4) == largest] = missing
    return _tensor(found)


def _morton(means: np.ndarray) -> np.ndarray:
    """Order of positions along a Morton curve, 10 bits an axis."""
    low = means.min(0)
    cells = ((means - low) / max(float((means - low).max()), 1e-12) * 1023).astype(np.int64)
    key = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return key.argsort(kind="stable")


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
