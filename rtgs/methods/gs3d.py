"""3DGS (Kerbl et al. 2023; method.md 12): one rasterised set of ellipsoids, its colour in spherical harmonics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.family import DIFFUSE
from rtgs.methods.spec import HARMONICS, RASTERIZED, MethodSpec

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """A base set of ellipsoids, shown as it is rasterised.

    Raises:
        ValueError: a loss is on that needs a surface.
    """
    from rtgs.methods.losses import mcmc_terms, refuse_surface_losses, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import ELLIPSOIDS

    refuse_surface_losses(setup.settings)
    base = BaseSet(setup, ELLIPSOIDS)
    return Model(setup, (base,), (*surface_terms(setup), *mcmc_terms(base, setup)))


SPEC = MethodSpec("3dgs", (DIFFUSE,), build, frozenset({HARMONICS, RASTERIZED}))
