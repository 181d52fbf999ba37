"""3DGS-DR (Ye et al., SIGGRAPH 2024; docs/3dgs_dr.md): ellipsoids, deferred shading, one cubemap.

Its numbers are in conf/method/3dgs_dr.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from rtgs.core.decisions import Decision
from rtgs.core.refuse import refuse_bad_numbers, refuse_outside, refuse_unless
from rtgs.methods.family import cubemap_stages, guided
from rtgs.methods.scope import ScopeSettings
from rtgs.methods.spec import HARMONICS, MethodSpec

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import Scene
    from rtgs.train.terms import LossTerm


@dataclass(frozen=True)
class DeferredSettings(ScopeSettings):
    """The keys ``method.own.<name>``. Outside of the scope nothing is to reflect."""

    primitive: Literal["ellipsoids", "surfels"] = "ellipsoids"  # published: ellipsoids
    weight_floor: float = 0.001  # m is raised to it at resets of opacities
    outside: float = 0.4  # weight of the mean m of all Gaussians outside of the scope

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
    from rtgs.methods.parts.cubemap_mirror import CubemapMirror
    from rtgs.methods.parts.kinds import ELLIPSOIDS, SURFELS

    own: DeferredSettings = setup.own
    setup = replace(setup, settings=guided(setup.settings))
    surfels = own.primitive == "surfels"
    if not surfels:  # their normals are composited, but no depth goes with them
        refuse_surface_losses(setup.settings, ("normal", "distortion"))
    base = BaseSet(setup, SURFELS if surfels else ELLIPSOIDS)
    mirror = CubemapMirror(setup, base, own.weight_floor)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup), *scope_terms(base, own, setup.scene))
    return Model(setup, (base, mirror), terms)


def scope_terms(base: BaseSet, own: DeferredSettings, scene: Scene) -> Sequence[LossTerm | Decision]:
    """The mean m of the Gaussians outside of the scope; where masks are to give it, what it is or why there is none."""
    from rtgs.methods.parts.cubemap_mirror import WEIGHT
    from rtgs.methods.scope import scope_of
    from rtgs.train.terms import LossTerm

    scope, said = scope_of(own, scene) if own.outside > 0 else (None, ())
    if scope is None:
        return said

    def outside(rendered: object, view: object) -> Tensor | None:
        gaussians = base.set.gaussians
        if WEIGHT not in gaussians:
            return None
        far = ~scope.holds(gaussians.means.detach())
        return gaussians.activated(WEIGHT)[far].mean() if bool(far.any()) else None

    return (LossTerm("outside", own.outside, outside), *said)


# Without MIRROR: what ablations take away there is the traced set.
SPEC = MethodSpec(
    "3dgs_dr",
    cubemap_stages("primitive"),
    build,
    frozenset({HARMONICS}),
    own=DeferredSettings,
)
