"""Filters of the base set in a training: what they show, resume, and the file that is written."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule, small_trainer

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import canonical_json
from rtgs.gaussians.activate import activate_gaussians
from rtgs.methods import Mode, RenderOptions, create_method
from rtgs.methods.settings import MethodSettings
from rtgs.render.settings import RenderSettings
from rtgs.train.seeds import generator_for


def filtered(name: str, **changes) -> MethodSettings:
    settings = small_method(name)
    return replace(settings, render=replace(settings.render, **changes))


def make(settings: MethodSettings):
    scene = small_scene()
    return create_method(settings, scene, small_schedule(), generator_for(0, "initialise")), scene


@pytest.mark.parametrize("name", ["2dgs", "3dgs"])
def test_smoothing_bounds_every_scale_and_learns_through_it(name: str):
    method, scene = make(filtered(name, smoothing=0.2))
    base, view = method.sets[0], scene.train[0]
    method.losses(method.render(view.camera, 0, Mode.TRAIN), view, 0).total.backward()
    assert bool(base.gaussians.log_scales.grad.any())
    with torch.no_grad():
        base.gaussians.log_scales.sub_(5.0)  # far below a pixel
    shown = base.activated(view.camera.center.float(), 0)
    assert base.smoothing is not None
    least = 0.2**0.5 * base.smoothing.intervals[:, None]
    assert bool((least > 0).all())
    assert bool((shown.scales >= least).all())
    assert bool((shown.scales < 1.1 * least).all())


def test_convolved_surfels_are_a_setting_that_training_and_test_views_obey():
    method, scene = make(filtered("2dgs", surfel_filter="convolved", low_pass=0.3))
    plain, _ = make(small_method("2dgs"))
    view = scene.train[0]
    for other in (method, plain):
        with torch.no_grad():
            other.sets[0].gaussians.log_scales.sub_(3.0)
    for mode in Mode:
        faint, whole = (other.render(view.camera, 0, mode).buffers.alpha.detach() for other in (method, plain))
        assert 0 < float(faint.sum()) < 0.9 * float(whole.sum())
    maps = RenderOptions(depth=True, median_depth=True, normal=True, distortion=True)
    with torch.no_grad():
        buffers = method.render(view.camera, 0, Mode.EVALUATE, maps).buffers
    for name in ("depth", "median_depth", "normal", "distortion"):
        assert getattr(buffers, name) is not None, name
    method.losses(method.render(view.camera, 0, Mode.TRAIN), view, 0).total.backward()
    assert bool(method.sets[0].gaussians.log_scales.grad.any())


@pytest.mark.parametrize("name", ["2dgs", "3dgs"])
def test_resume_is_bit_for_bit(tmp_path, name: str):
    changes = {"surfel_filter": "convolved", "low_pass": 0.1} if name == "2dgs" else {"antialiased": True}
    settings = filtered(name, smoothing=0.2, **changes)
    whole = small_trainer(settings=settings, checkpoint_dir=tmp_path / "whole")
    whole.run()
    half = small_trainer(settings=settings, checkpoint_dir=tmp_path / "half")
    half.stage = replace(half.stage, until=33)  # between two calls of density control
    half.run()
    again = small_trainer(settings=settings, checkpoint_dir=tmp_path / "half")
    assert again.run().resumed_from == 33
    expected = whole.method.state()
    assert "base.smoothing.intervals" in expected
    for tensor_name, tensor in again.method.state().items():
        assert torch.equal(tensor, expected[tensor_name]), tensor_name


def test_what_viewers_get_needs_no_filter():
    method, scene = make(filtered("2dgs", smoothing=0.2))
    base, center = method.sets[0], scene.train[0].camera.center.float()
    filtered_rows, fused = base.activated(center, 3), activate_gaussians(base.shown(), center, 3)
    torch.testing.assert_close(fused.scales, filtered_rows.scales)
    torch.testing.assert_close(fused.opacities, filtered_rows.opacities)
    plain, _ = make(small_method("2dgs"))
    assert plain.sets[0].shown() is plain.sets[0].gaussians


def test_without_filters_recipe_and_checkpoint_are_what_they_were():
    text = canonical_json(RenderSettings())
    assert not [key for key in ("smoothing", "low_pass", "surfel_filter") if key in text]
    assert "smoothing" in canonical_json(RenderSettings(smoothing=0.2))
    method, _ = make(small_method("2dgs"))
    assert not [name for name in method.state() if "smoothing" in name]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"low_pass": 0.0}, r"method\.render\.low_pass=0\.0 must be above 0"),
        ({"smoothing": -0.2}, r"method\.render\.smoothing=-0\.2"),
        ({"surfel_filter": "mip"}, r"method\.render\.surfel_filter='mip' is unknown: choose one of floor, convolved"),
    ],
)
def test_bad_values_are_refused(wrong: dict, message: str):
    with pytest.raises(RtgsError, match=message):
        RenderSettings(**wrong)
