"""Light of a map of features and a network: the kernel against its twin, threads, and what has no direction."""

import pytest
import torch
from torch import Tensor

from rtgs.light.feature_map import box_pyramid
from rtgs.light.feature_network import LAYERS, first_weights, mirrored_light, mirrored_light_twin
from rtgs.native import core

NETWORK = [f"{kind}{name}" for name in LAYERS for kind in ("weight", "bias")]
NAMES = ["pyramid", "directions", "roughness", "surface", *NETWORK]


def drawn(count: int, side: int, width: int, seed: int = 0) -> list[Tensor]:
    """The pyramid, directions of all lengths, roughness with some beyond the ends, surfaces, the network."""
    generator = torch.Generator().manual_seed(seed)
    pyramid = box_pyramid(torch.randn(side, 2 * side, 16, generator=generator))
    directions = torch.randn(count, 3, generator=generator)
    directions = directions * (3 * torch.rand(count, 1, generator=generator)).exp()
    roughness = 1.4 * torch.rand(count, generator=generator) - 0.2
    surface = torch.randn(count, 4, generator=generator)
    weights = first_weights(width, generator)
    return [pyramid, directions, roughness, surface, *(2 * weights[name] for name in NETWORK)]


def light(given: list[Tensor], side: int) -> Tensor:
    pyramid, directions, roughness, surface, *network = given
    return mirrored_light(dict(zip(NETWORK, network)), pyramid, side, directions, roughness, surface)


def leaves(given: list[Tensor], dtype: torch.dtype = torch.float32) -> list[Tensor]:
    return [each.detach().clone().to(dtype).requires_grad_() for each in given]


@pytest.mark.parametrize(("side", "width"), [(4, 1), (8, 8), (64, 32), (16, 40), (16, 256)])
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1500])
def test_the_kernel_is_its_twin(isa: str, count: int, side: int, width: int):
    given = drawn(count, side, width, seed=count)
    single, exact = leaves(given), leaves(given, torch.float64)
    found, expected = light(single, side), light(exact, side)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, atol=1e-6, rtol=1e-5)
    upstream = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    found.backward(upstream)
    expected.backward(upstream.double())
    for name, mine, twin in zip(NAMES, single, exact):
        scale = float(twin.grad.abs().max()) if twin.grad.numel() else 1.0
        # Places are rounded to 1e-7 of the map, and the gradient of a place jumps from texel to texel.
        off = (mine.grad.double() - twin.grad).abs() > 3e-5 * scale
        most = 0.002 if name in ("directions", "roughness") else 0
        assert float(off.double().sum()) <= most * off.numel() + (most > 0), name


def test_the_brightest_light_learns_nothing_more(isa: str):
    given = drawn(70, 8, 16)
    given[-1] = torch.tensor([4.0, 5.5, 60.0])
    given[-2] = torch.zeros(3, 16)
    single = leaves(given)
    found = light(single, 8)
    torch.testing.assert_close(found[0], torch.tensor([4.0, 5.0, 5.0]).exp())
    found.sum().backward()
    assert single[-1].grad[0] == pytest.approx(70 * 2.718281828**4, rel=1e-4)
    assert single[-1].grad[1:].tolist() == [0, 0]


@pytest.mark.usefixtures("isa")
def test_poles_have_no_longitude_and_what_is_no_number_stays_none():
    given = drawn(70, 8, 16)
    given[1][3] = torch.tensor([0.0, 2.0, 0.0])
    given[1][4] = torch.tensor([0.0, -1.0, 0.0])
    given[1][5] = 0
    given[1][6] = float("nan")
    given[1][7] = torch.tensor([float("inf"), 1.0, 0.0])
    given[2][8] = float("nan")
    given[3][9] = float("nan")
    single = leaves(given)
    found = light(single, 8)
    bad = ~found.isfinite().all(1)
    assert set(torch.nonzero(bad)[:, 0].tolist()) - {7} == {6, 8, 9}
    found[:6].sum().backward()
    assert single[1].grad[:6].isfinite().all()
    assert single[1].grad[3:6].tolist() == torch.zeros(3, 3).tolist()


def test_a_surface_without_length_has_torchs_gradient():
    """That of the published zero start: 1e12 times that of a unit one."""
    given = drawn(2, 8, 16)
    given[3][0] = 0
    single = leaves(given)
    light(single, 8).sum().backward()
    twin = leaves(given)
    weights = dict(zip(NETWORK, twin[4:]))
    mirrored_light_twin(weights, twin[0], 8, twin[1], 3 * twin[2], twin[3]).sum().backward()
    assert float(twin[3].grad[0].abs().max()) > 1e8
    torch.testing.assert_close(single[3].grad, twin[3].grad, rtol=1e-3, atol=1e-3)


def test_bits_do_not_depend_on_the_number_of_threads(isa):
    results = []
    given = drawn(5000, 16, 24)
    for threads in (1, 2, 5, 40):
        torch.set_num_threads(threads)
        single = leaves(given)
        found = light(single, 16)
        found.backward(given[1])
        results.append([found.detach(), *(each.grad for each in single)])
    for found in results[1:]:
        assert all(torch.equal(mine, first) for mine, first in zip(found, results[0]))


@pytest.mark.parametrize("which", range(4))
def test_shapes_that_do_not_fit_are_refused(which: int):
    given = drawn(5, 8, 16)
    given[which] = given[which][1:]
    with pytest.raises(ValueError, match=r"light of features: expected \("):
        light(given, 8)


def test_the_core_refuses_arrays_that_do_not_fit():
    floats, sides = torch.zeros(4).numpy(), torch.tensor([4, 2], dtype=torch.int32).numpy()
    with pytest.raises(ValueError, match="texels holds 4 numbers, expected 640"):
        core.feature_light(floats, sides, (floats,) * 9, *[floats] * 7, 1)
    texels = torch.zeros(640).numpy()
    with pytest.raises(ValueError, match="a width of 4, not a multiple of 16"):
        core.feature_light(texels, sides, (floats,) * 9, *[floats] * 7, 1)
    with pytest.raises(ValueError, match="1 levels; 2 to 16 are possible"):
        core.feature_light(texels, sides[:1], (floats,) * 9, *[floats] * 7, 1)
