"""EnvGS's remedies for baked-in reflections: normal propagation, colour sabotage, resets (method.md 6.1)."""

from __future__ import annotations

import math

import torch

from rtgs.gaussians.density import logit
from rtgs.gaussians.materials import MaterialSurfels
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.settings import PropagationSettings
from rtgs.train.method import StepEvent


@torch.no_grad()
def propagate_normals(base: GaussianSet, settings: PropagationSettings, generator: torch.Generator) -> StepEvent:
    """Make every surfel opaque, specular ones larger, and add noise to the colour of the others.

    Opaque surfels with a good normal cover their neighbours, so that these learn theirs; the noise undoes what a matte
    colour has baked in, so that reflection has something left to explain. Moments of what changed become 0.
    """
    surfels = base.gaussians
    assert isinstance(surfels, MaterialSurfels)
    specular = surfels.specular_logits.sigmoid()
    surfels.opacity_logits.clamp_(min=logit(settings.opacity))
    base.optimizer.zero_moments("opacity_logits")
    grown = specular >= settings.grow_border
    surfels.log_scales[grown] += math.log(settings.grow)
    base.optimizer.zero_moments("log_scales")
    sabotaged = specular <= settings.sabotage_border
    if settings.sabotage > 0:
        noise = settings.sabotage * (2 * torch.rand(surfels.sh_dc.shape, generator=generator) - 1)
        surfels.sh_dc += torch.where(sabotaged[:, None], noise, 0.0)
        base.optimizer.zero_moments("sh_dc")
    detail = f"normals propagated: {int(grown.sum())} surfels grown, colours of {int(sabotaged.sum())} disturbed"
    return StepEvent("propagation", base.name, detail)


@torch.no_grad()
def reset_specular(base: GaussianSet, specular: float) -> None:
    """k_s becomes min(k_s, its initial value), as EnvGS does (3DGS-DR raises it instead); its moments become 0."""
    surfels = base.gaussians
    assert isinstance(surfels, MaterialSurfels)
    surfels.specular_logits.clamp_(max=logit(specular))
    base.optimizer.zero_moments("specular_logits")
