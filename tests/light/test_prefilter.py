"""What rough surfaces see of a cubemap: energy, the published lobes, the kernel against its twin."""

import threading

import numpy as np
import pytest
import torch

from rtgs.light import prefilter
from rtgs.light.faces import texel_directions
from rtgs.light.prefilter import (
    MOST_KEPT,
    filter_of,
    filtered,
    filtered_twin,
    ggx,
    irradiance,
    level_of,
    level_roughness,
    lobe_cosine,
    prefiltered,
    shrunk,
)

LEVELS = [(16, 0.08), (8, 0.29), (8, 0.5), (4, 1.0), (8, None)]


@pytest.mark.parametrize(("side", "roughness"), LEVELS)
@pytest.mark.usefixtures("isa")
def test_the_kernel_and_its_gradient_are_the_twins(side: int, roughness: float | None):
    texels = torch.randn(6 * side**2, 3, generator=torch.Generator().manual_seed(side))
    found, exact = texels.clone().requires_grad_(), texels.double().requires_grad_()
    upstream = torch.randn(texels.shape, generator=torch.Generator().manual_seed(1))
    mine, twin = filtered(found, side, roughness), filtered_twin(exact, side, roughness)
    mine.backward(upstream)
    twin.backward(upstream.double())
    torch.testing.assert_close(mine.double(), twin, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.grad.double(), exact.grad, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("side", "roughness"), LEVELS)
def test_a_constant_map_stays_constant(side: int, roughness: float | None):
    texels = torch.tensor([0.2, 0.5, 3.0]).expand(6 * side**2, 3).contiguous()
    torch.testing.assert_close(filtered(texels, side, roughness), texels, atol=1e-6, rtol=1e-6)


def test_a_pyramid_of_a_constant_map_is_constant_at_every_level():
    pyramid = prefiltered(torch.full((6, 32, 32, 3), 0.7), (32, 16, 8, 8))
    torch.testing.assert_close(pyramid, torch.full_like(pyramid, 0.7))


def test_irradiance_of_a_linear_light_is_two_thirds_of_it():
    """Of light c . l over the sphere irradiance is (2 pi / 3) c . n; of the positive half it is not linear."""
    c = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    light = torch.from_numpy(texel_directions(16).copy()) @ c
    found = irradiance(light[:, None].expand(-1, 3).reshape(6, 16, 16, 3))
    torch.testing.assert_close(found.reshape(-1, 3)[:, 0], 2 / 3 * light, atol=3e-3, rtol=0)


def test_published_lobes():
    """Half angles of the cones, as computed from the published rule: 1.24, 17.25, 63.5, 89.1 degrees."""
    found = [np.degrees(np.arccos(lobe_cosine(rough))) for rough in (0.08, 0.29, 0.5, 1.0)]
    np.testing.assert_allclose(found, [1.24, 17.25, 63.5, 89.1], atol=0.01)
    cosine = np.linspace(0, 1, 200_001)
    for rough in (0.3, 0.5, 1.0):  # D is normalised: the integral of D (n . h) over the hemisphere is 1
        assert 2 * np.pi * np.trapezoid(ggx(cosine, rough) * cosine, cosine) == pytest.approx(1, abs=1e-4)


def test_levels_and_places_between_them():
    assert level_roughness(4) == pytest.approx((0.08, 0.29, 0.5, 1.0))
    rough = torch.tensor([0.0, 0.08, 0.29, 0.395, 0.5, 0.75, 1.0, 1.2], dtype=torch.float64)
    expected = torch.tensor([0, 0, 1, 1.5, 2, 2.5, 3, 3], dtype=torch.float64)
    torch.testing.assert_close(level_of(rough, 4), expected)
    for levels in (3, 6):
        own = torch.tensor(level_roughness(levels), dtype=torch.float64)
        torch.testing.assert_close(level_of(own, levels), torch.arange(levels, dtype=torch.float64))


def test_rougher_lobes_are_wider():
    """A bright texel is spread over more of the map."""
    texels = torch.zeros(6, 16, 16, 3)
    texels[0, 7, 7] = 1.0
    peaks = [float(filtered(texels.reshape(-1, 3), 16, rough).max()) for rough in (0.08, 0.29, 0.5, 1.0)]
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[0] > 2 * peaks[2]


def test_short_presets_pyramid_has_four_million_weights():
    weights = [8 * len(filter_of(side, rough).weight) for side, rough in zip((64, 32, 16, 16), level_roughness(4))]
    assert weights == [74688, 936144, 643776, 1161072]


def test_shrinking_is_the_mean_and_refuses_other_sides():
    texels = torch.rand(6, 8, 8, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(shrunk(texels, 4)[2, 1, 3], texels[2, 2:4, 6:8].mean((0, 1)))
    assert shrunk(texels, 8) is texels
    with pytest.raises(ValueError, match="a level of side 3 does not divide a cubemap of side 8"):
        shrunk(texels, 3)


def test_filter_bits_do_not_depend_on_the_number_of_threads(isa):
    texels = torch.randn(6 * 16**2, 3, generator=torch.Generator().manual_seed(5))
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(filtered(texels, 16, 0.5))
    assert torch.equal(*found)


def test_only_the_small_working_memory_is_kept(monkeypatch: pytest.MonkeyPatch):
    """That of the short presets' levels is one piece for all of them; that of a side of 512 goes when it is done."""
    monkeypatch.setattr(prefilter, "_KEPT", threading.local())
    assert np.shares_memory(prefilter._work(6 * 64**2), prefilter._work(6 * 64**2))
    for side in (512, 16, 32, 64, 128):
        work = prefilter._work(6 * side**2)
        assert work.shape == (6 * side**2, 32)
        assert np.shares_memory(work, prefilter._KEPT.rows) == (side <= 64)
    assert prefilter._KEPT.rows.nbytes == MOST_KEPT * 32 * 4 < 4e6


@pytest.mark.parametrize("roughness", [None, 0.5])
def test_levels_of_an_odd_side_are_refused(roughness: float | None):
    with pytest.raises(ValueError, match="a level of side 5 cannot be filtered: its side must be even"):
        filtered(torch.ones(6 * 25, 3), 5, roughness)
    with pytest.raises(ValueError, match="side 7"):
        irradiance(torch.ones(6, 7, 7, 3))
