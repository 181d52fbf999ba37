"""3DGS-DR (Ye et al., SIGGRAPH 2024; docs/3dgs_dr.md): ellipsoids, deferred shading, one cubemap.

Its numbers are in conf/method/3dgs_dr.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from rtgs.core.decisions import Decision
from rtgs.core.refuse import refuse_bad_numbers, refuse_outside, refuse_unless
from rtgs.methods.family import cubemap_stages, guided
from rtgs.methods.scope import ScopeSettings
from rtgs.methods.spec import FAR_LIGHT, HARMONICS, PROPAGATION, SABOTAGE, MethodSpec

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.gaussians.primitives import Gaussians
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.scope import ScopeHolder
    from rtgs.methods.spec import Setup
    from rtgs.train.terms import LossTerm


@dataclass(frozen=True)
class DeferredSettings(ScopeSettings):
    """The keys ``method.own.<name>``. Outside of the scope nothing is to reflect."""

    primitive: Literal["ellipsoids", "surfels"] = "ellipsoids"  # published: ellipsoids
    weight_floor: float = 0.001  # m is raised to it at resets of opacities
    outside: float = 0.4  # weight of the mean m of all Gaussians outside of the scope
    scope_specular: float = 0.3  # of scope=specular: m from which on a pixel is specular

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_bad_numbers(self, "method.own")
        refuse_outside(self, "method.own", 0, 1, "weight_floor", open_low=True)
        refuse_unless(self.weight_floor < 1, "method.own.weight_floor", self.weight_floor, "below 1")


def build(setup: Setup) -> Model:
    """A base set with a weight, and a cubemap that its mirror directions meet.

    Raises:
        ValueError: a loss is on that needs a surface, with ellipsoids.
    """
    from rtgs.methods.losses import mcmc_terms, refuse_surface_losses, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.cubemap_mirror import WEIGHT, CubemapMirror
    from rtgs.methods.parts.kinds import ELLIPSOIDS, SURFELS
    from rtgs.methods.parts.scope import ScopeHolder

    own: DeferredSettings = setup.own
    setup = replace(setup, settings=guided(setup.settings))
    surfels = own.primitive == "surfels"
    if not surfels:  # their normals are composited, but no depth goes with them
        refuse_surface_losses(setup.settings, ("normal", "distortion"))
    base = BaseSet(setup, SURFELS if surfels else ELLIPSOIDS)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup))
    if not own.scoped:
        return Model(setup, (base, CubemapMirror(setup, base, own.weight_floor)), terms)
    held = ScopeHolder(setup, base, own, WEIGHT, weight_of)
    mirror = CubemapMirror(setup, base, own.weight_floor, where=held)
    silent = Decision("no loss of the weights outside of the scope", "method.own.outside=0")
    return Model(setup, (base, held, mirror), (*terms, scope_term(base, own, held) if own.outside > 0 else silent))


def weight_of(gaussians: Gaussians) -> Tensor:
    """(N,) m: how specular Gaussians are."""
    from rtgs.methods.parts.cubemap_mirror import WEIGHT

    return gaussians.activated(WEIGHT)


def scope_term(base: BaseSet, own: DeferredSettings, held: ScopeHolder) -> LossTerm:
    """The mean m of the Gaussians outside of the scope, where there is one."""
    from rtgs.methods.parts.cubemap_mirror import WEIGHT
    from rtgs.train.terms import LossTerm

    def outside(rendered: object, view: object) -> Tensor | None:
        gaussians, scope = base.set.gaussians, held.scope
        if scope is None or WEIGHT not in gaussians:
            return None
        far = ~scope.holds(gaussians.means.detach())
        return gaussians.activated(WEIGHT)[far].mean() if bool(far.any()) else None

    return LossTerm("outside", own.outside, outside)


_DIFFUSE, _LIT = cubemap_stages("primitive")

# Without MIRROR: what ablations take away there is the traced set.
SPEC = MethodSpec(
    "3dgs_dr",
    (_DIFFUSE, replace(_LIT, version=3)),
    build,
    frozenset({HARMONICS, FAR_LIGHT, PROPAGATION, SABOTAGE}),
    own=DeferredSettings,
    layers={"diffuse": "(1 − m) C_d", "reflection": "m C_r", "specular": "m"},
)
