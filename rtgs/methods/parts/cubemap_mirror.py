"""The reflection of 3DGS-DR (Ye et al., SIGGRAPH 2024): a composited weight m, one lookup in a cubemap a pixel.

image = (1 - m) C_d + m C_r. Normals are propagated from where they are right (method.md 6.1, in EnvGS's numbers);
where reflection has a scope, inside of it alone.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from rtgs.gaussians.channels import Channel
from rtgs.light.cubemap import CubemapLight
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.environment import Environment
from rtgs.methods.parts.part import Frame, Part, Raster
from rtgs.methods.parts.propagation import propagate_normals, raise_specular
from rtgs.methods.plans import base_densify_due, base_reset_due, opacities_held, propagation_due, reflection_plan
from rtgs.methods.settings import MatteSettings
from rtgs.methods.shading.deferred import blended, mirror_directions
from rtgs.train.method import RenderedView, RenderOptions, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup

if TYPE_CHECKING:
    from rtgs.methods.parts.scope import ScopeHolder
    from rtgs.methods.spec import Setup

WEIGHT = "specular_logits"  # of the channel m of 3DGS-DR: rate, files and propagation know it by the name of k_s


class CubemapMirror(Part):
    """The weight m on the base set, and the cubemap that its mirror directions meet, from their stage on.

    Attributes:
        plan: when the stage does what.
        environment: the cubemap.
    """

    name = "mirror"
    weight = WEIGHT  # the channel that says how much a Gaussian reflects

    def __init__(
        self,
        setup: Setup,
        base: BaseSet,
        weight_floor: float,
        stage: str = "reflection",
        where: ScopeHolder | None = None,
    ) -> None:
        """``weight_floor``: m is raised to it at every reset of opacities; ``where``: what may reflect, None: all."""
        self.base = base
        self.where = where
        self.settings = setup.settings
        self.generator = setup.generator
        # There is no traced set to reset, and no scene is judged matte.
        self._reflection = replace(setup.settings.reflection, matte=MatteSettings(probation=0), opacity_reset_every=0)
        self.plan = reflection_plan(self._reflection, base.schedule)
        self.environment = Environment(setup, self.plan.start)
        self._floor = weight_floor
        self._stage = stage

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return self.environment.groups

    @property
    def light(self) -> CubemapLight | None:
        return self.environment.light

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """The channels on the base set, and the cubemap from noise."""
        if stage.name != self._stage or self.environment.group is not None:
            return
        self._adopt((self.weight,))
        self.environment.begin()
        side = self.settings.environment.side
        yield StepEvent("begin", self.environment.name, f"a cubemap of 6 x {side} x {side} texels")

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Those that this part may add to the base set."""
        return (Channel(self.weight, self.settings.materials.specular, "sigmoid"),)

    def _adopt(self, names: Container[str]) -> None:
        """Have the channels of these names on the base set, and no other of this part; none: leave the set alone."""
        gaussians, wanted = self.base.set.gaussians, [each for each in self.channels if each.name in names]
        surplus = [each.name for each in self.channels if each.name not in names]
        more = [each for each in wanted if each.name not in gaussians]
        if more or any(name in gaussians for name in surplus):
            self.base.set.adopt(gaussians.without_channels(*surplus).with_channels(*more))
        self.base.rules = self if wanted else None

    # ---- rendering

    def needs(self, frame: Frame) -> RenderOptions:
        return RenderOptions(normal=self.environment.group is not None)

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """Every pixel looks up what its mean normal mirrors."""
        light = self.environment.light
        if light is None:
            return None
        camera, buffers = frame.camera, raster.buffers
        assert buffers.normal is not None
        flat = buffers.features.flatten(1)
        diffuse, weight = flat[:3], flat[3]
        rays = mirror_directions(buffers.normal.flatten(1), frame.rays.center, frame.rays.directions)
        color = light(rays.directions).T
        shape = (3, camera.height, camera.width)
        image = blended(diffuse, weight, color).reshape(shape)
        specular = weight.reshape(shape[1:])
        layers = None
        if frame.options.layers:
            shown = {"diffuse": diffuse, "reflection": weight * color, "reflected_color": color}
            layers = {name: value.detach().reshape(shape) for name, value in shown.items()}
            layers["specular"] = specular.detach()
            if frame.options.weights:
                layers["reflection_weight"] = layers["specular"].clone()  # files hold no tensor twice
        return RenderedView(camera, image, buffers, layers, {"specular": specular}, observations=raster.observations)

    # ---- what it decides about the base set

    def held(self, step: int) -> tuple[str, ...]:
        """Opacities stand still for a while after a propagation of normals."""
        return ("opacity_logits",) if opacities_held(self.plan, self._reflection, step) else ()

    def densify_due(self, following: int) -> bool:
        return base_densify_due(self.plan, self._reflection, following)

    def reset_due(self, following: int) -> bool:
        return base_reset_due(self.plan, following)

    def inside(self) -> Tensor | None:
        """(N,) bool: the Gaussians that may reflect; None: all, there is no scope or none yet."""
        scope = None if self.where is None else self.where.scope
        return None if scope is None else scope.holds(self.base.set.gaussians.means.detach())

    def after_reset(self) -> None:
        """m becomes at least its floor: what has lost its reflection gets another chance, inside of the scope."""
        raise_specular(self.base.set, self._floor, self.weight, self.inside())

    def control(self, following: int) -> Iterator[StepEvent]:
        """Propagation of the base set's normals, inside of the scope."""
        if self.environment.group is not None and propagation_due(self.plan, self._reflection, following):
            settings = self._reflection.propagation
            yield propagate_normals(self.base.set, settings, self.generator, self.weight, inside=self.inside())

    # ---- state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The channels and the cubemap as the state has them."""
        prefix = f"{self.base.name}.surfels."
        self._adopt({name.removeprefix(prefix) for name in state if name.startswith(prefix)})
        self.environment.restore(state)
