"""The whole of GaussianShader, image, losses and every gradient, against a float64 composition of the twins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from reflective_cases import recipe
from torch import Tensor
from torch.nn.functional import normalize, pad
from whole_twin import MCMC, STEP, Terms, Twin, begun, compare, reflected, rough_light, scene, shortest_axes

from rtgs.core.cameras import Camera
from rtgs.gaussians.normals import BACK_RESIDUAL, FRONT_RESIDUAL
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.surfels import activate
from rtgs.light.lookup import cube_lookup_twin
from rtgs.light.prefilter import filtered_twin
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.parts.forward_shading import BASE_COLOR, LENGTH, ROUGHNESS, TINT
from rtgs.methods.settings import MethodSettings
from rtgs.optics.split_sum import split_sum_factors
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import View
from rtgs.train import reference_losses
from rtgs.train.losses import surface_depth
from rtgs.train.method import RenderedView
from rtgs.train.settings import LossSettings

SIDES = (16, 8, 4)
LIGHT = EnvironmentSettings(side=16, mips="ggx", levels=SIDES, activation="identity", initial=0.5, noise=0.5)
WEIGHTS = {"predicted_normal": 0.05, "binary_coverage": 0.01, "residual_norm": 0.05}  # each shows in the gradients
OFF = dict.fromkeys(WEIGHTS, 0.0)
DAYLIGHT = replace(LIGHT, initial=1.2)  # more than a photo shows
GUIDED = LossSettings(normal=0.0, mono_normal=0.02, clipped=True)
BRIGHT = RenderSettings(antialiased=True, background=(1.0, 0.7, 0.4))

CASES: dict[str, dict[str, Any]] = {
    "published": {"own": {}},
    "residual colours": {"own": {"residual": True}, "init": InitSettings(sh_degree=3)},
    "guided, clipped": {"own": {}, "loss": GUIDED, "environment": DAYLIGHT},
    "image alone": {"own": OFF},
    "before a background, mcmc": {"own": {"erosion": 3}, "render": BRIGHT, "density": MCMC},
}


class ShaderTwin(Twin):
    """Rows of colour c + (1 - k) E_d(n) + (k A + B) E_s(w_r, r), composited; and SH - 1/2 where a residual is on."""

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        raw, texels = self.gaussians, self.groups["environment"]["texels"]
        axes, front = shortest_axes(raw, camera.center)
        residual = torch.where(front[:, None], raw[FRONT_RESIDUAL], raw[BACK_RESIDUAL])
        normals = normalize(axes + residual, dim=1)
        base, tint, roughness = (raw[name].sigmoid() for name in (BASE_COLOR, TINT, ROUGHNESS))
        directions, cosine = reflected(raw.means - camera.center, normals)
        diffuse = cube_lookup_twin(filtered_twin(texels.reshape(-1, 3), SIDES[0], None), SIDES[:1], normals)
        scale, offset = (each[:, None] for each in split_sum_factors(cosine, roughness.square()))
        mirrored = (tint * scale + offset) * rough_light(texels, SIDES, directions, roughness)
        rows = activate(raw, camera.center, self.method.base.sh_degree(STEP))
        harmonics = rows.colors - 0.5 if self.own.get("residual") else 0.0
        color = base + (1 - tint) * diffuse + mirrored + harmonics
        features = torch.cat((color, residual.norm(dim=1, keepdim=True)), 1)
        buffers, fragile = self.raster(rows, features, normals, camera)
        for border in (1e-3, 1 - 1e-3):  # of the coverages whose loss has a gradient
            fragile |= (buffers.alpha.detach() - border).abs() < 1e-6
        maps = {LENGTH: buffers.features[3]} if self.own["residual_norm"] > 0 else {}
        return RenderedView(camera, buffers.features[:3], buffers, maps=maps), fragile

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        """w (1 - n . n_depth), log a (1 - a), w |residual|; w the least coverage of a square."""
        if not any(self.own[name] for name in WEIGHTS):
            return {}
        normal, depth, alpha = shown.buffers.normal, shown.buffers.depth, shown.buffers.alpha
        assert depth is not None
        assert normal is not None
        side = self.own.get("erosion", 4)
        open_ = pad(alpha.detach(), (side // 2, (side - 1) // 2) * 2, value=1.0)
        least = open_.unfold(0, side, 1).unfold(1, side, 1).amin((2, 3))
        target = reference_losses.depth_normals(surface_depth(depth, alpha).detach(), shown.camera)
        bounded = alpha.clamp(1e-3, 1 - 1e-3)
        values = {
            "predicted_normal": (least * (1 - (normalize(normal, dim=0) * target).sum(0))).mean(),
            "binary_coverage": (bounded * (1 - bounded)).log().mean(),
            "residual_norm": (least * shown.maps[LENGTH]).mean(),
        }
        return {name: (self.own[name], value) for name, value in values.items()}


def settings(own: dict[str, object], **changes) -> MethodSettings:
    """The family's short recipe with a small cubemap."""
    plain = {"loss": LossSettings(normal=0.0), "init": InitSettings(sh_degree=0), "environment": LIGHT}
    return replace(recipe("gaussian_shader"), own={**WEIGHTS, **own}, **{**plain, **changes})


@pytest.mark.parametrize("case", CASES)
def test_image_losses_and_every_gradient_are_those_of_the_twins(case: str):
    made = scene()
    method = begun(settings(**CASES[case]), made)
    found = compare(ShaderTwin(method), made)
    assert (set(WEIGHTS) <= found.terms.keys()) == (case != "image alone")
    harmonics = set() if "residual" in method.settings.own else {"sh_dc", "sh_rest"}
    assert found.learned == {name for name, _ in method["base"].tensors()} - harmonics | {"environment.texels"}
