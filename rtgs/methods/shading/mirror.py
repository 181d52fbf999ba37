"""One mirror ray per pixel: from rasterised maps to rays, and from traced colours to the image (method.md 3.3, 4).

In the dtype of the inputs: float32 by native kernels where that pays, any other dtype in plain torch, their twin. Every
step is differentiable, so the reflection's loss teaches the surface its normals (through the direction), its depth
(through the origin) and its materials (through the weights).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.gaussians.settings import MaterialSettings
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.optics.light import decoded, encoded
from rtgs.optics.microfacet import SpecularWeights, specular_weights
from rtgs.optics.reflection import reflection_weight
from rtgs.optics.settings import OpticsSettings

SHORTEST_NORMAL = 1e-3  # an accumulated normal shorter than this has no direction: such a pixel has no surface


@dataclass(frozen=True)
class SurfacePixels:
    """What the base set says of P pixels. Channels first: sums over three rows are fast."""

    diffuse: Tensor  # (3, P) C_d
    specular: Tensor  # (P,) k_s as composited
    roughness: Tensor  # (P,) in 0..1
    f0: Tensor  # (P,), or (3, P) for rgb
    normal: Tensor  # (3, P) world, sum of w n
    depth: Tensor  # (P,) z-depth of the surface, world units


@dataclass(frozen=True)
class MirrorRays:
    """R rays that leave the surface at the mirror direction, one for each of P pixels unless asked for otherwise."""

    origins: Tensor  # (R, 3) world
    directions: Tensor  # (R, 3) unit, unless asked for otherwise
    cosine: Tensor  # (P,) n . omega_o


@dataclass(frozen=True)
class SentRays:
    """Which mirror rays are wanted, and which other rays are to stand behind them."""

    own: Tensor | None = None  # (R,) int64, ascending: the pixels whose ray it is; None: all of them
    more: tuple[Tensor, Tensor] | None = None  # (M, 3) origins and directions of other rays

    def of(self, rays: MirrorRays) -> MirrorRays:
        """Those of the ``rays`` of all pixels, with the others behind them; plain torch."""
        origins, directions = rays.origins, rays.directions
        if self.own is not None:
            origins, directions = origins.index_select(0, self.own), directions.index_select(0, self.own)
        if self.more is not None:
            origins, directions = torch.cat((origins, self.more[0])), torch.cat((directions, self.more[1]))
        return MirrorRays(origins, directions, rays.cosine)


EVERY = SentRays()


def surface_pixels(
    features: Tensor, alpha: Tensor, depth: Tensor, normal: Tensor, settings: MaterialSettings
) -> SurfacePixels:
    """Split the base set's maps of P pixels into what they mean.

    Args:
        features: (5 + F, P) rgb, k_s, roughness, f0, all composited.
        alpha: (P,); depth: (P,) already the surface's; normal: (3, P).
        settings: whether roughness and f0 are divided by alpha (decision 8).
    """
    # Split: its gradient is put together once, those of slices are maps of zeros that are added up.
    diffuse, specular, roughness, f0 = features.split((3, 1, 1, len(features) - 5))
    specular, roughness, f0 = specular.squeeze(0), roughness.squeeze(0), f0.squeeze(0)
    if settings.normalized:
        cover = alpha.clamp_min(settings.smallest_alpha)
        roughness, f0 = roughness / cover, f0 / cover
    return SurfacePixels(diffuse, specular, roughness, f0, normal, depth)


def mirror_rays(
    pixels: SurfacePixels, center: Tensor, view: Tensor, length: str = "unit", sent: SentRays = EVERY
) -> MirrorRays:
    """Reflect the pixels' rays (3, P), camera-z component 1, from the camera at ``center`` (3,) world.

    ``length`` of the mirror rays: "unit", or "raw": as long as the ray they come from (decision 23).
    """
    more = (None, None) if sent.more is None else sent.more
    maps = (pixels.normal, pixels.depth, view, center, *(each for each in more if each is not None))
    if all(m.dtype == torch.float32 and m.device.type == "cpu" for m in maps):
        numbers = (tuple(center.tolist()), SHORTEST_NORMAL, length == "raw")
        return MirrorRays(*_Mirror.apply(pixels.normal, pixels.depth, view, *more, sent.own, numbers))  # type: ignore[misc]
    return mirror_rays_twin(pixels, center, view, length, sent)


def mirror_rays_twin(
    pixels: SurfacePixels, center: Tensor, view: Tensor, length: str = "unit", sent: SentRays = EVERY
) -> MirrorRays:
    """:func:`mirror_rays` in plain torch, any dtype."""
    length_of_view = view.square().sum(0).sqrt()  # over three rows, many times faster than norm(dim=0)
    outward = -view / length_of_view  # omega_o
    normal = pixels.normal * pixels.normal.square().sum(0).clamp_min(SHORTEST_NORMAL**2).rsqrt()
    cosine = (normal * outward).sum(0)
    directions = 2 * cosine * normal - outward
    directions = directions * length_of_view if length == "raw" else directions
    origins = center[:, None] + pixels.depth * view
    return sent.of(MirrorRays(origins.T.contiguous(), directions.T.contiguous(), cosine))


def pixel_weights(cosine: Tensor, pixels: SurfacePixels, optics: OpticsSettings) -> SpecularWeights:
    """Weights of the traced colours, channels first: (P,), or (3, P) with an rgb f0."""
    if pixels.f0.ndim == 1:
        return specular_weights(cosine, pixels.roughness, pixels.f0, optics)
    weights = specular_weights(cosine, pixels.roughness, pixels.f0.T, optics)
    return SpecularWeights(weights.reflection.T, weights.transmission.T, weights.fresnel.T)


def reflected_weight(cosine: Tensor, pixels: SurfacePixels, optics: OpticsSettings) -> Tensor:
    """``pixel_weights(...).reflection`` without the other two."""
    if pixels.f0.ndim == 1:
        return reflection_weight(cosine, pixels.roughness, pixels.f0, optics)
    return reflection_weight(cosine, pixels.roughness, pixels.f0.T, optics).T


def surface_there(pixels: SurfacePixels, alpha: Tensor, smallest_alpha: float) -> Tensor:
    """(P,) bool: there is a surface to reflect at: enough coverage, a depth, a normal."""
    there = (alpha > smallest_alpha) & (pixels.depth > 0)
    return there & (pixels.normal.square().sum(0) > SHORTEST_NORMAL**2)


def showing_reflection(pixels: SurfacePixels, rays: Callable[[], Tensor], optics: OpticsSettings) -> Tensor:
    """(P,) k_s max(w_r, 1): how much of a reflection each pixel may show; ``rays``: gives the (3, P) world rays, where
    they are looked at."""
    if optics.at_most_one:
        return pixels.specular
    view = rays()
    unit = pixels.normal / pixels.normal.square().sum(0).sqrt().clamp_min(SHORTEST_NORMAL)
    cosine = -(unit * view).sum(0) / view.square().sum(0).sqrt()
    weight = pixel_weights(cosine, pixels, optics).reflection
    weight = weight if weight.ndim == 1 else weight.amax(0)
    return pixels.specular * weight.clamp_min(1)


def specular_change(
    diffuse: Tensor,
    specular: Tensor,
    light: Tensor,
    emphasis: Tensor | None,
    blend: str = "srgb",
    *,
    additive: bool = False,
) -> Tensor:
    """(3, P) what traced light adds to C_d: k_s (light - C_d), so that C_d plus it is (1 - k_s) C_d + k_s light.

    ``additive``: k_s light, so that it is C_d + k_s light.

    ``diffuse`` (3, P) and ``specular`` (P,) are C_d and k_s. ``light`` (3, P): w_r C_r, and w_t C_t where the pixel
    shows a transparent object. With ``blend`` "linear" it is linear light, and so is the mixture, which is encoded
    afterwards.
    ``emphasis`` (P,) multiplies the gradient and leaves the value alone: 1 / share for pixels drawn with that share
    makes the gradient of every parameter right on average (docs/reflection.md).
    """
    base = decoded(diffuse, blend)
    change = specular * (light if additive else light - base)
    if blend != "srgb":
        change = encoded(base + change, blend) - diffuse
    return change if emphasis is None else _Emphasize.apply(change, emphasis)  # type: ignore[return-value]


class _Emphasize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value: Tensor, emphasis: Tensor) -> Tensor:
        ctx.save_for_backward(emphasis)
        return value.view_as(value)

    @staticmethod
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        (emphasis,) = ctx.saved_tensors
        return upstream * emphasis, None


class _Mirror(torch.autograd.Function):
    """Rays of the pixels are written where they are sent from, before the other rays."""

    @staticmethod
    def forward(ctx, normal: Tensor, depth: Tensor, view: Tensor, *given):
        *more, own, numbers = given
        maps = [m.detach().contiguous() for m in (normal, depth, view)]
        count, rays = len(depth), len(depth if own is None else own)
        both = tuple(torch.empty(rays + (0 if each is None else len(each)), 3) for each in more)
        for sent, each in zip(both, more, strict=True):
            if each is not None:
                sent[rays:] = each.detach()
        cosine = torch.empty(count)
        places = arrays_of(own, *(sent[:rays] for sent in both), cosine)
        core.mirror_rays(*arrays_of(*maps), *numbers, *places, threads())
        ctx.save_for_backward(*maps, own)
        ctx.numbers, ctx.rays = numbers, rays
        return *both, cosine

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):  # type: ignore[override]
        *maps, own = ctx.saved_tensors
        normal, depth = (torch.empty_like(m) for m in maps[:2])
        *both, to_cosine = upstream
        given = arrays_of(own, *(each[: ctx.rays] for each in both), to_cosine)
        core.mirror_rays_backward(*arrays_of(*maps), *ctx.numbers, *given, *arrays_of(normal, depth), threads())
        wanted = zip(both, ctx.needs_input_grad[3:5], strict=True)
        more = (each[ctx.rays :] if needed else None for each, needed in wanted)
        return normal, depth, None, *more, None, None
