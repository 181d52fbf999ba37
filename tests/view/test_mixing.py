"""Layers and their weights: what the page makes of the maps of a view."""

from __future__ import annotations

import pytest
import torch

from rtgs.evaluate.images import to_bytes
from rtgs.optics.light import decoded_twin, encoded_twin
from rtgs.view.mixing import Choice, lights_of, mixed, pixels_of
from tests.train.training_cases import look_at_origin

SHAPE = (30, 40)


def maps(blend: str) -> dict[str, torch.Tensor]:
    """A view of a mirror: half of the pixels are traced, and the image is what the layers say."""
    generator = torch.Generator().manual_seed(1)
    diffuse, reflected, passed = (torch.rand(3, *SHAPE, generator=generator) for _ in range(3))
    specular = torch.rand(SHAPE, generator=generator)
    traced = torch.rand(SHAPE, generator=generator) > 0.5
    into = decoded_twin if blend == "linear" else lambda color: color
    back = encoded_twin if blend == "linear" else lambda light: light
    layers = {"reflection": 0.4 * specular * into(reflected), "transmission": 0.6 * specular * into(passed)}
    image = back((1 - specular) * into(diffuse) + sum(layers.values()))
    shown = {name: back(light * traced) for name, light in layers.items()}
    weights = {f"{name}_weight": 0.5 * specular * traced for name in layers}
    image = torch.where(traced, image, diffuse)
    return {"image": image, "diffuse": diffuse, "specular": specular, "traced": traced.float(), **shown, **weights}


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_the_image_with_all_layers_is_the_image_bit_for_bit(blend: str):
    found = maps(blend)
    assert mixed(found, {"reflection": 1.0, "diffuse": 1.0}, blend) is found["image"]
    assert (pixels_of(Choice(), found, look_at_origin(0.1), blend) == to_bytes(found["image"])).all()


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_without_any_layer_nothing_is_left(blend: str):
    found = maps(blend)
    assert lights_of(found) == ("diffuse", "reflection", "transmission")
    nothing = mixed(found, dict.fromkeys(lights_of(found), 0.0), blend)
    assert float(nothing.abs().max()) < 2e-3  # of encoded light: 1e-4 of light


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_a_layer_alone_is_its_map(blend: str):
    found = maps(blend)
    alone = mixed(found, {"diffuse": 0.0, "transmission": 0.0}, blend)
    torch.testing.assert_close(alone, found["reflection"], atol=2e-3, rtol=0)


def test_a_weight_changes_traced_pixels_alone():
    found = maps("srgb")
    twice = mixed(found, {"reflection": 2.0}, "srgb")
    torch.testing.assert_close(twice, found["image"] + found["reflection"])
    assert (twice == found["image"])[:, found["traced"] == 0].all()


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_of_a_method_that_adds_its_reflection_the_diffuse_layer_is_the_whole_base(blend: str):
    base, reflected, specular = 0.5 * torch.rand(3, *SHAPE), 0.5 * torch.rand(3, *SHAPE), torch.rand(SHAPE)
    into = decoded_twin if blend == "linear" else lambda color: color
    back = encoded_twin if blend == "linear" else lambda light: light
    image = back(into(base) + into(reflected))
    found = {"image": image, "base": base, "diffuse": base.clone(), "reflection": reflected, "specular": specular}
    assert lights_of(found) == ("diffuse", "reflection")
    torch.testing.assert_close(mixed(found, {"diffuse": 0.0}, blend), reflected, atol=2e-3, rtol=0)
    torch.testing.assert_close(mixed(found, {"reflection": 0.0}, blend), base, atol=2e-3, rtol=0)


def test_a_view_of_one_set_has_no_layers_and_shows_its_image():
    found = {"image": torch.rand(3, *SHAPE)}
    assert lights_of(found) == ()
    camera = look_at_origin(0.1)
    assert (
        pixels_of(Choice("weights", (("reflection", 0.0),)), found, camera, "srgb") == to_bytes(found["image"])
    ).all()
