"""Glass of a model as a surface for other programs, and the scene behind it (rtgs/export/glass.py)."""

from __future__ import annotations

import numpy as np
import torch
from glass_cases import begun, fresnel, glass_recipe, glass_scene, new_glass_method

from rtgs.export.environment import bake_environment
from rtgs.export.glass import glass_object, glass_part, without_glass
from rtgs.light.pictures import upright
from rtgs.runs.views import seen_maps

STEP = 60


def test_the_mesh_of_the_glass_is_whole_and_points_outward():
    made = glass_scene()
    found = glass_object(begun(fresnel(index=1.47), made))
    assert found is not None
    assert abs(found.index - 1.47) < 1e-6
    assert found.tint == (1.0, 1.0, 1.0)
    assert len(found.faces)
    assert found.faces.max() == len(found.vertices) - 1
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-5)
    middle = found.vertices.mean(0)
    assert (((found.vertices - middle) * found.normals).sum(1) > 0).mean() > 0.95


def test_a_model_without_the_stage_has_no_glass():
    made = glass_scene()
    model = new_glass_method(glass_recipe(), made, mesh=False)
    assert glass_part(model) is None
    assert glass_object(model) is None
    camera = made.scene.test[0].camera
    maps = seen_maps(model, camera, 0)
    assert without_glass(model, camera, maps) is maps["image"]


def test_without_glass_only_its_pixels_change_to_what_is_behind():
    made = glass_scene()
    for settings in (fresnel(), glass_recipe()):
        model = begun(settings, made)
        camera = made.scene.test[0].camera
        maps = seen_maps(model, camera, STEP)
        clear = without_glass(model, camera, maps)
        part = glass_part(model)
        assert part is not None
        assert part.guide is not None
        seen = part.on_glass(part.guide.surfaces(camera))
        changed = (clear != maps["image"]).any(0)
        assert bool(changed.any())
        assert not bool((changed & ~seen).any())
        assert bool(torch.isfinite(clear).all())


def test_the_environment_is_traced_from_the_middle():
    made = glass_scene()
    model = begun(fresnel(), made)
    with torch.no_grad():
        model["reflection"].gaussians.opacity_logits += 6
        model["reflection"].gaussians.log_scales += 1
    frame = upright(np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    found = bake_environment(model, STEP, np.zeros(3), 0.5, frame, 8)
    assert found is not None
    assert found.panorama.shape == (8, 16, 3)
    assert found.distance > 0.5
    assert np.isfinite(found.panorama).all()
