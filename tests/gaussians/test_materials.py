"""Materials of surfels: activations, their place among the parameters, PLY."""

from __future__ import annotations

import pytest
import torch
from surfel_cases import random_surfels

from rtgs.gaussians.density import concatenate, select_rows, split_surfels
from rtgs.gaussians.materials import (
    MATERIAL_NAMES,
    MaterialSurfels,
    activate_materials,
    activate_roughness,
    raw_roughness,
    with_materials,
    without_materials,
)
from rtgs.gaussians.ply import read_ply, write_ply
from rtgs.gaussians.settings import DensitySettings, MaterialSettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.parts.gaussian_set import GaussianSet


@pytest.mark.parametrize("channels", [1, 3])
def test_they_start_at_the_settings_values(channels: int):
    settings = MaterialSettings(specular=0.2, roughness=0.03, f0=0.6, f0_channels=channels)
    surfels = with_materials(random_surfels(7), settings)
    found = activate_materials(surfels, settings)
    torch.testing.assert_close(found.specular, torch.full((7,), 0.2))
    torch.testing.assert_close(found.roughness, torch.full((7,), 0.03))
    torch.testing.assert_close(found.f0, torch.full((7, channels), 0.6))
    assert MATERIAL_NAMES == ("specular_logits", "roughness_logits", "f0_logits")
    plain = without_materials(surfels)
    assert type(plain) is Surfels
    assert plain.means is surfels.means


@pytest.mark.parametrize("curve", ["log", "linear"])
def test_roughness_stays_between_its_floor_and_one_with_a_gradient(curve: str):
    settings = MaterialSettings(roughness_curve=curve)
    raw = torch.linspace(-13.8, 13.8, 101, dtype=torch.float64, requires_grad=True)
    roughness = activate_roughness(raw, settings)
    assert float(roughness.min()) >= 1e-3
    assert float(roughness.max()) <= 1
    assert bool((roughness.diff() > 0).all())
    roughness.sum().backward()
    assert raw.grad is not None
    assert bool((raw.grad > 0).all())
    assert float(activate_roughness(torch.tensor(raw_roughness(0.2, settings)), settings)) == pytest.approx(0.2)


def test_density_control_inherits_them():
    settings = MaterialSettings()
    surfels = with_materials(random_surfels(5), settings)
    with torch.no_grad():
        surfels.specular_logits.copy_(torch.arange(5.0))
    children = split_surfels(surfels, 2, 1.6, torch.Generator().manual_seed(0))
    assert isinstance(children, MaterialSurfels)
    assert children.specular_logits.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    both = concatenate((select_rows(surfels, torch.tensor([4])), children))
    assert both.specular_logits.tolist()[0] == 4


def test_a_set_adopts_and_drops_them_and_adam_keeps_its_moments():
    surfels = random_surfels(6).requires_grad_()
    part = GaussianSet(
        "base", surfels, optimizer=OptimizerSettings(), density=DensitySettings(), means_lr_steps=10, extent=1.0
    )
    surfels.means.sum().backward()
    part.step(0, 0)
    moments = part.optimizer.first.means.clone()
    part.adopt(with_materials(part.gaussians, MaterialSettings()))  # type: ignore[arg-type]
    assert part.optimizer.steps == 1
    assert torch.equal(part.optimizer.first.means, moments)
    assert float(part.optimizer.first.specular_logits.abs().sum()) == 0  # type: ignore[attr-defined]
    part.gaussians.specular_logits.sum().backward()  # type: ignore[attr-defined]
    part.step(1, 0)
    assert float(part.gaussians.specular_logits.detach().max()) < -6.9  # type: ignore[attr-defined]
    part.adopt(without_materials(part.gaussians))  # type: ignore[arg-type]
    assert part.optimizer.steps == 2
    with pytest.raises(ValueError, match="set 'base' has 6 rows, 3 were given"):
        part.adopt(random_surfels(3))


@pytest.mark.parametrize("third_scale", [True, False])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_file_gives_back_the_same_bits(tmp_path, third_scale: bool, channels: int):
    surfels = with_materials(random_surfels(9), MaterialSettings(f0_channels=channels))
    with torch.no_grad():
        surfels.roughness_logits += torch.randn(9, generator=torch.Generator().manual_seed(2))
    write_ply(tmp_path / "base.ply", surfels, third_scale)
    back = read_ply(tmp_path / "base.ply")
    assert isinstance(back, MaterialSurfels)
    for name, tensor in surfels.items():
        assert torch.equal(getattr(back, name), tensor.detach()), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"specular": 0.0}, "method.materials.specular=0.0 must be between 0 and 1"),
        ({"roughness": 1e-4}, "method.materials.roughness=0.0001 must be between 0.001 and 1"),
        ({"f0_channels": 2}, "method.materials.f0_channels=2 is unknown: choose one of 1, 3"),
        (
            {"roughness_curve": "cubic"},
            "method.materials.roughness_curve='cubic' is unknown: choose one of log, linear",
        ),
    ],
)
def test_settings_that_mean_nothing_are_refused_by_their_key(change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        MaterialSettings(**change)
