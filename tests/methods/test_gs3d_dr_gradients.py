"""The whole of 3DGS-DR, image, losses and every gradient, against a float64 composition of the twins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from reflective_cases import recipe
from torch import Tensor
from whole_twin import MCMC, SPHERE, STEP, Terms, Twin, begun, compare, reflected, rough_light, scene, shortest_axes

from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.settings import MaterialSettings
from rtgs.gaussians.surfels import activate
from rtgs.light.lookup import cube_lookup_twin
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.parts.cubemap_mirror import WEIGHT
from rtgs.methods.settings import MethodSettings
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import View
from rtgs.train.method import RenderedView
from rtgs.train.settings import LossSettings

SIDE = 8
LIGHT = EnvironmentSettings(side=SIDE, noise=2.0)
FILTERED = replace(LIGHT, mips="ggx", levels=(8, 4, 2), activate="before")
ALONE, GUIDED = LossSettings(normal=0.0), LossSettings(normal=0.0, mono_normal=0.02)
SURFACE = LossSettings(
    normal=0.02, normal_start=0.0, normal_inverse_depth=True, mono_normal=0.02, distortion=0.5, distortion_start=0.0
)
BRIGHT = RenderSettings(antialiased=True, background=(1.0, 0.7, 0.4))
CONVOLVED = RenderSettings(surfel_filter="convolved")
SURFELS = {"primitive": "surfels"}

CASES: dict[str, dict[str, Any]] = {
    "published": {"own": SPHERE},
    "guided, the first level of a filtered light": {"own": {}, "loss": GUIDED, "environment": FILTERED},
    "before a background, mcmc": {"own": {}, "render": BRIGHT, "density": MCMC},
    "surfels": {"own": SURFELS | SPHERE, "loss": SURFACE},
    "convolved surfels": {"own": SURFELS, "render": CONVOLVED},
}


class DeferredTwin(Twin):
    """image = (1 - m) C_d + m C_r, C_r what the mirror direction of the mean normal meets in the cubemap."""

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        raw = self.gaussians
        rows = activate(raw, camera.center, self.method.base.sh_degree(STEP))
        features = torch.cat((rows.colors, raw[WEIGHT].sigmoid()[:, None]), 1)
        normals = shortest_axes(raw, camera.center)[0] if isinstance(raw, Ellipsoids) else None
        buffers, fragile = self.raster(rows, features, normals, camera)
        view = camera.rays(torch.float64).directions.reshape(-1, 3)
        directions, _ = reflected(view, buffers.normal.flatten(1).T)
        light = self.light(directions).T.reshape(3, *fragile.shape)
        color, weight = buffers.features[:3], buffers.features[3]
        image = (1 - weight) * color + weight * light
        return RenderedView(camera, image, buffers, maps={"specular": weight}), fragile

    def light(self, directions: Tensor) -> Tensor:
        settings, texels = self.method.settings.environment, self.groups["environment"]["texels"]
        if settings.mips == "ggx":  # the first level, activated before
            return rough_light(texels.sigmoid(), settings.levels, directions, torch.zeros_like(directions[:, 0]))
        return cube_lookup_twin(texels.reshape(-1, 3), (SIDE,), directions).sigmoid()

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        if "scope_radius" not in self.own:
            return {}
        center = torch.tensor(self.own["scope_center"], dtype=torch.float64)
        far = (self.gaussians.means.detach() - center).norm(dim=1) > self.own["scope_radius"]
        return {"outside": (self.own["outside"], self.gaussians[WEIGHT][far].sigmoid().mean())}


def settings(own: dict[str, object], **changes) -> MethodSettings:
    """The family's short recipe; about half of what is seen is reflected."""
    materials = MaterialSettings(specular=0.5)
    found = replace(recipe("3dgs_dr"), materials=materials, own={"outside": 0.4, **own})
    return replace(found, **{"loss": ALONE, "environment": LIGHT, **changes})


@pytest.mark.parametrize("case", CASES)
def test_image_losses_and_every_gradient_are_those_of_the_twins(case: str):
    made = scene()
    method = begun(settings(**CASES[case]), made)
    found = compare(DeferredTwin(method), made)
    assert ("outside" in found.terms) == ("scope_radius" in method.settings.own)
    assert found.learned == {name for name, _ in method["base"].tensors()} | {"environment.texels"}
