"""The composed render of the third stage, forward and backward, against a float64 composition of the twins."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import begun, glass_recipe, glass_scene, randomised
from glass_twin import GlassTwin, doubled

from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods.settings import InterfaceSettings
from rtgs.optics.settings import WallSettings
from rtgs.train.method import Mode

STEP = 40  # SH of degree 2 in the base set

CASES: dict[str, dict[str, object]] = {
    "as recommended": {},
    "as in the paper": {
        "split": False,
        "first_surface": "base",
        "interface": InterfaceSettings(count=0),
        "max_weight": 0.3,  # neither acts without an interface
        "rim": 1,
    },
    "sum, clipped, no gradient": {"compositing": "sum", "first_bounce_end": "clip", "second_bounce_gradient": False},
    "no mesh guide": {"second_bounce": "first_bounce"},
    "base set inside": {"first_bounce": "base"},
    "bounded weight, rim": {"max_gain": 16.0, "max_weight": 0.3, "rim": 1, "sh_degree": 1},
    "clamped weight": {"max_gain": 16.0, "max_weight": 0.3, "weight_bound": "clamp"},
}


@pytest.mark.parametrize("case", [*CASES, "raw directions, rgb f0", "linear light", "thin glass", "tinted glass"])
def test_image_and_every_gradient_are_those_of_the_twins(case: str):
    made = glass_scene()
    settings = glass_recipe(**CASES.get(case, {}))
    materials = MaterialSettings(specular=0.3)
    if case in ("linear light", "thin glass", "tinted glass"):
        settings = replace(settings, optics=replace(settings.optics, blend="linear"))
    if case in ("thin glass", "tinted glass"):
        walls = WallSettings(light="fresnel", bounces=2)
        walls = replace(walls, tint=(0.5, 0.7, 0.9)) if case == "tinted glass" else walls
        settings = replace(settings, transmittance=replace(settings.transmittance, normal="mesh", wall=walls))
    if case == "raw directions, rgb f0":
        settings = replace(settings, reflection=replace(settings.reflection, sh_direction="raw"))
        materials = replace(materials, f0_channels=3)
    method = begun(replace(settings, materials=materials), made)
    randomised(method)
    view = made.scene.train[0]
    assert view.mask is not None
    twin_sets = {part.name: doubled(part.gaussians) for part in method.sets}  # type: ignore[arg-type]
    rendered = method.render(view.camera, STEP, Mode.TRAIN, mask=view.mask)
    assert rendered.maps.get("transparent") is not None
    grown = settings.transmittance.rim > 0 and settings.transmittance.interface.count > 0
    assert bool((rendered.maps["transparent"] & ~view.mask).any()) == grown
    assert not bool((view.mask & ~rendered.maps["transparent"]).any())
    twin = GlassTwin(method, twin_sets, view.camera, STEP).render(rendered.maps["transparent"])
    clear = ~twin.fragile
    assert float(clear.double().mean()) > 0.3
    assert int((clear & view.mask).sum()) > 20
    error = (rendered.image.detach().double() - twin.image.detach()).abs().amax(0)
    assert float(error[clear].max()) < 2e-4
    upstream = torch.randn(twin.image.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * clear
    (twin.image * upstream).sum().backward()
    (rendered.image * upstream.float()).sum().backward()
    for part in method.sets:
        for name, tensor in part.gaussians.items():
            expected = twin_sets[part.name][name].grad
            if expected is None or float(expected.abs().max()) == 0:
                assert tensor.grad is None or float(tensor.grad.abs().max()) < 1e-6, f"{part.name}.{name}"
                continue
            assert tensor.grad is not None, f"{part.name}.{name}"
            worst = (tensor.grad.double() - expected).abs().max() / expected.abs().max()
            assert float(worst) < 1e-3, f"{part.name}.{name}: {float(worst):.2g}"


@pytest.mark.parametrize("form", ["accum", "mean", "per_hit"])
def test_the_depth_loss_is_that_of_its_definition(form: str):
    made = glass_scene()
    settings = glass_recipe(split=False, box="scene")  # surfels behind the object too
    loss = replace(settings.loss, transmission_depth_form=form, transmission_depth_start=0.5)
    method = begun(replace(settings, loss=loss), made)
    assert method.find("transmittance") is not None
    with torch.no_grad():
        method.find("transmittance").gaussians.opacity_logits += 3
    view = made.scene.train[0]
    rendered = method.render(view.camera, STEP, Mode.TRAIN, mask=view.mask)
    assert rendered.kept is not None
    found = {term.name: term.value for term in method.losses(rendered, view, STEP).terms}
    bounce = rendered.kept
    depth, alpha, thickness = bounce.depth.detach(), bounce.alpha.detach(), bounce.thickness
    pixels = view.camera.width * view.camera.height
    if form == "per_hit":
        assert bounce.beyond is not None
        # Every hit behind the back surface adds w (t - thickness): at least what their sum says about the mean.
        assert float((bounce.beyond.detach() - (depth - thickness * alpha)).min()) > -1e-4
        expected = float(bounce.beyond.detach().clamp_min(0).sum()) / pixels
    else:
        mean = depth / alpha.clamp_min(1e-3) if form == "mean" else depth
        expected = float((mean - thickness).clamp_min(0).sum()) / pixels
    assert expected > 0
    assert found["transmission_depth"] == pytest.approx(expected, rel=1e-5)
    assert len(thickness) > 20
    assert float(thickness.min()) > 0
    twins = {part.name: doubled(part.gaussians) for part in method.sets}  # type: ignore[arg-type]
    assert view.mask is not None
    twin = GlassTwin(method, twins, view.camera, STEP).render(view.mask)
    assert len(twin.first_depth) == len(depth)
    exact = twin.first_depth.detach().sort().values  # the rays come in another order
    torch.testing.assert_close(depth.double().sort().values, exact, rtol=1e-3, atol=1e-3)
