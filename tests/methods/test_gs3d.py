"""3DGS: what it refuses, its rules of density control, MCMC in a training, resume, the file it writes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule, small_trainer

from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.settings import DensitySettings
from rtgs.methods import Mode, RenderOptions, create_method
from rtgs.methods.settings import MethodSettings
from rtgs.train.seeds import generator_for

ELLIPSOIDS = small_method("3dgs")
MCMC = replace(ELLIPSOIDS, density=DensitySettings(strategy="mcmc", max_surfels=330, cap_share=1.0))


def make(settings: MethodSettings, **schedule: int):
    scene = small_scene()
    return create_method(settings, scene, small_schedule(**schedule), generator_for(0, "initialise")), scene


def test_it_starts_from_round_ellipsoids_without_rotation():
    settings = replace(ELLIPSOIDS, init=replace(ELLIPSOIDS.init, random_rotation=False, scale=0.5))
    method, _ = make(settings)
    surfels = method.sets[0].gaussians
    assert type(surfels) is Ellipsoids
    assert torch.equal(surfels.log_scales, surfels.log_scales[:, :1].expand(-1, 3))
    assert torch.equal(surfels.quaternions.detach(), torch.tensor([1.0, 0, 0, 0]).expand(len(surfels), 4))
    whole, _ = make(ELLIPSOIDS)
    torch.testing.assert_close(surfels.log_scales.exp(), 0.5 * whole.sets[0].gaussians.log_scales.exp())


@pytest.mark.parametrize("name", ["normal", "mono_normal", "distortion"])
def test_losses_that_need_a_surface_are_refused(name: str):
    with pytest.raises(ValueError, match=rf"method\.loss\.{name}=0\.5, but the ellipsoids of method 3dgs have no sur"):
        make(replace(ELLIPSOIDS, loss=replace(ELLIPSOIDS.loss, **{name: 0.5})))


def test_maps_that_need_a_surface_are_refused():
    method, scene = make(ELLIPSOIDS)
    assert method.maps == ("depth", "normal")
    camera = scene.test[0].camera
    with pytest.raises(ValueError, match="Ellipsoids render no median_depth, distortion: their maps are depth, normal"):
        method.render(camera, 0, Mode.EVALUATE, RenderOptions(normal=True, median_depth=True, distortion=True))
    with torch.no_grad():
        found = [method.render(camera, 0, Mode.EVALUATE, RenderOptions(depth=True, normal=n)) for n in (False, True)]
    assert all(rendered.buffers.depth is not None for rendered in found)
    assert [rendered.buffers.normal is not None for rendered in found] == [False, True]
    trained = method.render(camera, 0, Mode.TRAIN)
    assert trained.buffers.normal is None, "no loss of this method asks for it"
    assert len(trained.buffers.features) == 3


def test_antialiasing_is_a_setting_that_training_and_test_views_obey():
    settings = replace(ELLIPSOIDS, render=replace(ELLIPSOIDS.render, antialiased=True))
    method, scene = make(settings)
    plain, _ = make(ELLIPSOIDS)
    view = scene.train[0]
    for other in (method, plain):
        with torch.no_grad():
            other.sets[0].gaussians.log_scales.sub_(3.0)  # below a pixel: dilation would widen them
    for mode in Mode:
        faint, whole = (other.render(view.camera, 0, mode).buffers.alpha.detach() for other in (method, plain))
        assert 0 < float(faint.sum()) < 0.9 * float(whole.sum())
    method.losses(method.render(view.camera, 0, Mode.TRAIN), view, 0).total.backward()
    assert bool(method.sets[0].gaussians.log_scales.grad.any())


def test_ablations_without_an_object_are_refused():
    with pytest.raises(RtgsError, match="takes nothing away from method 3dgs, which has no surface: it is for 2dgs"):
        compose(["scene=demo", "method=3dgs", "ablation=no_normal_loss"])
    config, _ = compose(["scene=demo", "method=3dgs", "preset=paper", "ablation=mcmc"])
    assert config.method.density.strategy == "mcmc"
    assert config.schedule.densify_until == 25_000


def test_the_published_numbers():
    config, _ = compose(["scene=demo", "method=3dgs", "preset=paper"])
    density, rates = config.method.density, config.method.optimizer
    assert (config.schedule.total, config.schedule.densify_until, config.schedule.opacity_reset_every) == (
        30_000,
        15_000,
        3_000,
    )
    assert (density.gradient_threshold, density.min_opacity, density.split_shrink) == (2e-4, 0.005, 1.6)
    assert (rates.sh_dc, rates.sh_rest, rates.opacity_logits, rates.log_scales, rates.quaternions) == (
        2.5e-3,
        1.25e-4,
        0.05,
        5e-3,
        1e-3,
    )
    assert (config.method.render.dilation, config.method.render.antialiased) == (0.3, False)


def test_too_large_ones_go_after_the_first_reset_only():
    density = replace(ELLIPSOIDS.density, too_large_pruned=True, too_large_after_reset=True, min_opacity=0.005)
    settings = replace(ELLIPSOIDS, density=density)
    for reset_every, pruned in ((10, True), (40, False), (0, False)):
        method, scene = make(
            settings, densify_from=5, densify_until=45, densify_every=20, opacity_reset_every=reset_every
        )
        base = method.sets[0]
        with torch.no_grad():
            base.gaussians.log_scales[3] = 2.0
        for step in range(20):
            view = scene.train[step % 5]
            rendered = method.render(view.camera, step, Mode.TRAIN)
            method.losses(rendered, view, step).total.backward()
            method.after_step(step, rendered.observations)
        largest = float(base.gaussians.log_scales.detach().exp().amax())
        assert (largest < 0.1 * scene.extent) is pruned, reset_every


def test_mcmc_trains_to_its_budget_without_resets_and_says_so():
    trainer = small_trainer(settings=MCMC, schedule=small_schedule(total=61, densify_until=60, opacity_reset_every=30))
    first = trainer.method.losses(
        trainer.method.render(trainer.scene.train[0].camera, 0, Mode.TRAIN), trainer.scene.train[0], 0
    )
    assert [term.name for term in first.terms] == ["l1", "dssim", "opacity", "scale"]
    weighted = sum(term.weight * term.value for term in first.terms)
    assert float(first.total.detach()) == pytest.approx(weighted, rel=1e-5)
    summary = trainer.run()
    assert summary.surfels == 330
    assert {"no opacity resets", "initial Gaussians of opacity 0.5 and 0.1 times the size"} <= {
        decision.what for decision in summary.decisions
    }
    assert float(trainer.method.sets[0].gaussians.opacity_logits.detach().sigmoid().median()) > 0.05


@pytest.mark.parametrize("settings", [ELLIPSOIDS, MCMC], ids=["adaptive", "mcmc"])
def test_resume_is_bit_for_bit(tmp_path, settings: MethodSettings):
    whole = small_trainer(settings=settings, checkpoint_dir=tmp_path / "whole")
    whole.run()
    half = small_trainer(settings=settings, checkpoint_dir=tmp_path / "half")
    half.stage = replace(half.stage, until=30)
    half.run()
    again = small_trainer(settings=settings, checkpoint_dir=tmp_path / "half")
    assert again.run().resumed_from == 30
    expected = whole.method.state()
    for name, tensor in again.method.state().items():
        assert torch.equal(tensor, expected[name]), name


def test_what_is_trained_goes_round_as_a_file(tmp_path):
    method, _ = make(ELLIPSOIDS)
    write_ply(tmp_path / "base.ply", method.sets[0].gaussians)
    back = read_gaussians(tmp_path / "base.ply")
    assert type(back) is Ellipsoids
    for (name, a), (_, b) in zip(method.sets[0].gaussians.items(), back.items()):
        assert torch.equal(a.detach(), b), name
