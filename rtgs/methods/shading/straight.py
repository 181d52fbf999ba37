"""The pixels of a view that show a transparent object, and the straight rays through them (method.md 3.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods.shading.mirror import SHORTEST_NORMAL, SurfacePixels, pixel_weights
from rtgs.methods.shading.surface_maps import with_mesh
from rtgs.optics.settings import OpticsSettings
from rtgs.train.method import Observation


@dataclass(frozen=True)
class GlassPixels:
    """All H * W pixels of a view, flattened, with what is known of the object in them."""

    flat: SurfacePixels  # first surface and normal as the settings want them
    inside: Tensor  # (H * W,) bool: the pixel shows the object and gets straight rays
    far: Tensor  # (H * W,) z-depth of the second surface, no graph; the first where there is none
    second: Tensor  # (H * W,) bool: a second surface was found
    known: Tensor  # (H * W,) bool: the first surface is the mesh's, and glass


@dataclass(frozen=True)
class GlassRays:
    """R straight rays from the first surface on, no graph: along a ray its start changes no colour."""

    rows: Tensor  # (R,) int64 into the traced pixels
    count: int  # of traced pixels
    center: Tensor  # (3,) camera centre, or (R, 3) where each ray was bent and has its own
    directions: Tensor  # (R, 3) camera-z component 1
    near: Tensor  # (R,) z-depth of the first surface
    far: Tensor  # (R,) of the second; ``near`` where there is none
    second: Tensor  # (R,) bool

    def at(self, depth: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Origins at these z-depths and directions, of all rays or of some."""
        directions = self.directions if rows is None else self.directions.index_select(0, rows)
        center = self.center if rows is None or self.center.ndim == 1 else self.center.index_select(0, rows)
        return center + depth[:, None] * directions, directions


@dataclass(frozen=True)
class FirstBounce:
    """What the first straight rays met, for the loss on their depth (method.md 5.1); R rays that have a back surface.

    Depths count from the first surface, in z-depth units.
    """

    depth: Tensor  # (R,) Z_1 = sum of w t, with its graph
    alpha: Tensor  # (R,) A_1, with its graph
    thickness: Tensor  # (R,) z_2 - z_s, no graph
    beyond: Tensor | None = None  # (R,) sum of w (t - thickness) over the hits behind the back surface, if asked for
    weight: Tensor | None = None  # (R,) with which a ray counts; None: 1


@dataclass(frozen=True)
class Transmission:
    """What the straight rays met."""

    color: Tensor  # (3, P) C_t of the traced pixels; 0 outside the object
    first_bounce: FirstBounce | None  # in training, for rays with a second surface
    observations: tuple[Observation, ...] = ()  # in training, of the transmittance set
    parts: Mapping[str, Tensor] = field(default_factory=dict)  # (3, P) linear light each, when layers are asked for
    beside: Tensor | None = None  # (B, 3) encoded, what rays that pass the object meet; None: there are none


def glass_pixels(
    flat: SurfacePixels, surfaces: ObjectSurfaces, inside: Tensor, glass: Tensor, *, first_surface: str, normal: str
) -> GlassPixels:
    """Put the mesh's surface where it is known: ``first_surface`` and ``normal`` are "mesh" or "base".

    Args:
        flat: the rasterised surface of all H * W pixels.
        surfaces: of the object's mesh.
        inside: (H, W) bool: pixels that show the object.
        glass: (H, W) bool: the mesh's first surface is one of the object's, not a lid or a label.
    """
    inside, met = inside.flatten(), inside.flatten() & surfaces.hit.flatten()
    known = met & glass.flatten()
    depths = surfaces.near.flatten() if first_surface == "mesh" else None
    flat = with_mesh(flat, known, depths, surfaces.normal.flatten(1) if normal == "mesh" else None)
    near, second = flat.depth.detach(), surfaces.second.flatten() & met
    # A mesh away from the rasterised surface must not put the back before the front.
    far = torch.where(second, torch.maximum(surfaces.far.flatten(), near), near)
    return GlassPixels(flat, inside, far, second, known)


def widened(inside: Tensor, pixels: int) -> Tensor:
    """(H, W) bool with ``pixels`` more on every side."""
    for _ in range(pixels):
        rows = inside.clone()
        rows[1:] |= inside[:-1]
        rows[:-1] |= inside[1:]
        inside = rows.clone()
        inside[:, 1:] |= rows[:, :-1]
        inside[:, :-1] |= rows[:, 1:]
    return inside


def glass_rays(glass: GlassPixels, index: Tensor, center: Tensor, view: Callable[[Tensor], Tensor]) -> GlassRays:
    """The straight rays of the traced pixels ``index`` (P,) that show the object; ``view``: (R, 3) world rays of
    flattened pixels (R,)."""
    rows = glass.inside.index_select(0, index).nonzero()[:, 0]
    pixels = index.index_select(0, rows)
    near, far, second = (each.index_select(0, pixels) for each in (glass.flat.depth.detach(), glass.far, glass.second))
    return GlassRays(rows, len(index), center, view(pixels), near, far, second)


def glass_weights(
    reflection: Tensor,
    cosine: Tensor,
    pixels: SurfacePixels,
    inside: Tensor,
    optics: OpticsSettings,
    largest: float,
    bound: str = "clamp",
) -> tuple[Tensor, Tensor]:
    """w_r and w_t of P traced pixels (method.md 4.4): w_t is 0 outside the object, w_r inside at most ``largest``.

    Args:
        reflection: (P,) or (3, P) w_r as outside the object.
        cosine: (P,) n . omega_o; inside: (P,) bool.
        optics: with the S_max of the object's pixels.
        largest: 0: no bound.
        bound: "clamp", or "smooth", whose gradient is 0 nowhere.
    """
    rows = inside.nonzero()[:, 0]
    shown = replace(pixels, roughness=pixels.roughness[rows], f0=pixels.f0.index_select(-1, rows))
    weights = pixel_weights(cosine[rows], shown, optics)
    own = weights.reflection if largest == 0 else _bounded(weights.reflection, largest, bound)
    passed = torch.zeros_like(reflection).index_copy(-1, rows, weights.transmission)
    return reflection.index_copy(-1, rows, own), passed


def _bounded(weight: Tensor, largest: float, bound: str) -> Tensor:
    """``weight`` at most ``largest``; smooth: w / (1 + (w / largest)^4)^(1/4), within 2 % of w up to half of it."""
    if bound == "clamp":
        return weight.clamp_max(largest)
    # by the reciprocal: the fourth power of a large weight would overflow
    inverse = weight.clamp_min(1e-6).reciprocal()
    # Roots and squares are rounded the same in every block of a tensor, powers are not: bits of any number of threads.
    return (inverse.square().square() + largest**-4).sqrt().sqrt().reciprocal()


def depth_loss(bounce: FirstBounce, form: str, pixels: int) -> Tensor:
    """L_d: the first straight ray's hits lie before the second surface, summed over rays / ``pixels`` (method.md 5.1).

    ``form``: "accum" ReLU(Z_1 - thickness), "mean" with Z_1 / A_1 instead, "per_hit" sum of w ReLU(t - thickness).
    """
    if form == "per_hit":
        assert bounce.beyond is not None
        late = bounce.beyond
    else:
        late = (bounce.depth / bounce.alpha.clamp_min(1e-3) if form == "mean" else bounce.depth) - bounce.thickness
    late = late.clamp_min(0)
    return (late if bounce.weight is None else bounce.weight * late).sum() / pixels


def mesh_normal_loss(normal: Tensor, target: Tensor, where: Tensor) -> Tensor:
    """Mean over all pixels of 1 - n . N in the pixels ``where`` (H, W) bool; n of any length, N unit, (3, H, W)."""
    index = where.flatten().nonzero()[:, 0]
    n, unit = normal.flatten(1).index_select(1, index), target.flatten(1).index_select(1, index)
    cosine = (n * n.square().sum(0).clamp_min(SHORTEST_NORMAL**2).rsqrt() * unit).sum(0)
    return (1 - cosine).sum() / where.numel()
