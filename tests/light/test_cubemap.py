"""A cubemap as a directional light."""

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import texel_directions
from rtgs.light.settings import CubemapSettings, EnvironmentSettings

SHORT = CubemapSettings(side=16, mips="ggx", levels=(16, 8, 4, 4))


def texels(settings: CubemapSettings) -> torch.Tensor:
    generator = torch.Generator().manual_seed(settings.side)
    return torch.randn(6, settings.side, settings.side, 3, generator=generator, dtype=torch.float64)


def test_published_pyramids():
    assert CubemapSettings().sides == (128,)
    assert CubemapSettings(mips="ggx").sides == (128, 64, 32, 16)
    assert CubemapSettings(side=64, mips="ggx", levels=(64, 32, 16, 16)).sides == (64, 32, 16, 16)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"side": 1}, "method.environment.side=1"),
        ({"side": 64, "mips": "ggx", "levels": (64, 48, 16)}, "that divide side=64"),
        ({"side": 16, "mips": "ggx"}, "at least three levels"),
        ({"activation": "relu"}, "method.environment.activation"),
        ({"side": 20}, "method.environment.side=20 must be at most 16 or a multiple of it"),
        ({"side": 64, "mips": "ggx", "levels": (16, 32, 64)}, r"levels=\[16, 32, 64\] must be finest first"),
    ],
)
def test_settings_that_make_no_cubemap_are_refused(fields: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        CubemapSettings(**fields)


def test_raw_values_may_be_negative_where_a_sigmoid_follows():
    assert EnvironmentSettings(initial=-1.0).initial == -1
    for fields in ({"initial": -1.0, "activation": "identity"}, {"initial": float("inf")}, {"initial": float("nan")}):
        with pytest.raises(RtgsError, match=r"method\.environment\.initial=.* must be finite"):
            EnvironmentSettings(**fields)
    for name in ("rate_final", "noise", "mono_normal", "rate"):
        with pytest.raises(RtgsError, match=f"method.environment.{name}=-0.1"):
            EnvironmentSettings(**{name: -0.1})


@pytest.mark.parametrize("settings", [CubemapSettings(side=8), SHORT])
@pytest.mark.parametrize("activate", ["before", "after"])
def test_all_gradients_are_those_of_differences(settings: CubemapSettings, activate: str):
    from dataclasses import replace

    settings = replace(settings, activate=activate)
    raw = texels(settings)
    generator = torch.Generator().manual_seed(2)
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=1)
    roughness = torch.linspace(0.07, 0.91, 5, dtype=torch.float64)  # between all levels, on none

    def lit(part: torch.Tensor, directions: torch.Tensor, roughness: torch.Tensor) -> torch.Tensor:
        changed = raw.clone()
        changed[:, 3:5, 2] = part
        light = CubemapLight(changed, settings)
        return torch.cat((light(directions, roughness), light.irradiance(directions)))

    given = (raw[:, 3:5, 2].clone().requires_grad_(), directions.requires_grad_(), roughness.requires_grad_())
    assert torch.autograd.gradcheck(lit, given, eps=1e-7, atol=1e-5)


def test_what_is_averaged_depends_on_when_it_is_activated():
    """Half of a face 0, half -4: light averages to 0.26, raw values to sigmoid(-2) = 0.12."""
    raw = torch.zeros(6, 16, 16, 3)
    raw[:, ::2] = -4.0
    ahead = torch.from_numpy(texel_directions(16)[:9].copy()).float()
    for activate, level in (("before", 0.5 * (0.5 + 0.018)), ("after", 0.1192)):
        light = CubemapLight(raw, CubemapSettings(side=16, mips="ggx", levels=(16, 8, 4, 4), activate=activate))  # type: ignore[arg-type]
        torch.testing.assert_close(light(ahead, torch.ones(9)), torch.full((9, 3), level), atol=1e-3, rtol=0)


def test_a_constant_light_is_constant_at_every_roughness_and_in_irradiance():
    light = CubemapLight(torch.full((6, 16, 16, 3), 0.4), SHORT)
    directions = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    expected = torch.full((300, 3), torch.tensor(0.4).sigmoid().item())
    torch.testing.assert_close(light(directions, torch.linspace(0, 1, 300)), expected)
    torch.testing.assert_close(light.irradiance(directions), expected)


def test_one_level_is_the_same_for_every_roughness_and_texels_of_another_side_are_refused():
    settings = CubemapSettings(side=8)
    light = CubemapLight(texels(settings), settings)
    directions = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.equal(light(directions), light(directions, torch.ones(5, dtype=torch.float64)))
    with pytest.raises(ValueError, match="a cubemap of side 8 is"):
        CubemapLight(torch.zeros(6, 4, 4, 3), settings)
