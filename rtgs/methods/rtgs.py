"""RT-GS: the diffuse base set, then reflection with the microfacet weight, then transmittance (method.md 6.2).

Its numbers are in conf/method/rtgs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.family import DIFFUSE, REFLECTION, TRACED_LAYERS, TRANSMITTANCE
from rtgs.methods.spec import (
    BEYOND_PAPER,
    GLASS,
    HARMONICS,
    MICROFACET,
    MIRROR,
    PROPAGATION,
    SABOTAGE,
    SURFACE,
    MethodSpec,
)

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """A base set with materials, a traced reflection set, and in transparent objects a traced transmittance set."""
    from rtgs.methods.losses import glass_terms, mcmc_terms, perceptual_terms, specular_terms, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.glass import Glass
    from rtgs.methods.parts.glass_evidence import has_masks
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.mirror import Mirror

    base = BaseSet(setup, SURFELS)
    masked = "the scene has masks of a transparent object" if has_masks(setup.scene.train) else ""
    mirror = Mirror(setup, base, spared=masked)
    glass = Glass(setup, base, mirror)
    terms = (
        *surface_terms(setup),
        *mcmc_terms(base, setup),
        *perceptual_terms(setup),
        *specular_terms(setup, glass.mask),
        *glass_terms(setup, glass),
    )
    return Model(setup, (base, mirror, glass), terms)


_HAS = frozenset({HARMONICS, SURFACE, MIRROR, MICROFACET, GLASS, BEYOND_PAPER, PROPAGATION, SABOTAGE})
SPEC = MethodSpec("rtgs", (DIFFUSE, REFLECTION, TRANSMITTANCE), build, _HAS, layers=TRACED_LAYERS)
