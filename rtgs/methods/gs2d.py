"""2DGS (Huang et al. 2024; method.md 12): one rasterised set of surfels, its colour in spherical harmonics.

Everything that sets it apart from other surfel methods is numbers in conf/method/2dgs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.family import DIFFUSE
from rtgs.methods.spec import HARMONICS, RASTERIZED, SURFACE, MethodSpec

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """A base set of surfels, shown as it is rasterised."""
    from rtgs.methods.losses import mcmc_terms, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS

    base = BaseSet(setup, SURFELS)
    return Model(setup, (base,), (*surface_terms(setup), *mcmc_terms(base, setup)))


SPEC = MethodSpec("2dgs", (DIFFUSE,), build, frozenset({HARMONICS, SURFACE, RASTERIZED}))
