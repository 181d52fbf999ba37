"""One mirror ray per pixel: from rasterised maps to rays, and from traced colours to the image (method.md 3.3, 4).

In the dtype of the inputs: float32 by native kernels where that pays, any other dtype in plain torch, their twin. Every
step is differentiable, so the reflection's loss teaches the surface its normals (through the direction), its depth
(through the origin) and its materials (through the weights).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.gaussians.settings import MaterialSettings
from rtgs.native import core
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
    """P rays that leave the surface at the mirror direction."""

    origins: Tensor  # (P, 3) world
    directions: Tensor  # (P, 3) unit, unless asked for otherwise
    cosine: Tensor  # (P,) n . omega_o


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


def mirror_rays(pixels: SurfacePixels, center: Tensor, view: Tensor, length: str = "unit") -> MirrorRays:
    """Reflect the pixels' rays (3, P), camera-z component 1, from the camera at ``center`` (3,) world.

    ``length`` of the mirror rays: "unit", or "raw": as long as the ray they come from (decision 23).
    """
    maps = (pixels.normal, pixels.depth, view, center)
    if all(m.dtype == torch.float32 and m.device.type == "cpu" for m in maps):
        numbers = (tuple(center.tolist()), SHORTEST_NORMAL, length == "raw")
        return MirrorRays(*_Mirror.apply(pixels.normal, pixels.depth, view, numbers))  # type: ignore[misc]
    return mirror_rays_twin(pixels, center, view, length)


def mirror_rays_twin(pixels: SurfacePixels, center: Tensor, view: Tensor, length: str = "unit") -> MirrorRays:
    """:func:`mirror_rays` in plain torch, any dtype."""
    length_of_view = view.square().sum(0).sqrt()  # over three rows, many times faster than norm(dim=0)
    outward = -view / length_of_view  # omega_o
    normal = pixels.normal * pixels.normal.square().sum(0).clamp_min(SHORTEST_NORMAL**2).rsqrt()
    cosine = (normal * outward).sum(0)
    directions = 2 * cosine * normal - outward
    directions = directions * length_of_view if length == "raw" else directions
    origins = center[:, None] + pixels.depth * view
    return MirrorRays(origins.T.contiguous(), directions.T.contiguous(), cosine)


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


def showing_reflection(pixels: SurfacePixels, view: Tensor, optics: OpticsSettings) -> Tensor:
    """(P,) k_s max(w_r, 1): how much of a reflection each pixel may show; ``view`` (3, P) world rays."""
    if optics.at_most_one:
        return pixels.specular
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
    @staticmethod
    def forward(ctx, normal: Tensor, depth: Tensor, view: Tensor, numbers: tuple[tuple[float, ...], float, bool]):
        maps = [m.detach().contiguous() for m in (normal, depth, view)]
        count = len(depth)
        outputs = (torch.empty(count, 3), torch.empty(count, 3), torch.empty(count))
        arrays = [m.numpy() for m in maps]
        core.mirror_rays(*arrays, *numbers, *(o.numpy() for o in outputs), threads())
        ctx.save_for_backward(*maps)
        ctx.numbers = numbers
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):  # type: ignore[override]
        maps = [m.numpy() for m in ctx.saved_tensors]
        normal, depth = (torch.empty_like(m) for m in ctx.saved_tensors[:2])
        given = (g.contiguous().numpy() for g in upstream)
        core.mirror_rays_backward(*maps, *ctx.numbers, *given, normal.numpy(), depth.numpy(), threads())
        return normal, depth, None, None
