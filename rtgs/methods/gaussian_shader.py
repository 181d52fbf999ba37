"""GaussianShader (Jiang et al., CVPR 2024; docs/gaussian_shader.md): ellipsoids, each shaded before it is composited.

Its numbers are in conf/method/gaussian_shader.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rtgs.core.refuse import refuse_bad_numbers, refuse_outside, refuse_unless
from rtgs.methods.family import guided
from rtgs.methods.reads import diffuse_alone
from rtgs.methods.spec import FAR_LIGHT, FORWARD, MethodSpec, StageSpec

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods.model import Model
    from rtgs.methods.settings import MethodSettings
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View
    from rtgs.train.method import RenderedView
    from rtgs.train.terms import LossTerm

STAGE = "shading"


@dataclass(frozen=True)
class ShaderSettings:
    """The keys ``method.own.<name>``. Defaults are those of the published code."""

    tint: float = 0.5  # at the start
    roughness: float = 0.64565631  # at the start: the raw value 0.6
    residual: bool = False  # SH colours are added; the published run trains none
    normal_gain: float = 1.0  # of the rate of normals, times that of roughness
    predicted_normal: float = 0.2  # weight of w (1 - n . n_depth)
    binary_coverage: float = 1e-3  # weight of log a + log(1 - a)
    residual_norm: float = 1e-3  # weight of w |residual of the normal|
    erosion: int = 4  # pixels: w is the least coverage in a square of this side
    # The published code gives the environment's rate to base colours, tints, roughness, SH and the residuals of the
    # front, so that the two sides of a Gaussian learn at rates 80 times apart.
    shared_rate: bool = False

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.own")
        for name in ("tint", "roughness"):
            value = getattr(self, name)
            refuse_unless(0 < value < 1, f"method.own.{name}", value, "between 0 and 1")
        refuse_unless(1 <= self.erosion <= 64, "method.own.erosion", self.erosion, "between 1 and 64 pixels")
        refuse_outside(self, "method.own", 0, 1e3, "normal_gain", "predicted_normal", "binary_coverage")


def build(setup: Setup) -> Model:
    """Ellipsoids with materials, and the cubemap that lights them.

    Raises:
        ValueError: a loss is on that needs a surface, or the cubemap is not as a shader needs it.
    """
    from rtgs.methods.losses import mcmc_terms, refuse_surface_losses, surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.forward_shading import ForwardShading
    from rtgs.methods.parts.kinds import ELLIPSOIDS

    own: ShaderSettings = setup.own
    setup = replace(setup, settings=guided(setup.settings))
    refuse_surface_losses(setup.settings, ("normal", "distortion"))
    light = setup.settings.environment
    refuse_unless(
        light.mips == "ggx", "method.environment.mips", light.mips, "ggx: there is a level for each roughness"
    )
    kind = light.activation
    refuse_unless(
        kind == "identity", "method.environment.activation", kind, "identity: texels are held between 0 and 1"
    )
    base = BaseSet(setup, ELLIPSOIDS)
    terms = (*surface_terms(setup), *mcmc_terms(base, setup), *shader_terms(own))
    return Model(setup, (base, ForwardShading(setup, base, own, STAGE)), terms)


def shader_terms(own: ShaderSettings) -> Sequence[LossTerm]:
    """Normals towards those of the depth, coverages towards 0 and 1, small residuals; w is the eroded coverage."""
    from rtgs.methods.parts.forward_shading import LENGTH
    from rtgs.render.depth_normals import depth_normals
    from rtgs.train.coverage_losses import binary_coverage_loss, eroded
    from rtgs.train.losses import surface_depth
    from rtgs.train.method import RenderOptions
    from rtgs.train.terms import LossTerm

    def predicted(rendered: RenderedView, view: View) -> Tensor:
        buffers = rendered.buffers
        assert buffers.normal is not None
        assert buffers.depth is not None
        depth, alpha = buffers.depth.detach(), buffers.alpha.detach()
        target = depth_normals(surface_depth(depth, alpha), rendered.camera)
        length = buffers.normal.square().sum(0).clamp_min(1e-12).sqrt()
        cosine = (buffers.normal * target).sum(0) / length
        return (eroded(alpha, own.erosion) * (1 - cosine)).mean()

    def covered(rendered: RenderedView, view: View) -> Tensor:
        return binary_coverage_loss(rendered.buffers.alpha)

    def small(rendered: RenderedView, view: View) -> Tensor | None:
        length = rendered.maps.get(LENGTH)
        return None if length is None else (eroded(rendered.buffers.alpha, own.erosion) * length).mean()

    both = RenderOptions(depth=True, normal=True)
    terms = (
        ("predicted_normal", own.predicted_normal, predicted, both),
        ("binary_coverage", own.binary_coverage, covered, RenderOptions()),
        ("residual_norm", own.residual_norm, small, RenderOptions()),
    )
    return [LossTerm(name, weight, value, needs=needs) for name, weight, value, needs in terms if weight > 0]


def _shaded(settings: MethodSettings) -> MethodSettings:
    """What the one stage reads: the first stage of others, and the environment with the rates of materials."""
    names = ("specular_logits", "roughness_logits")
    rates = {name: getattr(settings.optimizer, name) for name in names}
    plain = diffuse_alone(settings)
    return replace(plain, environment=settings.environment, optimizer=replace(plain.optimizer, **rates))


_HAS = frozenset({FAR_LIGHT, FORWARD})
_LAYERS = {
    "diffuse": "colour, residual and (1 − tint) × irradiance",
    "reflection": "(tint a + b) × light of the mirror direction",
    "specular": "tint, mean of its colours",
}
SPEC = MethodSpec(
    "gaussian_shader",
    (StageSpec(STAGE, reads=_shaded, version=2),),
    build,
    _HAS,
    own=ShaderSettings,
    layers=_LAYERS,
)
