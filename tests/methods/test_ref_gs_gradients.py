"""The whole of Ref-GS, image, losses and every gradient, against a float64 composition of the twins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from glass_twin import to_srgb
from reflective_cases import recipe
from torch import Tensor
from whole_twin import MCMC, SPHERE, STEP, VIEW, Terms, Twin, begun, compare, photometric, reflected, scene

from rtgs.core.cameras import Camera
from rtgs.gaussians.surfels import activate
from rtgs.light.feature_map import box_pyramid
from rtgs.light.feature_network import mirrored_light_twin
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.exposure import Exposure
from rtgs.methods.parts.feature_light import NETWORK
from rtgs.methods.parts.feature_mirror import ALBEDO, FEATURE, OUTSIDE, ROUGHNESS, SH_IMAGE
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.methods.settings import MethodSettings
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import View
from rtgs.train.method import RenderedView
from rtgs.train.settings import LossSettings

SIDE, LEVELS = 16, 4  # rows of the map of features; 16, 8, 4, 2
LEAST = 0.05  # of the inside, in pixels that are shaded
SURFACE = LossSettings(
    normal=0.01, normal_start=0.0, normal_inverse_depth=True, mono_normal=0.01, distortion=0.5, distortion_start=0.0
)
ALONE, EXPOSED = LossSettings(normal=0.0), AppearanceSettings(enabled=True)
BRIGHT = RenderSettings(background=(1.0, 0.7, 0.4))

CASES: dict[str, dict[str, Any]] = {
    "everywhere": {"own": {}},
    "sphere": {"own": SPHERE},
    "a scope that is not known yet": {"own": {"scope": "specular"}},
    "image alone": {"own": {"opacity_entropy": 0.0}, "loss": ALONE},
    "the finest level alone": {"own": {"roughness_levels": False}},
    "before a background, mcmc": {"own": {}, "render": BRIGHT, "density": MCMC},
    "sphere before a background, as exposed": {"own": SPHERE, "render": BRIGHT, "appearance": EXPOSED},
}


class FeatureTwin(Twin):
    """in encoded(albedo + light) + out SH, what is seen behind both, and all of it as the photo was exposed."""

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        raw, scoped = self.gaussians, "scope_radius" in self.own
        rows = activate(raw, camera.center, self.method.base.sh_degree(STEP))
        columns = [rows.colors, raw[ALBEDO].exp(), raw[ROUGHNESS].sigmoid()[:, None], raw[FEATURE].tanh()]
        if scoped:
            center = torch.tensor(self.own["scope_center"], dtype=torch.float64)
            columns.append(((raw.means - center).norm(dim=1, keepdim=True) <= self.own["scope_radius"]).double())
        buffers, fragile = self.raster(rows, torch.cat(columns, 1), None, camera)
        colors, albedo, roughness, feature = buffers.features[:11].split((3, 3, 1, 4))
        inside = buffers.features[11].detach() if scoped else buffers.alpha
        fragile |= (inside.detach() - LEAST).abs() < 1e-5
        light = self.light(camera, buffers.normal, roughness, feature)
        clear = (1 - buffers.alpha) * self.background[:, None, None]
        image = inside * torch.where(inside > LEAST, to_srgb(albedo + light), 0.0) + clear
        maps = {}
        if self.own.get("scope") == "specular":  # of which nothing is known yet: SH colours learn everywhere
            maps = {SH_IMAGE: self.exposed(colors), OUTSIDE: buffers.alpha.detach()}
        if scoped:
            outside = (buffers.alpha.detach() - inside).clamp_min(0)
            image = image + outside * (colors - clear.detach())
            maps = {SH_IMAGE: self.exposed(colors), OUTSIDE: outside}
        return RenderedView(camera, self.exposed(image), buffers, maps=maps), fragile

    def light(self, camera: Camera, normal: Tensor, roughness: Tensor, feature: Tensor) -> Tensor:
        """(3, H, W) what the mean normals mirror."""
        directions, _ = reflected(camera.rays(torch.float64).directions.reshape(-1, 3), normal.flatten(1).T)
        local = directions @ self.method.parts["mirror"].learned.frame.double().T
        pyramid = box_pyramid(self.groups["environment"]["texels"])
        level = LEVELS * self.own.get("roughness_levels", True) * roughness.flatten()
        surface = (level, feature.flatten(1).T)
        return mirrored_light_twin(self.groups[NETWORK], pyramid, SIDE, local, *surface).T.reshape(normal.shape)

    def exposed(self, image: Tensor) -> Tensor:
        """2^t (image + C image), less what C makes a grey brighter."""
        if Exposure.name not in self.groups:
            return image
        stops, colors = (self.groups[Exposure.name][name][VIEW] for name in ("stops", "colors"))
        return 2**stops * (image + torch.einsum("ab,bhw->ahw", colors, image) - colors.sum(1).mean() * image)

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        loss, opacity = self.method.settings.loss, self.gaussians.opacity_logits.sigmoid()
        entropy = -(opacity * opacity.log() + (1 - opacity) * (1 - opacity).log()).mean()
        terms = {"opacity_entropy": (self.own["opacity_entropy"], entropy)}
        if OUTSIDE in shown.maps:
            weight = shown.maps[OUTSIDE]
            l1, dssim = photometric(shown.maps[SH_IMAGE] * weight, view.image.double() * weight)
            terms["outside"] = (1.0, loss.l1 * l1 + loss.dssim * dssim)
        if Exposure.name in self.groups:
            mean = {name: values.mean(0) for name, values in self.groups[Exposure.name].items()}
            terms |= {"exposure": (1.0, smooth_size(mean["stops"])), "tint": (1.0, smooth_size(mean["colors"]))}
        return terms


def smooth_size(values: Tensor) -> Tensor:
    """The sum of 5 x^2 up to 0.1 and of |x| - 0.05 beyond."""
    size = values.abs()
    return torch.where(size < 0.1, 5 * size.square(), size - 0.05).sum()


def settings(own: dict[str, object], **changes) -> MethodSettings:
    """The family's short recipe with a small map."""
    found = replace(recipe("ref_gs"), environment=EnvironmentSettings(side=SIDE, noise=2.0))
    return replace(found, own={"opacity_entropy": 0.02, **own}, **{"loss": SURFACE, **changes})


def randomised(method: Model) -> Model:
    """A network that tells directions apart, and photos of different exposure."""
    generator = torch.Generator().manual_seed(6)
    with torch.no_grad():
        for group in method.groups:
            for name, values in group.tensors():
                if group.name == Exposure.name:
                    values += 0.2 * torch.randn(values.shape, generator=generator)
                elif name.startswith("weight"):
                    values *= 2
    return method


@pytest.mark.parametrize("case", CASES)
def test_image_losses_and_every_gradient_are_those_of_the_twins(case: str):
    made = scene()
    method = randomised(begun(settings(**CASES[case]), made))
    found = compare(FeatureTwin(method), made)
    own, groups = method.settings.own, {f"{g.name}.{name}" for g in method.groups for name, _ in g.tensors()}
    outside = "scope_radius" in own or "scope" in own
    assert ("outside" in found.terms) == outside
    still = set() if outside else {"sh_dc", "sh_rest"}
    still |= set() if own.get("roughness_levels", True) else {ROUGHNESS}
    assert found.learned == {name for name, _ in method["base"].tensors()} - still | groups
