"""The microfacet weights of one mirror ray and one straight ray, in closed form (method.md 4, paper eq. 8 to 11).

Plain torch, any dtype, differentiable. With the half vector at the normal (a mirror ray) the Torrance-Sparrow term has
one cosine c = n . omega_o = n . omega_i and one width g, and needs no half vector:

    D G (n . omega_i) / (4 (n . omega_o) (n . omega_i)) = S(c, g) = 1 / (4 pi g^2 sqrt(c^2 + g^2 (1 - c^2)))

The symbols f_r, f_t of the paper's blend are read as weights that include the cosine of its integral: only then is the
weight of transmission exactly 1 - F (method.md 4.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.optics.conductor import surface_reflectance
from rtgs.optics.settings import OpticsSettings

REMAP_COEFFICIENTS = (1.62142, 0.819955, 0.1734, 0.0171201, 0.000640711)  # of ln(alpha)^k, paper eq. 10


@dataclass(frozen=True)
class SpecularWeights:
    """What multiplies the traced colours: C_s = reflection * C_r + transmission * C_t, per pixel."""

    reflection: Tensor  # w_r, shape of the cosines (x 3 with an rgb f0)
    transmission: Tensor  # w_t
    fresnel: Tensor  # F


def remap_roughness(roughness: Tensor, floor: float = 1e-3) -> Tensor:
    """Microfacet width g of a roughness in 0..1 (PBRT's RoughnessToAlpha, about 1.62 sqrt(roughness)).

    The argument is at least ``floor``: below 1.55e-4 the quartic turns round and grows without bound.
    """
    logarithm = roughness.clamp_min(floor).log()
    width = torch.full_like(logarithm, REMAP_COEFFICIENTS[4])
    for coefficient in REMAP_COEFFICIENTS[3::-1]:
        width = width * logarithm + coefficient
    return width


def microfacet_width(roughness: Tensor, settings: OpticsSettings) -> Tensor:
    """The g that D and G see: the remap, or the roughness itself (decision 2)."""
    if settings.remap == "none":
        return roughness.clamp_min(settings.roughness_floor)
    return remap_roughness(roughness, settings.roughness_floor)


def ggx_distribution(cosine_half: Tensor, width: Tensor) -> Tensor:
    """D: isotropic Trowbridge-Reitz of n . omega_h (paper eq. 9), 1/sr."""
    square = width * width
    return square / (math.pi * (cosine_half * cosine_half * (square - 1) + 1) ** 2)


def smith_lambda(cosine: Tensor, width: Tensor) -> Tensor:
    """Smith's Lambda of GGX for one direction."""
    tangent_square = (1 - cosine * cosine) / (cosine * cosine)
    return ((1 + width * width * tangent_square).sqrt() - 1) / 2


def smith_masking(cosine_in: Tensor, cosine_out: Tensor, width: Tensor, masking: str = "correlated") -> Tensor:
    """G of both directions: height-correlated 1/(1 + L_i + L_o), or the product of two 1/(1 + L) (decision 4)."""
    inward, outward = smith_lambda(cosine_in, width), smith_lambda(cosine_out, width)
    if masking == "separable":
        return 1 / ((1 + inward) * (1 + outward))
    return 1 / (1 + inward + outward)


def schlick(f0: Tensor, cosine: Tensor) -> Tensor:
    """F = f0 + (1 - f0) (1 - cosine)^5."""
    return f0 + (1 - f0) * (1 - cosine) ** 5


def fresnel_share(f0: Tensor, cosine: Tensor, settings: OpticsSettings) -> Tensor:
    """F as the settings want it: Schlick's, or one of :func:`rtgs.optics.conductor.surface_reflectance`."""
    if settings.fresnel == "schlick":
        return schlick(f0, cosine)
    return surface_reflectance(settings.fresnel, f0, cosine, settings.edge_tint)


def inverse_gain(cosine: Tensor, width: Tensor, masking: str = "correlated") -> Tensor:
    """1 / S(c, g): the reciprocal stays finite where S does not."""
    slant = (cosine * cosine + width * width * (1 - cosine * cosine)).sqrt()
    if masking == "separable":
        return math.pi * width * width * (cosine + slant) ** 2 / cosine
    return 4 * math.pi * width * width * slant


def specular_weights(cosine: Tensor, roughness: Tensor, f0: Tensor, settings: OpticsSettings) -> SpecularWeights:
    """Weights of the reflected and of the transmitted colour (method.md 4.4).

    Args:
        cosine: (...) n . omega_o; any value, clamped to ``cosine_floor``..1.
        roughness: (...) in 0..1.
        f0: (...) reflectance at normal incidence in 0..1, or (..., 3) for rgb.
        settings: which weight, which G, which remap, which bound.

    Returns:
        Weights of the shape of ``f0``. Finite, with bounded gradients, for every input in range. ``split_sum`` and
        ``microfacet`` with ``max_gain`` 1 conserve energy: reflection + transmission <= 1. ``blend`` and ``additive``
        are 1 and 0.
    """
    if settings.detach_cosine:
        cosine = cosine.detach()
    if f0.ndim == cosine.ndim + 1:
        cosine, roughness = cosine[..., None], roughness[..., None]
    if settings.weight in ("envgs", "additive"):
        ones = torch.ones_like(f0)
        return SpecularWeights(ones, torch.zeros_like(f0), ones)
    floor = settings.literal_cosine_floor if settings.weight == "literal" else settings.cosine_floor
    cosine = cosine.clamp(floor, 1)
    width = microfacet_width(roughness, settings)
    fresnel = fresnel_share(f0, cosine, settings)
    if settings.weight == "split_sum":
        from rtgs.optics.split_sum import split_sum_factors

        scale, bias = split_sum_factors(cosine, width)
        reflection = f0 * scale + bias
        return SpecularWeights(reflection, 1 - reflection, fresnel)
    inverse = inverse_gain(cosine, width, settings.masking)
    if settings.weight == "literal":
        return SpecularWeights(fresnel / (inverse * cosine), (1 - fresnel) / cosine, fresnel)
    bound = 1 / settings.max_gain if settings.max_gain > 0 else 0.0
    return SpecularWeights(fresnel / (inverse + bound), 1 - fresnel, fresnel)
