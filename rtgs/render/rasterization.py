"""Gaussians by raw tensors, in the conventions of gsplat: batched cameras, rows of pixels, quaternions first.

What is rendered is what :func:`~rtgs.render.ellipsoids.rasterize_ellipsoids` and
:func:`~rtgs.render.surfels.rasterize_surfels` render, with their rules for support and depth; docs/python.md lists what
differs from gsplat. Gaussians get gradients, cameras do not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, get_args

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.harmonics import evaluate_sh
from rtgs.gaussians.primitives import tangents, unit_or_zero
from rtgs.render.buffers import EllipsoidOptions, RasterBuffers, RasterOptions
from rtgs.render.depth_normals import depth_normals
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.surfels import rasterize_surfels

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
MOST_CHANNELS = 32  # of the kernels
_LEAST_ALPHA = 1e-10  # what an expected depth is divided by, at least
_FARTHEST = 1e6  # near planes: the distortion's depth mapping has its end there in float32


@dataclass(frozen=True)
class _Splats:
    """N Gaussians as they were given, checked."""

    means: Tensor
    tangents: tuple[Tensor, Tensor]
    scales: Tensor
    opacities: Tensor

    @property
    def shape(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The leading arguments of a rasteriser."""
        return (self.means, *self.tangents, self.scales, self.opacities)

    def before(self, camera: Camera, far: float, colors: Tensor) -> tuple[_Splats, Tensor]:
        """Those whose centres are nearer than ``far``, and their colours; no copy where that is all."""
        nearer = camera.to_camera(self.means.detach())[:, 2] < far
        if bool(nearer.all()):
            return self, colors
        rows = nearer.nonzero()[:, 0]
        u, v = self.tangents
        near = _Splats(self.means[rows], (u[rows], v[rows]), self.scales[rows], self.opacities[rows])
        return near, colors[rows]


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
) -> tuple[Tensor, Tensor, dict[str, object]]:
    """Render N ellipsoids (3DGS) from C cameras, with the arguments of ``gsplat.rasterization``.

    Differentiable by everything but the cameras and the backgrounds.

    Parameters
    ----------
    means : (N, 3) Tensor
        Centres, float32, world frame.
    quats : (N, 4) Tensor
        Rotations, w first, of any length.
    scales : (N, 3) Tensor
        Standard deviations along the rotated axes, world units.
    opacities : (N,) Tensor
        In (0, 1].
    colors : (N, D), (C, N, D), (N, K, 3) or (C, N, K, 3) Tensor
        Without ``sh_degree`` D values of each Gaussian; with it K coefficients of spherical harmonics.
    viewmats : (C, 4, 4) Tensor
        World to camera: x right, y down, z forward.
    Ks : (C, 3, 3) Tensor
        Intrinsics in pixels, without skew.
    width, height : int
        Size of the images in pixels.
    near_plane, far_plane : float, optional
        World units; ellipsoids with their centre outside are left out.
    eps2d : float, optional
        Pixels squared, added to the projected covariance.
    sh_degree : int, optional
        Bands in use, 0 to 3; None: ``colors`` are colours.
    backgrounds : (C, D) Tensor, optional
        Behind everything; None is black. Not differentiated.
    render_mode : str, optional
        "RGB": the colours; "D": accumulated depth; "ED": expected depth; "RGB+D", "RGB+ED": depth as the last channel.
    rasterize_mode : str, optional
        "antialiased": a dilated footprint keeps its weight.

    Returns
    -------
    colors : (C, height, width, D or 1 or D + 1) Tensor
        What ``render_mode`` asks for.
    alphas : (C, height, width, 1) Tensor
        Coverage.
    meta : dict
        "width", "height", "n_cameras".

    Raises
    ------
    ValueError
        A shape, a dtype, a camera or an option does not fit; the message names the argument.

    References
    ----------
    .. [1] Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 26, 2025.
    """
    _check_word("render_mode", render_mode, get_args(RenderMode))
    _check_word("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    splats = _splats(means, quats, scales, opacities, axes=3)
    _check_planes(near_plane, far_plane)
    cameras = _cameras(viewmats, Ks, width, height)
    options = EllipsoidOptions(near_plane, eps2d, rasterize_mode == "antialiased", depth="D" in render_mode)
    images, alphas = [], []
    for camera, shown, values, background in _seen(splats, cameras, far_plane, colors, sh_degree, backgrounds):
        found = rasterize_ellipsoids(*shown.shape, values, camera, background=background, options=options)
        images.append(_channels(render_mode, found.features, found.depth, found.alpha))
        alphas.append(found.alpha[..., None])
    return torch.stack(images), torch.stack(alphas), _meta(width, height, cameras)


def rasterization_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, dict[str, object]]:
    """Render N surfels (2DGS) from C cameras, with the arguments of ``gsplat.rasterization_2dgs``.

    Differentiable by everything but the cameras and the backgrounds.

    Parameters
    ----------
    means, quats, opacities, colors, viewmats, Ks, width, height
        As of :func:`rasterization`. The normal is the third axis.
    scales : (N, 2) or (N, 3) Tensor
        Standard deviations along the first two axes, world units; a third is left out.
    near_plane, far_plane, sh_degree, backgrounds, render_mode
        As of :func:`rasterization`.

    Returns
    -------
    colors : (C, height, width, D or 1 or D + 1) Tensor
        What ``render_mode`` asks for.
    alphas : (C, height, width, 1) Tensor
        Coverage.
    normals : (C, height, width, 3) Tensor
        Accumulated, world frame, towards the camera; not normalised.
    surface_normals : (C, height, width, 3) Tensor
        Those of the expected depth, times the coverage, world frame.
    distortions : (C, height, width, 1) Tensor
        2DGS's depth distortion.
    medians : (C, height, width, 1) Tensor
        Depth of the last surfel that is met while half of the light is left.
    meta : dict
        "width", "height", "n_cameras".

    Raises
    ------
    ValueError
        A shape, a dtype, a camera or an option does not fit; the message names the argument.

    References
    ----------
    .. [1] Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH 2024.
    """
    _check_word("render_mode", render_mode, get_args(RenderMode))
    splats = _splats(means, quats, scales, opacities, axes=2)
    _check_planes(near_plane, far_plane)
    cameras = _cameras(viewmats, Ks, width, height)
    options = RasterOptions(
        near_plane, min(far_plane, _FARTHEST * near_plane), depth=True, median_depth=True, normal=True, distortion=True
    )
    kept: list[tuple[Tensor, ...]] = []
    for camera, shown, values, background in _seen(splats, cameras, far_plane, colors, sh_degree, backgrounds):
        found = rasterize_surfels(*shown.shape, values, camera, background=background, options=options)
        kept.append(_maps_2dgs(found, camera, render_mode))
    image, alpha, normal, surface, distortion, median = (torch.stack(each) for each in zip(*kept, strict=True))
    return image, alpha, normal, surface, distortion, median, _meta(width, height, cameras)


def _seen(
    splats: _Splats,
    cameras: Sequence[Camera],
    far: float,
    colors: Tensor,
    sh_degree: int | None,
    backgrounds: Tensor | None,
) -> Iterator[tuple[Camera, _Splats, Tensor, Tensor | None]]:
    """Each camera with the Gaussians before it, their colours (N, D), and what is behind them."""
    count = len(cameras)
    for index, camera in enumerate(cameras):
        shown, values = splats.before(camera, far, _colors(splats, colors, camera, index, count, sh_degree))
        yield camera, shown, values, _background(backgrounds, index, count, values.shape[1])


def _maps_2dgs(found: RasterBuffers, camera: Camera, mode: RenderMode) -> tuple[Tensor, ...]:
    """Of one camera, each (H, W, .): image, coverage, normals, normals of the depth, distortion, median depth."""
    assert found.depth is not None
    assert found.normal is not None
    assert found.distortion is not None
    assert found.median_depth is not None
    surface = depth_normals(_expected(found.depth, found.alpha), camera) * found.alpha.detach()
    image = _channels(mode, found.features, found.depth, found.alpha)
    normals = (each.permute(1, 2, 0) for each in (found.normal, surface))
    return (image, found.alpha[..., None], *normals, found.distortion[..., None], found.median_depth[..., None])


def _check_word(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name}={value!r} is none of {', '.join(map(repr, known))}")


def _check_planes(near: float, far: float) -> None:
    if not near < far:  # nor where one is no number
        raise ValueError(f"near_plane={near} must be less than far_plane={far}")


def _check_size(name: str, value: object) -> None:
    if not isinstance(value, Integral) or isinstance(value, bool) or int(value) < 1:
        raise ValueError(f"{name}={value!r} must be a whole number of pixels, at least 1")


def _check_rows(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} must be {shape}, got {tuple(value.shape)}")


def _splats(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, axes: int) -> _Splats:
    """The Gaussians with their first two axes, ``axes`` scales each."""
    count = len(means)
    _check_rows("means", means, (count, 3))
    _check_rows("quats", quats, (count, 4))
    _check_rows("opacities", opacities, (count,))
    if scales.shape not in ((count, axes), (count, 3)):
        raise ValueError(f"scales must be ({count}, {axes}), got {tuple(scales.shape)}")
    return _Splats(means, tangents(quats), scales[:, :axes], opacities)


def _cameras(viewmats: Tensor, intrinsics: Tensor, width: int, height: int) -> list[Camera]:
    """One for each matrix."""
    _check_size("width", width)
    _check_size("height", height)
    width, height, count = int(width), int(height), len(viewmats)
    _check_rows("viewmats", viewmats, (count, 4, 4))
    _check_rows("Ks", intrinsics, (count, 3, 3))
    if count == 0:
        raise ValueError("viewmats holds no camera: give at least one, (1, 4, 4)")
    found = []
    for index, (view, lens) in enumerate(zip(viewmats.detach().double(), intrinsics.detach().double(), strict=True)):
        rotation = view[:3, :3]
        if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-4):
            raise ValueError(f"viewmats[{index}] holds no rotation: its rows must be orthonormal (no scale, no shear)")
        if float(torch.linalg.det(rotation)) < 0:
            raise ValueError(f"viewmats[{index}] mirrors: its determinant is -1; x is right, y down, z forward")
        if (bottom := view[3].tolist()) != [0, 0, 0, 1]:
            raise ValueError(f"viewmats[{index}] has the bottom row {bottom}: it must be 0, 0, 0, 1")
        if (last := lens[2].tolist()) != [0, 0, 1]:
            raise ValueError(f"Ks[{index}] has the last row {last}: it must be 0, 0, 1")
        if lens[0, 1] != 0 or lens[1, 0] != 0:
            skew = float(lens[0, 1] if lens[0, 1] != 0 else lens[1, 0])
            raise ValueError(f"Ks[{index}] has skew {skew}: pinhole cameras without skew are rendered")
        (fx, _, cx), (_, fy, cy), _ = lens.tolist()
        found.append(Camera(rotation, view[:3, 3], fx, fy, cx, cy, width, height, f"viewmats[{index}]"))
    return found


def _colors(splats: _Splats, colors: Tensor, camera: Camera, index: int, cameras: int, sh_degree: int | None) -> Tensor:
    """(N, D) of one camera."""
    count, plain = len(splats.means), 2 if sh_degree is None else 3
    if colors.dim() == plain + 1:
        if len(colors) != cameras:
            raise ValueError(f"colors is for {len(colors)} cameras, viewmats has {cameras}")
        colors = colors[index]
    if colors.dim() != plain or len(colors) != count:
        wanted = "(N, D) or (C, N, D)" if sh_degree is None else "(N, K, 3) or (C, N, K, 3) with sh_degree"
        raise ValueError(f"colors must be {wanted} for N = {count}, got {tuple(colors.shape)}")
    if sh_degree is None:
        if not 1 <= colors.shape[1] <= MOST_CHANNELS:
            raise ValueError(f"colors has {colors.shape[1]} channels: 1 to {MOST_CHANNELS} are rendered")
        return colors
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree={sh_degree} must be 0 to 3")
    if colors.shape[2] != 3 or colors.shape[1] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors must be (N, K, 3) with K at least {(sh_degree + 1) ** 2} for sh_degree={sh_degree}, got "
            f"{tuple(colors.shape)}"
        )
    directions = unit_or_zero(splats.means - camera.center.to(splats.means.dtype))
    return evaluate_sh(colors[:, 0], colors[:, 1:], directions, sh_degree).clamp_min(0)


def _background(backgrounds: Tensor | None, index: int, cameras: int, channels: int) -> Tensor | None:
    if backgrounds is None:
        return None
    _check_rows("backgrounds", backgrounds, (cameras, channels))
    return backgrounds[index]


def _channels(mode: RenderMode, image: Tensor, depth: Tensor | None, alpha: Tensor) -> Tensor:
    """(H, W, .) what the mode asks for."""
    color = image.permute(1, 2, 0)
    if depth is None or "D" not in mode:
        return color
    shown = (_expected(depth, alpha) if "ED" in mode else depth)[..., None]
    return torch.cat((color, shown), dim=-1) if "RGB" in mode else shown


def _expected(depth: Tensor, alpha: Tensor) -> Tensor:
    return depth / alpha.clamp_min(_LEAST_ALPHA)


def _meta(width: int, height: int, cameras: list[Camera]) -> dict[str, object]:
    return {"width": width, "height": height, "n_cameras": len(cameras)}
