"""Ref-Gaussian (Yao et al., ICLR 2025; docs/ref_gaussian.md): surfels and deferred split-sum shading with a cubemap,
and light from the scene itself where its mesh is in the way.

Its numbers are in conf/method/ref_gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_bad_counts, refuse_bad_numbers, refuse_outside, refuse_unknown_words, refuse_unless
from rtgs.methods.family import cubemap_stages, guided
from rtgs.methods.spec import FAR_LIGHT, HARMONICS, METAL, PROPAGATION, SURFACE, MethodSpec

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods.model import Model
    from rtgs.methods.settings import MethodSettings
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View
    from rtgs.train.method import RenderedView
    from rtgs.train.settings import ScheduleSettings
    from rtgs.train.terms import LossTerm


@dataclass(frozen=True)
class RefGaussianSettings:
    """The keys ``method.own.<name>``. Shares are of the run."""

    albedo: float = 0.5  # initial
    weight_floor: float = 0.01  # metalness is raised to it at resets of opacities
    grow_roughness: float = 0.01  # at propagations only what is at most this rough grows
    normal: Literal["mean", "unit"] = "mean"  # N / A as published, which is shorter than 1 where normals differ
    smooth: float = 0.0  # weight of what the map of normals changes where the photo does not
    smooth_until: float = 0.9
    # Until here each surfel is shaded by itself, under a cubemap of its own, and has no colour besides; then materials
    # begin anew. Published for synthetic scenes: 0.36; 0: never.
    forward_until: float = 0.0
    # From here on the mesh decides which mirror directions are free, 1: never; then at multiples of mesh_every.
    indirect_from: float = 0.5
    # Of every surfel: "zero", as published: what is not free is black at first; "light": as the cubemap looks, blurred.
    indirect_start: Literal["zero", "light"] = "zero"
    mesh_every: float = 0.1
    mesh_cells: int = 512  # along the depth that is fused; no finer than a pixel
    mesh_pieces: int = 1  # largest pieces that stay; 0: all
    reach: float = 10.0  # world units: what is met farther away is in nobody's way; 0: everything met is
    ray_offset: float = 0.0  # of the mirror rays' starts along the normal, voxels

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.own")
        refuse_bad_numbers(self, "method.own")
        refuse_bad_counts(self, "method.own", mesh_cells=2)
        refuse_outside(self, "method.own", 0, 1, "smooth_until", "forward_until", "indirect_from")
        refuse_outside(self, "method.own", 0, 1, "albedo", "weight_floor", "mesh_every", open_low=True)
        for name in ("albedo", "weight_floor"):
            refuse_unless(getattr(self, name) < 1, f"method.own.{name}", getattr(self, name), "below 1")


def build(setup: Setup) -> Model:
    """A base set with materials, and a cubemap that its mirror directions meet."""
    from rtgs.methods.losses import mcmc_terms, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.split_sum_mirror import SplitSumMirror

    own: RefGaussianSettings = setup.own
    setup = replace(setup, settings=guided(setup.settings))
    base = BaseSet(setup, SURFELS)
    mirror = SplitSumMirror(setup, base, own)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup), *smooth_terms(own, setup.schedule.total))
    return Model(setup, (base, mirror), terms)


def smooth_terms(own: RefGaussianSettings, total: int) -> tuple[LossTerm, ...]:
    """Normals that change only where the photo does, where the settings ask for it."""
    from rtgs.train.method import RenderOptions
    from rtgs.train.schedule import loss_start
    from rtgs.train.smoothness import edge_aware_smoothness
    from rtgs.train.terms import LossTerm

    if own.smooth == 0:
        return ()

    def value(rendered: RenderedView, view: View) -> Tensor:
        assert rendered.buffers.normal is not None
        return edge_aware_smoothness(rendered.buffers.normal, view.image)

    until = loss_start(own.smooth_until, total)
    return (LossTerm("smooth", own.smooth, value, until=until, needs=RenderOptions(normal=True)),)


def _reflection_start(settings: MethodSettings, schedule: ScheduleSettings) -> int:
    """As of all these methods.

    Raises:
        RtgsError: the part that shades surfels one by one would end before it begins.
    """
    start = _LIT.start(settings, schedule)
    share = SPEC.own_settings(settings).forward_until
    if share > 0 and round(share * schedule.total) <= start:
        raise RtgsError(
            f"method.own.forward_until={share:g} is step {round(share * schedule.total)} of {schedule.total}, but "
            f"surfels are shaded one by one only from step {start} on "
            f"(method.reflection.start={settings.reflection.start:g}): raise the first, lower the second, or set "
            "forward_until=0, which is never"
        )
    return start


_DIFFUSE, _LIT = cubemap_stages("smooth", "smooth_until")
# Without MIRROR: what ablations take away there is the traced set.
SPEC = MethodSpec(
    "ref_gaussian",
    (_DIFFUSE, replace(_LIT, start=_reflection_start, version=2)),
    build,
    has=frozenset({HARMONICS, SURFACE, FAR_LIGHT, METAL, PROPAGATION}),
    own=RefGaussianSettings,
    layers={
        "diffuse": "(1 − M) C_d",
        "reflection": "A (F_0 a + b) L",
        "specular": "metalness M; dielectrics reflect too",
        "f0": "F_0 = 0.04 (1 − M) + ρ M",
    },
)
