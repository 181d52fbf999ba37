"""Settings out of range are refused where they are set, with their key; the defaults of every one are in range."""

from __future__ import annotations

import dataclasses
import math

import pytest

from rtgs.config.schema import MeshConfig, RunConfig
from rtgs.core.errors import RtgsError
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.gaussians.settings import DensitySettings, InitSettings, McmcSettings, OptimizerSettings
from rtgs.methods.photo_settings import AppearanceSettings, PoseSettings
from rtgs.methods.settings import ReflectionSettings, TransmittanceSettings
from rtgs.prepare.masks.settings import DrawnSettings
from rtgs.prepare.settings import FeatureSettings, MappingSettings, MatchingSettings, SfmSettings, VideoSettings
from rtgs.render.settings import RenderSettings

NONSENSE = [
    (DensitySettings, "max_surfels", -1),
    (DensitySettings, "max_surfels", 0),
    (DensitySettings, "max_surfels", 2**31),
    (DensitySettings, "split_count", 0),
    (DensitySettings, "too_large_split_count", -1),
    (DensitySettings, "split_shrink", 0.0),
    (DensitySettings, "too_large_shrink", -1.0),
    (DensitySettings, "gradient_threshold", -1e-4),
    (DensitySettings, "gradient_threshold", math.nan),
    (DensitySettings, "min_opacity", 2.0),
    (DensitySettings, "cap_share", -0.1),
    (DensitySettings, "cap_turnover", -0.1),
    (DensitySettings, "reset_opacity", 0.0),
    (DensitySettings, "low_weight_share", 1.5),
    (DensitySettings, "size_border", -1.0),
    (InitSettings, "opacity", 0.0),
    (InitSettings, "opacity", 1.1),
    (InitSettings, "scale", 0.0),
    (InitSettings, "sh_degree", 4),
    (InitSettings, "sh_degree", -1),
    (InitSettings, "min_points", -1),
    (InitSettings, "random_points", 2**40),
    (McmcSettings, "init_opacity", 2.0),
    (McmcSettings, "init_scale", 0.0),
    (OptimizerSettings, "beta1", 1.0),
    (OptimizerSettings, "largest_scale", 0.0),
    (RenderSettings, "near", 0.0),
    (RenderSettings, "far", 0.01),
    (RenderSettings, "depth_ratio", 1.5),
    (RenderSettings, "background", (0.0, 2.0, 0.0)),
    (ReflectionSettings, "smallest_alpha", 2.0),
    (AppearanceSettings, "rate", 0.0),
    (AppearanceSettings, "mean_exposure", -1.0),
    (AppearanceSettings, "warm_up", -1),
    (PoseSettings, "rate_end", 0.0),
    (PoseSettings, "decay", math.inf),
    (EvaluationSettings, "refine_steps", 0),
    (TransmittanceSettings, "base_too_large", -0.1),
    (TransmittanceSettings, "rim", -1),
    (TransmittanceSettings, "keep_seen", -1),
    (TransmittanceSettings, "sh_degree", 9),
    (TransmittanceSettings, "max_gain", math.inf),
    (TransmittanceSettings, "opaque_share", 1.5),
    (FeatureSettings, "peak_threshold", -1.0),
    (MatchingSettings, "min_inliers", -1),
    (MatchingSettings, "ransac_error", 0.0),
    (MappingSettings, "focal_factor", 0.0),
    (MappingSettings, "init_min_angle", 200.0),
    (MappingSettings, "enough", 2.0),
    (SfmSettings, "jpeg_quality", 0),
    (SfmSettings, "min_registered", 1.5),
    (VideoSettings, "jpeg_quality", 101),
    (VideoSettings, "max_side", 0),
    (VideoSettings, "candidates_per_second", 0.0),
    (DrawnSettings, "click_radius", -1.0),
    (MeshConfig, "depth_ratio", math.nan),
    (RunConfig, "threads", 0),
    (RunConfig, "threads", 100_000),
    (RunConfig, "seed", -1),
]


@pytest.mark.parametrize(("cls", "name", "value"), NONSENSE)
def test_values_out_of_range_are_refused(cls, name, value):
    with pytest.raises(RtgsError) as error:
        cls(**{name: value})
    text = str(error.value)
    assert f"{name}={value}" in text
    assert " must be " in text


@pytest.mark.parametrize("cls", dict.fromkeys(cls for cls, _, _ in NONSENSE))
def test_the_defaults_are_in_range(cls):
    assert dataclasses.replace(cls()) == cls()


def test_an_infinite_threshold_turns_densification_off():
    assert DensitySettings(gradient_threshold=math.inf).gradient_threshold == math.inf
