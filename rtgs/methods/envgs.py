"""EnvGS (Xie et al. 2025; method.md 6.1, 12): base set and environment set, one mirror ray of weight 1.

It is RT-GS's second stage with ``optics.weight: envgs``; its numbers are in conf/method/envgs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.family import DIFFUSE, REFLECTION, TRACED_LAYERS
from rtgs.methods.spec import HARMONICS, MIRROR, PROPAGATION, SABOTAGE, SURFACE, MethodSpec

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """A base set with materials, and a traced set that its mirror rays meet."""
    from rtgs.methods.losses import mcmc_terms, perceptual_terms, specular_terms, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.mirror import Mirror

    base = BaseSet(setup, SURFELS)
    mirror = Mirror(setup, base)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup), *perceptual_terms(setup), *specular_terms(setup))
    return Model(setup, (base, mirror), terms)


_HAS = frozenset({HARMONICS, SURFACE, MIRROR, PROPAGATION, SABOTAGE})
SPEC = MethodSpec("envgs", (DIFFUSE, REFLECTION), build, _HAS, layers=TRACED_LAYERS)
