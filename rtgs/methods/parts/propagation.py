"""EnvGS's remedies for baked-in reflections: normal propagation, colour sabotage, resets (method.md 6.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rtgs.gaussians.density import logit
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.settings import PropagationSettings
from rtgs.train.method import StepEvent

SPECULAR = "specular_logits"  # of the channel that says how much a Gaussian reflects: k_s, and what methods have for it


@torch.no_grad()
def propagate_normals(
    base: GaussianSet,
    settings: PropagationSettings,
    generator: torch.Generator,
    weight: str = SPECULAR,
    glossy: Tensor | None = None,
    inside: Tensor | None = None,
) -> StepEvent:
    """Make every surfel opaque, specular ones larger, and add noise to the colour of the others.

    ``weight``: the channel of k_s; ``glossy`` (N,) bool: only these grow; None: all that are specular; ``inside`` (N,)
    bool: only these change at all (3DGS-DR, where reflection has a scope); None: all, as EnvGS does.

    Opaque surfels with a good normal cover their neighbours, so that these learn theirs; the noise undoes what a matte
    colour has baked in, so that reflection has something left to explain. Moments of what changed become 0, as
    published those of every row.
    """
    surfels = base.gaussians
    specular = surfels[weight].sigmoid()
    inside = torch.ones_like(specular, dtype=torch.bool) if inside is None else inside
    _raise(surfels.opacity_logits, settings.opacity, inside)
    base.optimizer.zero_moments("opacity_logits")
    grown = (specular >= settings.grow_border) & inside
    grown = grown if glossy is None else grown & glossy
    grow_across(surfels.log_scales, grown, settings.grow)
    base.optimizer.zero_moments("log_scales")
    disturbed = 0
    if settings.sabotage > 0:
        sabotaged = (specular <= settings.sabotage_border) & inside
        disturbed = int(sabotaged.sum())
        noise = settings.sabotage * (2 * torch.rand(surfels.sh_dc.shape, generator=generator) - 1)
        surfels.sh_dc += torch.where(sabotaged[:, None], noise, 0.0)
        base.optimizer.zero_moments("sh_dc")
    detail = f"normals propagated: {int(grown.sum())} surfels grown, colours of {disturbed} disturbed"
    return StepEvent("propagation", base.name, detail)


@torch.no_grad()
def reset_specular(base: GaussianSet, specular: float) -> None:
    """k_s becomes min(k_s, its initial value), as EnvGS does (3DGS-DR raises it instead); its moments become 0."""
    base.gaussians["specular_logits"].clamp_(max=logit(specular))
    base.optimizer.zero_moments("specular_logits")


@torch.no_grad()
def raise_specular(base: GaussianSet, specular: float, weight: str = SPECULAR, inside: Tensor | None = None) -> None:
    """k_s becomes max(k_s, ``specular``), as 3DGS-DR does at its resets; its moments become 0.

    ``inside`` (N,) bool: only of these Gaussians; None: of all.
    """
    _raise(base.gaussians[weight], specular, inside)
    base.optimizer.zero_moments(weight)


def _raise(logits: Tensor, least: float, inside: Tensor | None) -> None:
    """Logits (N,) become at least that of ``least`` 0..1, in the rows ``inside`` (N,) bool; None: in all."""
    raised = logits.clamp(min=logit(least))
    logits.copy_(raised if inside is None else torch.where(inside, raised, logits))


def grow_across(log_scales: Tensor, chosen: Tensor, factor: float) -> None:
    """Make the ``chosen`` (N,) bool rows larger, along their surface: of three axes the shortest stays."""
    step = torch.full_like(log_scales, math.log(factor))
    if log_scales.shape[1] == 3:
        step.scatter_(1, log_scales.argmin(dim=1, keepdim=True), 0.0)
    log_scales[chosen] += step[chosen]
