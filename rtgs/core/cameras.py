"""Pinhole cameras and pixel rays: the only place where a pixel centre or a camera axis is defined.

World frame: the capture's own (COLMAP world). Camera frame: x right, y down, z forward. Pixel (i, j), column i and
row j, has its centre at (i + 0.5, j + 0.5), COLMAP's convention.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Pixel rays of one camera in the world frame: x = origin + depth * directions."""

    origin: Tensor  # (3,) camera centre
    directions: Tensor  # (H, W, 3), camera-z component 1, so that depth is z-depth; not normalised


@dataclass(frozen=True)
class Pixels:
    """The pixels of one camera that points fall into."""

    index: Tensor  # (...,) int64 row * width + column; 0 where not framed
    depth: Tensor  # (...,) z-depth
    framed: Tensor  # (...,) bool: before the camera and inside the picture


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion (importers undistort).

    Parameters
    ----------
    rotation : (3, 3) Tensor
        Float64, world to camera: x_cam = R x + t.
    translation : (3,) Tensor
        t of the same, float64.
    fx, fy : float
        Focal lengths in pixels of the image; they may differ.
    cx, cy : float
        Principal point in pixels of the image; it may be off the centre.
    width, height : int
        Size of the image in pixels.
    name : str, optional
        For messages.

    Raises
    ------
    ValueError
        A shape is wrong, or a number is not finite or not positive.
    """

    rotation: Tensor
    translation: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", torch.as_tensor(self.rotation, dtype=torch.float64))
        object.__setattr__(self, "translation", torch.as_tensor(self.translation, dtype=torch.float64))
        if self.rotation.shape != (3, 3) or self.translation.shape != (3,):
            raise ValueError(
                f"camera {self.name!r}: rotation must be (3, 3) and translation (3,), "
                f"got {tuple(self.rotation.shape)} and {tuple(self.translation.shape)}"
            )
        if not (torch.isfinite(self.rotation).all() and torch.isfinite(self.translation).all()):
            raise ValueError(f"camera {self.name!r}: the pose holds NaN or inf; remove or re-register this image")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera {self.name!r}: image size {self.width}x{self.height} must be at least 1x1")
        if not (0 < self.fx < float("inf") and 0 < self.fy < float("inf")):
            raise ValueError(f"camera {self.name!r}: focal lengths fx={self.fx}, fy={self.fy} must be positive")
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise ValueError(
                f"camera {self.name!r}: principal point ({self.cx}, {self.cy}) must be finite; calibrate again"
            )

    @cached_property
    def center(self) -> Tensor:
        """(3,) camera centre in the world frame; not to be written into: asked again, it is the same tensor."""
        return -self.rotation.T @ self.translation

    def to_camera(self, points: Tensor) -> Tensor:
        """World points (..., 3) to the camera frame, in the dtype of ``points``."""
        return points @ self.rotation.T.to(points.dtype) + self.translation.to(points.dtype)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) to pixel coordinates (..., 2) and z-depth (...,)."""
        x, y, depth = self._image(self.to_camera(points))
        return torch.stack((x, y), dim=-1), depth

    def pixels(self, local: Tensor) -> Pixels:
        """The pixels of points (..., 3) in the camera frame (:meth:`to_camera`); of directions too, at infinity."""
        x, y, depth = self._image(local)
        column, row = x.floor(), y.floor()
        framed = (depth > 0) & (column >= 0) & (row >= 0) & (column < self.width) & (row < self.height)
        row, column = (torch.where(framed, each, 0.0).long() for each in (row, column))
        return Pixels(row * self.width + column, depth, framed)

    def _image(self, local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pixel coordinates x and y, and z-depth."""
        depth = local[..., 2]
        x = self.fx * local[..., 0] / depth + self.cx
        y = self.fy * local[..., 1] / depth + self.cy
        return x, y, depth

    def camera_rays(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """(H, W, 3) rays through the pixel centres in the camera frame, z component 1."""
        x, y = self._slopes()
        grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
        return torch.stack((grid_x, grid_y, torch.ones_like(grid_x)), dim=-1).to(dtype)

    def rays(self, dtype: torch.dtype = torch.float32) -> Rays:
        """Rays through the pixel centres in the world frame."""
        across, along = self.ray_tables()
        return Rays(self.center.to(dtype), (across + along[:, None]).to(dtype))

    def ray_tables(self) -> tuple[Tensor, Tensor]:
        """(W, 3) and (H, 3) float64, of columns and rows: their sums are the directions of :meth:`rays`."""
        x, y = self._slopes()
        right, down, ahead = self.rotation  # R^T d, row by row and column by column
        return x[:, None] * right, y[:, None] * down + ahead

    def _slopes(self) -> tuple[Tensor, Tensor]:
        """(W,) and (H,) float64 x / z of the columns' centres and y / z of the rows', in the camera frame."""
        x = (torch.arange(self.width, dtype=torch.float64) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=torch.float64) + 0.5 - self.cy) / self.fy
        return x, y

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for the image resized to ``width`` x ``height`` (area averaging keeps pixel edges)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )


def mean_up(rotations: Tensor) -> Tensor:
    """(3,) the way up that cameras (N, 3, 3), world to camera with y down, have in common; not unit.

    Half of a capture upside down: no way prevails, and the first camera's is taken.
    """
    up = -rotations[:, 1].mean(0)
    return up if float(up.norm()) > 1e-3 else -rotations[0, 1]
