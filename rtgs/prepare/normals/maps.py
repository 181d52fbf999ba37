"""Monocular normals: a declared adapter around an ONNX network, one canonical form of the result, and a check of it
against the points and cameras of the capture.

Canonical: (H, W, 3) float, unit, camera frame x right, y down, z forward, pointing at the camera (n . ray < 0).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtgs.core.files import whole_file
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.normals.adapters import NormalAdapter
from rtgs.prepare.onnx import Network
from rtgs.scenes.images import unit_or_zero
from rtgs.scenes.undistort import Lens, project

_ENOUGH = 50  # points on flat surfaces that a verdict on the axes rests on at the least


@dataclass(frozen=True)
class _Fitted:
    """A picture as the network takes it, and which part of it is the photo."""

    pixels: np.ndarray  # (h, w, 3) in 0..1
    rows: slice
    columns: slice


def predict_normals(network: Network, adapter: NormalAdapter, photo: np.ndarray, calibration: np.ndarray) -> np.ndarray:
    """Canonical normals (H, W, 3) float32 of a photo (H, W, 3) float32 in 0..1.

    Args:
        calibration: (3, 3) of the photo, pixel centres at i + 0.5; used by networks with an input for it.

    Raises:
        PrepareError: the network's ports do not fit the adapter, or its output is no normal map.
    """
    import cv2

    fitted = _fit(photo, adapter)
    picture = (fitted.pixels - np.asarray(adapter.mean, dtype=np.float32)) / np.asarray(adapter.std, dtype=np.float32)
    batch = picture[None] if adapter.channels_last else picture.transpose(2, 0, 1)[None]
    values = {network.input(adapter.input).name: batch.astype(np.float32)}
    if adapter.intrinsics and any(port.name == adapter.intrinsics for port in network.inputs):
        scale = np.array(
            [
                (fitted.columns.stop - fitted.columns.start) / photo.shape[1],
                (fitted.rows.stop - fitted.rows.start) / photo.shape[0],
                1.0,
            ]
        )
        moved = np.diag(scale) @ calibration
        moved[:2, 2] += (fitted.columns.start, fitted.rows.start)
        values[adapter.intrinsics] = moved[None].astype(np.float32)
    (output,) = network.run(values, [network.output(adapter.output).name])
    normals = canonical_normals(_channels(output, adapter, network, fitted.pixels.shape[:2]), adapter)
    normals = normals[fitted.rows, fitted.columns]
    if normals.shape[:2] != photo.shape[:2]:
        normals = cv2.resize(normals, (photo.shape[1], photo.shape[0]), interpolation=cv2.INTER_LINEAR)
    return unit_or_zero(normals)


def _fit(photo: np.ndarray, adapter: NormalAdapter) -> _Fitted:
    import cv2

    height, width = photo.shape[:2]
    if adapter.fit == "stretch":
        rows = columns = adapter.size
    else:
        limit = adapter.size / max(height, width)
        if adapter.fit == "pad":
            limit = min(adapter.box[0] / height, adapter.box[1] / width)
        else:
            limit = min(limit, 1.0)
        step = 1 if adapter.fit == "pad" else adapter.multiple
        rows, columns = (max(step, round(side * limit / step) * step) for side in (height, width))
    smaller = rows * columns < height * width
    pixels = cv2.resize(photo, (columns, rows), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    if adapter.fit != "pad":
        return _Fitted(pixels, slice(0, rows), slice(0, columns))
    box = np.empty((*adapter.box, 3), dtype=np.float32)
    box[:] = adapter.fill
    top, left = (adapter.box[0] - rows) // 2, (adapter.box[1] - columns) // 2
    box[top : top + rows, left : left + columns] = pixels
    return _Fitted(box, slice(top, top + rows), slice(left, left + columns))


def _channels(output: np.ndarray, adapter: NormalAdapter, network: Network, size: tuple[int, ...]) -> np.ndarray:
    """(h, w, 3) of a network's output, at the size of its input.

    Raises:
        PrepareError: another shape, or numbers that are not finite.
    """
    import cv2

    if output.ndim != 4 or output.shape[0] != 1 or output.shape[3 if adapter.channels_last else 1] < 3:
        raise PrepareError(
            f"{network.path} gives {network.output(adapter.output).name} of shape {output.shape}, normals are "
            "(1, 3, H, W): it is another model; set normals.adapter.output and channels_last"
        )
    maps = output[0][..., :3] if adapter.channels_last else output[0, :3].transpose(1, 2, 0)
    maps = np.ascontiguousarray(maps, dtype=np.float32)
    if not np.isfinite(maps).all():
        raise PrepareError(f"{network.path} gives NaN or inf: its mean, deviation or type do not fit the adapter")
    return maps if maps.shape[:2] == size else cv2.resize(maps, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)


def canonical_normals(channels: np.ndarray, adapter: NormalAdapter) -> np.ndarray:
    """Output channels (H, W, 3) as unit vectors in x right, y down, z forward; zero where shorter than a half.

    Raises:
        PrepareError: hardly any vector is about one long: the range is declared wrongly.
    """
    vectors = 2 * channels - 1 if adapter.unit_range else channels
    length = np.linalg.norm(vectors, axis=-1)
    share = float((np.abs(length - 1) < 0.3).mean())
    if share < 0.5:
        raise PrepareError(
            f"only {share:.0%} of the predicted normals are about one long (median {np.median(length):.2f}): "
            f"normals.adapter.unit_range={str(adapter.unit_range).lower()} seems wrong for this network"
        )
    return unit_or_zero(vectors @ adapter.matrix.T)


@dataclass(frozen=True)
class SurfaceSample:
    """Where the capture's points lie in a photo, and the surface normals estimated from their neighbours."""

    columns: np.ndarray  # (N,) pixels of the photo, int
    rows: np.ndarray
    normals: np.ndarray  # (N, 3) camera frame, pointing at the camera
    rays: np.ndarray  # (N, 3) unit, from the camera to the point


def surface_normals(points: np.ndarray, neighbours: int = 16, flatness: float = 0.1) -> np.ndarray:
    """Normals (P, 3) of points (P, 3) by the plane of their neighbours, sign open; zero where these are no plane.

    ``flatness``: largest thickness over the middle extent of the neighbours (ratio of standard deviations).
    """
    from scipy.spatial import KDTree

    if len(points) < neighbours:
        return np.zeros_like(points)
    _, near = KDTree(points).query(points, neighbours)
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("pni,pnj->pij", around, around))
    spread = np.sqrt(np.maximum(values, 0))
    flat = (spread[:, 0] < flatness * spread[:, 1]) & (spread[:, 1] > 0.2 * spread[:, 2])
    return np.where(flat[:, None], vectors[:, :, 0], 0.0)


def sample_surface(
    points: np.ndarray, normals: np.ndarray, rotation: np.ndarray, translation: np.ndarray, lens: Lens
) -> SurfaceSample:
    """The points (P, 3) with a normal that lie inside a photo; nearer ones do not hide others."""
    local = points @ rotation.T + translation
    known = (np.abs(normals).sum(axis=1) > 0) & (local[:, 2] > 1e-6)
    local, turned = local[known], normals[known] @ rotation.T
    column, row = np.floor(project(lens, local)).T
    with np.errstate(invalid="ignore"):
        inside = (column >= 0) & (row >= 0) & (column < lens.width) & (row < lens.height)
    rays = local / np.linalg.norm(local, axis=1, keepdims=True)
    turned = np.where(((turned * rays).sum(axis=1) > 0)[:, None], -turned, turned)
    return SurfaceSample(column[inside].astype(int), row[inside].astype(int), turned[inside], rays[inside])


@dataclass(frozen=True)
class AxisVerdict:
    """What the capture's geometry says of the declared axes."""

    samples: int
    agreement: float  # mean cosine between predicted and estimated normals, as declared
    best: tuple[str, ...]  # axes that agree best
    best_agreement: float
    facing: float  # share of the predicted normals that point at the camera

    @property
    def flipped(self) -> bool:
        """True when other axes agree clearly better, and there are enough samples to say so."""
        clear = self.best_agreement > 0.35 and self.best_agreement - self.agreement > 0.15
        return clear and self.samples >= _ENOUGH

    @property
    def message(self) -> str:
        """In words."""
        if self.samples < _ENOUGH:
            return f"normals not checked against the points: only {self.samples} points lie on flat enough surfaces"
        text = (
            f"predicted normals and the surfaces of {self.samples} points agree with a mean cosine of "
            f"{self.agreement:.2f}; {self.facing:.0%} of the normals point at the camera"
        )
        if self.flipped:
            return (
                f"{text}. With axes {list(self.best)} it would be {self.best_agreement:.2f}: the network's axes are "
                f"declared wrongly; set normals.axes=[{','.join(self.best)}]"
            )
        return text


def judge_axes(predicted: np.ndarray, samples: SurfaceSample, adapter: NormalAdapter) -> AxisVerdict:
    """Compare predicted canonical normals (N, 3) at the samples with the estimated ones, under every order and every
    sign of the axes (48; a mirrored frame is as likely as a turned one)."""
    known = np.linalg.norm(predicted, axis=1) > 0.5
    predicted, estimated, rays = predicted[known], samples.normals[known], samples.rays[known]
    if not len(predicted):
        return AxisVerdict(0, 0.0, adapter.axes, 0.0, 0.0)
    products = predicted.T @ estimated / len(predicted)  # [i, j]: mean of predicted axis i times estimated axis j
    agreement = best_score = float(np.trace(products))
    truly = ("+x", "+y", "+z")  # what the predicted x, y, z are
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            score = float(sum(sign * products[i, j] for i, (j, sign) in enumerate(zip(order, signs))))
            if score > best_score + 1e-9:
                truly = tuple(("+" if sign == 1 else "-") + "xyz"[j] for j, sign in zip(order, signs))
                best_score = score
    facing = float(((predicted * rays).sum(axis=1) < 0).mean())
    axes = tuple(_turned(truly["xyz".index(axis[1])], axis[0]) for axis in adapter.axes)
    return AxisVerdict(len(predicted), agreement, axes, best_score, facing)


def _turned(axis: str, sign: str) -> str:
    return ("+" if axis[0] == sign else "-") + axis[1]


def joined(parts: list[SurfaceSample]) -> SurfaceSample:
    """The samples of several photos as one."""
    return SurfaceSample(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("columns", "rows", "normals", "rays"))
    )


def save_normals(normals: np.ndarray, path: Path) -> None:
    """Write canonical normals as ``.npy`` of half floats (a thousandth of a radian), for
    :func:`rtgs.scenes.images.read_normals`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial, partial.open("wb") as stream:
        np.save(stream, normals.astype(np.float16))
