"""SPZ, Niantic's packed splats, version 3: one gzip stream, 19 bytes a Gaussian and one for each SH number.

After a header of 16 bytes (magic, version, count, SH degree, fractional bits, flags) one section follows another:
positions in 24-bit fixed point, opacities, SH of degree 0 (0.15 a unit), log-scales (16 a unit, from -10), quaternions
(the largest component left out, 10 bits for each other), SH (128 a unit). Axes are right, up, backward where those of
a capture are right, down, forward: y and z change their signs. What is beyond a range is put at its end, so surfels
come back as surfels, exp(-10) thick in other programs.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
import torch

from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import rest_count, sh_basis
from rtgs.gaussians.ply import THICKEST_LOG_SCALE, THIRD_LOG_SCALE
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import Surfels

_HEADER = struct.Struct("<IIIBBBB")
_MAGIC, _VERSION = 0x5053474E, 3
_MOST_BITS = 20  # after the point; 12 in most files
_COLOR, _SCALE, _LOWEST_SCALE, _SH = 0.15 * 255, 16.0, -10.0, 128.0
_STEPS = 511  # of a quaternion's component, up to the square root of a half
MOST_GAUSSIANS = 20_000_000
_TURNED = torch.tensor([1.0, -1.0, -1.0])  # right, down, forward to right, up, backward


def write_spz(path: Path, splats: Surfels | Ellipsoids) -> None:
    """Write Gaussians without their channels; an existing file is replaced in one step.

    Raises:
        RtgsError: a position is beyond the format's range (8.4 million world units).
    """
    means = (splats.means.detach() * _TURNED).double().numpy()
    farthest = float(np.abs(means).max(initial=1e-9))
    bits = min(_MOST_BITS, int(np.floor(np.log2((2**23 - 1) / farthest))))
    if bits < 0:
        raise RtgsError(f"{path} is not written: a position of {farthest:g} is beyond what SPZ can say")
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    sections = (
        fixed.reshape(-1, 1).view(np.uint8)[:, :3],
        _bytes(splats.opacity_logits.detach().sigmoid().numpy() * 255),
        _bytes(splats.sh_dc.detach().numpy() * _COLOR + 127.5),
        _bytes((_three_scales(splats) - _LOWEST_SCALE) * _SCALE),
        _packed(splats),
        _bytes((splats.sh_rest.detach() * _signs(splats.sh_degree)).numpy() * _SH + 128),
    )
    header = _HEADER.pack(_MAGIC, _VERSION, len(splats), splats.sh_degree, bits, 0, 0)
    body = header + b"".join(np.ascontiguousarray(section).tobytes() for section in sections)
    with whole_file(path) as partial:
        partial.write_bytes(gzip.compress(body, 9, mtime=0))


def read_spz(path: Path) -> Surfels | Ellipsoids:
    """Read a file of version 3.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: no SPZ, of another version, cut, or longer than its header says.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return _read(path)
    except (ValueError, OSError, EOFError, zlib.error, struct.error) as error:
        raise RtgsError(f"{path} is no SPZ file that can be read: {error}") from error


def _read(path: Path) -> Surfels | Ellipsoids:
    with gzip.open(path) as file:
        header = file.read(_HEADER.size)
        magic, version, count, degree, bits, _, _ = _HEADER.unpack(header)
        if magic != _MAGIC or version != _VERSION:
            raise ValueError(
                f"it begins with {header[:8].hex()}, not as version {_VERSION}; splat-transform converts it"
            )
        if degree > 3 or bits > 24 or not 0 < count <= MOST_GAUSSIANS:
            raise ValueError(f"{count} Gaussians of SH degree {degree}, {bits} fractional bits")
        rest = rest_count(degree)
        widths = (9, 1, 3, 3, 4, 3 * rest)
        length = count * sum(widths)
        data = file.read(length + 1)  # gives no more than there is, whatever the header says
    if len(data) != length:
        raise ValueError(
            f"{len(data)} bytes of at least {length} follow" if len(data) < length else "more bytes follow"
        )
    ends = np.cumsum([count * width for width in widths])
    places, opacity, color, scale, turn, sh = (
        np.frombuffer(data, np.uint8, count * width, end - count * width).reshape(count, width)
        for width, end in zip(widths, ends)
    )
    wide = np.zeros((count * 3, 4), np.uint8)
    wide[:, 1:] = places.reshape(-1, 3)
    means = wide.view("<i4").reshape(count, 3) // 256 / 2.0**bits
    alpha = (opacity[:, 0].astype(np.float64) / 255).clip(1e-6, 1 - 1e-6)
    log_scales = scale / _SCALE + _LOWEST_SCALE
    flat = bool((log_scales[:, 2] <= THICKEST_LOG_SCALE).all())
    kind = Surfels if flat else Ellipsoids
    return kind(
        means=_tensor(means) * _TURNED,
        log_scales=_tensor(log_scales[:, :2] if flat else log_scales),
        quaternions=_unpacked(turn),
        opacity_logits=_tensor(np.log(alpha / (1 - alpha))),
        sh_dc=_tensor((color - 127.5) / _COLOR),
        sh_rest=_tensor((sh.reshape(count, rest, 3) - 128.0) / _SH) * _signs(degree),
    )


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _three_scales(splats: Surfels | Ellipsoids) -> np.ndarray:
    scales = splats.log_scales.detach()
    return torch.nn.functional.pad(scales, (0, 3 - scales.shape[1]), value=THIRD_LOG_SCALE).numpy()


def _signs(degree: int) -> torch.Tensor:
    """(K, 1) of the SH functions where y and z change their signs."""
    somewhere = torch.tensor([[0.36, 0.48, 0.8]])
    return torch.sign(sh_basis(somewhere, degree) * sh_basis(somewhere * _TURNED, degree)).T


def _packed(splats: Surfels | Ellipsoids) -> np.ndarray:
    """(N, 4) bytes: index of the largest component of x y z w, then sign and size of each other one."""
    w, x, y, z = unit_or_zero(splats.quaternions.detach().double()).T.numpy()
    found = np.stack((x, -y, -z, w), 1)
    found[~found.any(1)] = (0, 0, 0, 1)
    largest = np.abs(found).argmax(1)
    found *= np.where(np.take_along_axis(found, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for axis in range(4):
        size = np.rint(np.abs(found[:, axis]) * np.sqrt(2) * _STEPS).clip(0, _STEPS).astype(np.uint32)
        part = (packed << 10) | ((found[:, axis] < 0).astype(np.uint32) << 9) | size
        packed = np.where(axis == largest, packed, part)
    return packed.astype("<u4").reshape(-1, 1).view(np.uint8)


def _unpacked(turn: np.ndarray) -> torch.Tensor:
    """(N, 4) w x y z in the frame of the capture."""
    packed = np.ascontiguousarray(turn).view("<u4")[:, 0]
    largest = packed >> 30
    found = np.zeros((len(packed), 4))
    for axis in range(3, -1, -1):
        part = packed & 1023
        value = (part & 511) / _STEPS / np.sqrt(2) * np.where(part & 512, -1, 1)
        other = axis != largest
        found[:, axis] = np.where(other, value, 0)
        packed = np.where(other, packed >> 10, packed)
    missing = np.sqrt(np.maximum(1 - (found**2).sum(1), 0))
    np.put_along_axis(found, largest[:, None].astype(np.int64), missing[:, None], 1)
    return _tensor(found[:, [3, 0, 1, 2]] * np.array([1, 1, -1, -1]))
