"""Reflections that are added to the surface's own colour: C = C_d + k_s C_r (``method.optics.weight=additive``)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_step
from safetensors.torch import load_file, save_file

from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.core.recipe import canonical_json
from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods import Mode, RenderOptions, Stage, find_method
from rtgs.methods.settings import MethodSettings
from rtgs.optics.settings import OpticsSettings
from rtgs.report.shown import layers_of, shown_layer
from rtgs.runs.views import view_maps
from rtgs.view.mixing import mixed

ADDITIVE = OpticsSettings(weight="additive")


def shown(blend: str):
    """A trained view with all of its layers, and its camera."""
    optics = replace(ADDITIVE, blend=blend)
    settings = replace(recipe("envgs"), optics=optics, materials=MaterialSettings(specular=0.3))
    made = tiny()
    method = new_method(settings, made, schedule())
    method.begin(Stage("reflection", 15, 60))
    for step in range(15, 18):
        terms, _ = train_step(method, made, step)
        assert bool(terms.total.isfinite())
    camera = made.scene.test[0].camera
    with torch.no_grad():
        options = RenderOptions(depth=True, normal=True, layers=True, weights=True)
        return method.render(camera, 18, Mode.EVALUATE, options), camera


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_the_image_is_the_whole_base_and_the_reflection(blend: str, tmp_path):
    found, camera = shown(blend)
    layers = found.layers
    assert layers is not None
    assert torch.equal(layers["base"], layers["diffuse"])
    assert float(layers["reflection"].max()) > 0.01, "something reflects"
    maps = {"image": found.image, **layers}
    if blend == "srgb":
        torch.testing.assert_close(layers["base"] + layers["reflection"], found.image, atol=2e-6, rtol=0)
    alone = mixed(maps, {"reflection": 0.0}, blend)
    torch.testing.assert_close(alone, layers["base"], atol=2e-3, rtol=0)
    assert "weights" in layers_of(maps)
    assert (shown_layer("weights", maps, camera, None)[..., 1] == 255).all(), "nothing is taken from the base"
    torch.testing.assert_close(layers["reflection_weight"], layers["specular"] * layers["traced"])
    save_file({"image": found.image.contiguous(), **view_maps(found)}, tmp_path / "view.safetensors")
    assert "base" in load_file(tmp_path / "view.safetensors")


def test_light_through_glass_is_refused_before_anything_trains():
    rtgs = find_method("rtgs")
    settings = MethodSettings(name="rtgs", optics=ADDITIVE)
    assert len(rtgs.timeline(settings, schedule(1000))) == 2
    with pytest.raises(RtgsError, match=r"optics\.weight=additive.*method\.transmittance\.enabled=false"):
        rtgs.timeline(settings, schedule(1000), transparent=True)
    off = replace(settings, transmittance=replace(settings.transmittance, enabled=False))
    assert len(rtgs.timeline(off, schedule(1000), transparent=True)) == 2


def test_a_run_by_the_name_blend_is_that_of_envgs():
    words = ("scene=demo", "method=envgs")
    named, plain = (compose([*words, *more])[0].method for more in (("method.optics.weight=blend",), ()))
    assert canonical_json(named) == canonical_json(plain)
    added = compose([*words, "method.optics.weight=additive"])[0].method
    assert canonical_json(added) != canonical_json(plain)
