"""The composed render of the second stage, forward and backward, against a float64 composition of the twins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, training_maps
from torch import Tensor
from whole_twin import BANDS, MCMC, Terms, Twin, begun, compare, scene

from rtgs.core.cameras import Camera
from rtgs.gaussians.materials import activate_materials
from rtgs.gaussians.settings import MaterialSettings
from rtgs.gaussians.surfels import activate
from rtgs.light.cubemap import CubemapLight
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, Stage
from rtgs.methods.model import Model
from rtgs.methods.parts.kinds import surfel_options
from rtgs.methods.parts.reflection_init import scene_color
from rtgs.methods.settings import PropagationSettings
from rtgs.methods.shading.mirror import (
    SHORTEST_NORMAL,
    mirror_rays,
    pixel_weights,
    specular_change,
    surface_pixels,
)
from rtgs.optics.settings import OpticsSettings
from rtgs.render.buffers import RasterBuffers
from rtgs.render.discontinuities.surfels import DiscontinuityBands, discontinuity_mask
from rtgs.render.discontinuities.trace import TraceBands, fragile_rays
from rtgs.render.reference import surfels as reference
from rtgs.render.reference import trace as reference_trace
from rtgs.scenes.scene import View
from rtgs.train.method import RenderedView
from rtgs.train.settings import LossSettings

STEP = 40  # SH of degree 2 in both sets
Bands = tuple[DiscontinuityBands, TraceBands]
WIDE: Bands = (DiscontinuityBands(), TraceBands())


@dataclass(frozen=True)
class TwinRender:
    image: Tensor  # (3, H, W) float64
    buffers: RasterBuffers  # of the base set
    fragile: Tensor  # (H, W) bool: a decision lies within float32 rounding of its threshold


def twin_render(method: Model, base, reflection, camera, images, texels=None, bands: Bands = WIDE) -> TwinRender:
    """What ``method.render`` computes, from float64 copies of both sets, by the readable twins alone."""
    settings = method.settings
    surfels = activate(base, camera.center, method.base.sh_degree(STEP))
    materials = activate_materials(base)
    features = torch.cat((surfels.colors, materials.specular[:, None], materials.roughness[:, None], materials.f0), 1)
    shape = (surfels.means, surfels.tangent_u, surfels.tangent_v, surfels.scales, surfels.opacities)
    options = surfel_options(training_maps(method, camera, STEP), settings.render, method.extent, weight_sum=False)
    buffers = reference.rasterize_surfels(*shape, features, camera, options=options)
    assert buffers.normal is not None
    assert buffers.depth is not None
    depth = buffers.depth / buffers.alpha.clamp_min(1e-6)
    flat = surface_pixels(
        buffers.features.flatten(1),
        buffers.alpha.flatten(),
        depth.flatten(),
        buffers.normal.flatten(1),
        settings.materials,
    )
    length = flat.normal.norm(dim=0)
    covered = (buffers.alpha.flatten() > settings.reflection.smallest_alpha) & (length > SHORTEST_NORMAL)
    rays = camera.rays(torch.float64)
    traced_set = activate(reflection, camera.center, 0)
    mirrored = mirror_rays(flat, rays.origin, rays.directions.reshape(-1, 3).T)
    traced_shape = (
        traced_set.means,
        traced_set.tangent_u,
        traced_set.tangent_v,
        traced_set.scales,
        traced_set.opacities,
    )
    trace = replace(method.parts["mirror"].trace_options(STEP, False), t_min=settings.reflection.offset * method.extent)
    colors = {"sh_dc": reflection.sh_dc, "sh_rest": reflection.sh_rest}
    traced = reference_trace.trace_surfels(
        *traced_shape, mirrored.origins, mirrored.directions, **colors, options=trace
    )
    assert traced.colors is not None
    weight = pixel_weights(mirrored.cosine, flat, settings.optics).reflection
    color = traced.colors
    if settings.reflection.background == "mean":  # the same pixels as the method's
        color = color + (1 - traced.alpha[:, None]) * scene_color("mean", images).double()
    if texels is not None:
        color = color + (1 - traced.alpha[:, None]) * CubemapLight(texels, settings.environment)(mirrored.directions)
    light = weight * color.T
    additive = settings.optics.weight == "additive"
    change = flat.specular * light if additive else specular_change(flat.diffuse, flat.specular, light, None)
    change = torch.where(covered, change, 0.0)
    image = (flat.diffuse + change).reshape(3, camera.height, camera.width)
    fragile = discontinuity_mask(*shape, features, camera, options=options, bands=bands[0]).flatten()
    fragile |= fragile_rays(
        *traced_shape, mirrored.origins, mirrored.directions, **colors, options=trace, bands=bands[1]
    )
    fragile |= (length < 0.05) | ((buffers.alpha.flatten() - settings.reflection.smallest_alpha).abs() < 1e-4)
    return TwinRender(image, buffers, fragile.reshape(camera.height, camera.width))


def doubled(surfels):
    """A float64 copy that requires gradients."""
    values = {name: tensor.detach().double().requires_grad_() for name, tensor in surfels.items()}
    return surfels.like(values)


CASES = {
    "microfacet": (OpticsSettings(), MaterialSettings(specular=0.3)),
    "rgb f0, linear roughness": (
        OpticsSettings(masking="separable"),
        MaterialSettings(specular=0.3, f0_channels=3, roughness_curve="linear", roughness=0.1),
    ),
    "not normalised": (OpticsSettings(max_gain=1.0), MaterialSettings(specular=0.3, f0=0.5, normalized=False)),
    "split sum": (OpticsSettings(weight="split_sum"), MaterialSettings(specular=0.3, roughness=0.2)),
    "conductor": (OpticsSettings(fresnel="conductor", edge_tint=0.7), MaterialSettings(specular=0.3, f0=0.6)),
    "dielectric": (OpticsSettings(fresnel="dielectric"), MaterialSettings(specular=0.3, f0=0.1, f0_channels=3)),
    "envgs": (OpticsSettings(weight="envgs"), MaterialSettings(specular=0.3)),
    "additive": (OpticsSettings(weight="additive"), MaterialSettings(specular=0.3)),
    "background": (OpticsSettings(weight="envgs"), MaterialSettings(specular=0.3)),
    "cubemap": (OpticsSettings(weight="envgs"), MaterialSettings(specular=0.3)),
}


@pytest.mark.parametrize("case", CASES)
def test_image_and_every_gradient_are_those_of_the_twins(case: str):
    made = tiny()
    optics, materials = CASES[case]
    background = {"background": "mean", "cubemap": "cubemap"}.get(case, "black")
    quiet = recipe(propagation=PropagationSettings(every=0), background=background)
    far = EnvironmentSettings(side=8, noise=1.0)
    method = new_method(replace(quiet, optics=optics, materials=materials, environment=far), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for part in method.sets:
            part.gaussians.sh_rest += 0.1 * torch.randn(part.gaussians.sh_rest.shape, generator=generator)
            part.gaussians.opacity_logits += 1.5
        method["base"].gaussians.log_scales += 0.3
    camera = made.scene.train[0].camera
    base, reflection = doubled(method.sets[0].gaussians), doubled(method.sets[1].gaussians)
    texels = [group["texels"].detach().double().requires_grad_() for group in method.groups]
    twin = twin_render(method, base, reflection, camera, [view.image for view in made.scene.train], *texels)
    rendered = method.render(camera, STEP, Mode.TRAIN)
    clear = ~twin.fragile
    assert float(clear.double().mean()) > 0.3
    error = (rendered.image.detach().double() - twin.image.detach()).abs().amax(0)
    assert float(error[clear].max()) < 2e-4
    upstream = torch.randn(twin.image.shape, generator=generator, dtype=torch.float64) * clear
    (twin.image * upstream).sum().backward()
    (rendered.image * upstream.float()).sum().backward()
    for part, exact in zip(method.sets, (base, reflection), strict=True):
        for name, tensor in part.gaussians.items():
            expected = exact[name].grad
            if expected is None or float(expected.abs().max()) == 0:
                assert tensor.grad is None or float(tensor.grad.abs().max()) < 1e-6, f"{part.name}.{name}"
                continue
            assert tensor.grad is not None, f"{part.name}.{name}"
            difference = (tensor.grad.double() - expected).norm() / expected.norm()
            assert float(difference) < 2e-3, f"{part.name}.{name}: {float(difference):.2g}"
    for group, exact in zip(method.groups, texels, strict=True):
        found = group["texels"].grad
        assert found is not None
        assert float((found.double() - exact.grad).norm() / exact.grad.norm()) < 2e-3
    assert len(texels) == (case == "cubemap")


# ---- with the losses of the stage

SURFACE = LossSettings(
    normal=0.02, normal_start=0.0, normal_inverse_depth=True, mono_normal=0.02, distortion=0.5, distortion_start=0.0
)
MATERIALS = ("specular_logits", "roughness_logits", "f0_logits")
TRAINED: dict[str, dict[str, Any]] = {
    "envgs": {"loss": SURFACE, "density": MCMC},
    "rtgs": {"loss": replace(SURFACE, clipped=True, normal_inverse_depth=False)},
}


class TracedTwin(Twin):
    """The second stage of EnvGS and RT-GS: what the mirror rays met is added."""

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        bands = (BANDS, TraceBands())
        found = twin_render(self.method, self.sets["base"], self.sets["reflection"], camera, [], bands=bands)
        maps = {"specular": found.buffers.features[3]}
        return RenderedView(camera, found.image, found.buffers, maps=maps), found.fragile

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        return {}


@pytest.mark.parametrize("name", TRAINED)
def test_losses_and_their_gradients_are_those_of_the_twins(name: str):
    made = scene()
    materials = MaterialSettings(specular=0.4, roughness=0.1)
    quiet = recipe(name, propagation=PropagationSettings(every=0))
    method = begun(replace(quiet, materials=materials, **TRAINED[name]), made)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        base, reflection = (method[each].gaussians for each in ("base", "reflection"))
        reflection.sh_rest += 0.1 * torch.randn(reflection.sh_rest.shape, generator=generator)
        reflection.opacity_logits += 1.5
        base.sh_dc += 5.0  # brighter than a photo shows
        for values in (base[raw] for raw in MATERIALS):
            values += 0.5 * torch.randn(values.shape, generator=generator)
    found = compare(TracedTwin(method), made)
    assert {"l1", "dssim", "normal", "mono_normal", "distortion"} <= found.terms.keys()
    both = {f"reflection.{raw}" for raw in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")}
    assert both <= found.learned
    unread = set(MATERIALS[1:]) if name == "envgs" else set()
    assert {raw for raw, _ in method["base"].tensors()} - unread <= found.learned
