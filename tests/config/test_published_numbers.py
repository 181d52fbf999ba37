"""``preset=paper`` has the numbers of EnvGS (method.md 6.1) for both sets, in both methods that trace reflections."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from rtgs.config import compose
from rtgs.core.recipe import flatten

RATES = {
    "means_initial": 1.6e-4,
    "means_final": 1.6e-6,
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
    "opacity_logits": 0.05,
    "log_scales": 5e-3,
    "quaternions": 1e-3,
    "specular_logits": 0.01,
    "eps": 1e-15,
}
DENSITY = {  # of both sets
    "size_border": 0.01,
    "split_count": 2,
    "split_shrink": 1.6,
    "min_opacity": 0.05,
    "too_large": 0.1,
    "too_large_split_count": 5,
    "too_large_shrink": 2.5,
    "low_weight_share": 0.1,
    "reset_opacity": 0.01,
    "cap_share": 0.9,
    "cap_turnover": None,
    "max_per_pixel": None,
}
PROPAGATION = {
    "every": 1000,
    "opacity": 0.9,
    "grow": 1.5,
    "grow_border": 0.02,
    "hold_every": 200,
    "sabotage": 0.4,
    "sabotage_border": 0.05,
    "densify_every": 500,
}
PUBLISHED = {
    **{f"method.optimizer.{name}": value for name, value in RATES.items()},
    **{f"method.density.{name}": value for name, value in DENSITY.items()},
    **{f"method.reflection.density.{name}": value for name, value in DENSITY.items()},
    **{f"method.reflection.propagation.{name}": value for name, value in PROPAGATION.items()},
    "method.density.gradient_threshold": 2e-4,
    "method.density.max_surfels": 2_000_000,
    "method.reflection.density.gradient_threshold": 1e-4,
    "method.reflection.density.max_surfels": 700_000,
    "method.init.opacity": 0.1,
    "method.materials.specular": 1e-3,
    "method.reflection.init.opacity": 0.1,
    "method.reflection.init.scale": 1.0,
    "method.reflection.cells": 32,
    "method.reflection.per_cell": 5,
    "method.reflection.init_color": "random",
    "method.reflection.background": "black",
    "method.reflection.densify_every": 500,
    "method.reflection.opacity_reset_every": 6000,
    "method.reflection.specular_reset": True,
    "method.reflection.sh_every": 1000,
    "method.reflection.rate_gain": 1.0,
    "method.reflection.transmittance_cutoff": 1e-4,
    "method.reflection.alpha_cutoff": 1 / 255,
    "method.reflection.traced.threshold": 0.0,
    "method.reflection.traced.shared_below": 0.0,
    "method.loss.l1": 0.8,
    "method.loss.dssim": 0.2,
    "method.loss.normal": 0.04,
    "method.loss.normal_start": 0.0,
    "method.loss.normal_inverse_depth": True,
    "method.loss.mono_normal": 0.01,
    "method.loss.mono_normal_gain": 1.0,
    "method.loss.mono_normal_start": 0.0,
    "method.loss.perceptual": 0.01,
    "method.loss.distortion": 0.0,
    "schedule.densify_from": 500,
    "schedule.densify_every": 100,
    "schedule.opacity_reset_every": 3000,
    "schedule.means_lr_steps": 30_000,
}


@pytest.mark.parametrize("method", ["envgs", "rtgs"])
def test_preset_paper_has_the_numbers_of_envgs(method: str):
    config, _ = compose(["scene=demo", f"method={method}", "preset=paper"])
    found = flatten(asdict(config))
    assert {key: found[key] for key in PUBLISHED} == PUBLISHED
