"""Learning rates x30 on noise: nothing becomes non-finite (the clamps of method.md 14 see to it)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule, small_trainer

from rtgs.gaussians.settings import OptimizerSettings
from rtgs.train.method import Mode


def violent(factor: float) -> OptimizerSettings:
    """Every learning rate times ``factor``."""
    base = OptimizerSettings()
    rates = ("means_initial", "means_final", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quaternions")
    return replace(base, **{name: factor * getattr(base, name) for name in rates})


@pytest.mark.parametrize("name", ["2dgs", "3dgs", "rtgs"])
def test_2000_steps_at_30_times_the_learning_rates_on_noise_stay_finite(name: str):
    settings = replace(small_method(name), optimizer=violent(30))
    scene = small_scene(noise=True, normals=True, points=150)
    schedule = small_schedule(2000, densify_from=100, densify_until=1500, densify_every=100, opacity_reset_every=500)
    trainer = small_trainer(scene, settings, schedule)
    trainer.run()  # the guard stops at any non-finite loss or gradient
    base = trainer.method.sets[0]
    assert len(base) > 0
    for key, tensor in base.gaussians.items():
        assert bool(torch.isfinite(tensor).all()), key
    limits = settings.optimizer
    assert float(base.gaussians.opacity_logits.detach().abs().max()) <= limits.opacity_logit_limit + 1e-5
    scales = base.gaussians.log_scales.detach().exp()
    assert float(scales.max()) <= limits.largest_scale * scene.extent * 1.001
    assert float(scales.min()) >= limits.smallest_scale * scene.extent * 0.999
    for view in (*scene.train, *scene.test):
        with torch.no_grad():
            assert bool(torch.isfinite(trainer.method.render(view.camera, 2000, Mode.TRAIN).image).all())
