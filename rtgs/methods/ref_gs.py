"""Ref-GS (Zhang et al., CVPR 2025; docs/ref_gs.md): surfels, a map of features by direction, a small network.

Its numbers are in conf/method/ref_gs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rtgs.core.refuse import refuse_bad_counts, refuse_outside, refuse_unless
from rtgs.methods.family import cubemap_stages, guided
from rtgs.methods.scope import ScopeSettings
from rtgs.methods.spec import FAR_LIGHT, FEATURE_LIGHT, HARMONICS, SURFACE, MethodSpec

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View
    from rtgs.train.method import RenderedView
    from rtgs.train.terms import LossTerm


@dataclass(frozen=True)
class FeatureSettings(ScopeSettings):
    """The keys ``method.own.<name>``. Defaults are those of the published code for real scenes.

    Outside of the scope SH colours stand; without one everything is inside.
    """

    width: int = 0  # of the network's hidden layers; 0: half of environment.side, 256 of 512
    network_rate: float = 5e-4
    albedo: float = -2.0  # log of five albedos at the start
    albedo_gain: float = 0.25  # of its rate, times that of sh_dc: 0.0005 of 0.002; other scenes 0.001
    # Standard deviation of the raw features at the start. 0 is published: their first gradient is then 1e12 times too
    # large, which Adam does not forget, and they stand still.
    feature_noise: float = 0.01
    roughness_levels: bool = True  # False: what is rough mirrors the finest level of the map, too
    opacity_entropy: float = 1e-3  # weight
    scope_specular: float = 0.65  # of scope=specular: 1 - r from which on a pixel is specular

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_bad_counts(self, "method.own")
        refuse_unless(self.width <= 1024, "method.own.width", self.width, "at most 1024")
        refuse_outside(self, "method.own", 0, math.inf, "network_rate", "albedo_gain", open_low=True)
        refuse_outside(self, "method.own", 0, math.inf, "feature_noise", "opacity_entropy")
        refuse_unless(-12 < self.albedo < 5, "method.own.albedo", self.albedo, "between -12 and 5")


def build(setup: Setup) -> Model:
    """Surfels with materials and features, and the light that they mirror.

    Raises:
        RtgsError: the map's side is no power of 2.
    """
    from rtgs.methods.losses import mcmc_terms, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.feature_mirror import ALBEDO, FeatureMirror, smoothness
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.scope import ScopeHolder

    own: FeatureSettings = setup.own
    side = setup.settings.environment.side
    refuse_unless(side >= 4 and side & (side - 1) == 0, "method.environment.side", side, "a power of 2, 4 or more")
    setup = replace(setup, settings=guided(setup.settings))
    base = BaseSet(setup, SURFELS)
    held = ScopeHolder(setup, base, own, ALBEDO, smoothness)
    mirror = FeatureMirror(setup, base, own, held)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup), *feature_terms(base, own, setup))
    return Model(setup, (base, held, mirror), terms)


def feature_terms(base: BaseSet, own: FeatureSettings, setup: Setup) -> Sequence[LossTerm]:
    """Opacities near 0 or 1, and where there is a scope the SH colours outside of it, all until it is found."""
    from rtgs.methods.parts.feature_mirror import OUTSIDE, SH_IMAGE
    from rtgs.methods.plans import reflection_plan
    from rtgs.train.coverage_losses import opacity_entropy
    from rtgs.train.losses import photometric_loss
    from rtgs.train.terms import LossTerm

    loss = setup.settings.loss
    start = reflection_plan(setup.settings.reflection, setup.schedule).start

    def entropy(rendered: RenderedView, view: View) -> Tensor:
        return opacity_entropy(base.set.gaussians.opacity_logits.sigmoid())

    def outside(rendered: RenderedView, view: View) -> Tensor | None:
        weight = rendered.maps.get(OUTSIDE)
        if weight is None:
            return None
        shown = rendered.maps[SH_IMAGE] * weight
        return photometric_loss(shown, view.image * weight, loss.l1, loss.dssim).total

    terms = (
        ("opacity_entropy", own.opacity_entropy, entropy),
        ("outside", float(own.scoped), outside),
    )
    return [LossTerm(name, weight, value, start) for name, weight, value in terms if weight > 0]


_HAS = frozenset({HARMONICS, SURFACE, FAR_LIGHT, FEATURE_LIGHT})
_LAYERS = {
    "diffuse": "albedo inside of the scope, colours outside",
    "reflection": "light of the feature map inside of the scope; as linear light the two add up",
    "specular": "how much of a pixel is inside of the scope, not how much it reflects",
    "roughness": "which level of the feature map is looked up",
}
SPEC = MethodSpec("ref_gs", cubemap_stages(), build, _HAS, own=FeatureSettings, layers=_LAYERS)
