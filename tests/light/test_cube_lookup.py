"""Lookups in a cubemap: the kernel against its twin, gradients against differences, seams."""

import pytest
import torch
from torch import Tensor

from rtgs.light.faces import texel_directions
from rtgs.light.lookup import cube_lookup, cube_lookup_twin, texel_count
from rtgs.native import core

SIDES = (16, 8, 4)
COUNTS = (0, 1, 15, 16, 33, 700)


def drawn(count: int, sides: tuple[int, ...] = SIDES, dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    """Texels, directions of all lengths, places between levels, some beyond the ends."""
    generator = torch.Generator().manual_seed(count)
    texels = torch.randn(texel_count(sides), 3, generator=generator, dtype=dtype)
    directions = torch.randn(count, 3, generator=generator, dtype=dtype)
    directions = directions * (3 * torch.rand(count, 1, generator=generator, dtype=dtype)).exp()
    level = torch.rand(count, generator=generator, dtype=dtype) * (len(sides) + 0.4) - 0.7
    return texels, directions, level


@pytest.mark.parametrize("sides", [(8,), (8, 4), SIDES])
@pytest.mark.parametrize("count", COUNTS)
def test_the_kernel_is_its_twin(isa: str, count: int, sides: tuple[int, ...]):
    texels, directions, level = drawn(count, sides, torch.float32)
    found = [each.clone().requires_grad_() for each in (texels, directions, level)]
    exact = [each.double().requires_grad_() for each in (texels, directions, level)]
    upstream = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    color, expected = cube_lookup(found[0], sides, *found[1:]), cube_lookup_twin(exact[0], sides, *exact[1:])
    assert color.dtype == torch.float32
    torch.testing.assert_close(color.double(), expected, atol=2e-5, rtol=0)
    color.backward(upstream)
    expected.backward(upstream.double())
    for mine, twin in zip(found[: 2 if len(sides) == 1 else 3], exact):
        scale = float(twin.grad.abs().max()) if twin.grad.numel() else 1.0
        torch.testing.assert_close(mine.grad.double(), twin.grad, atol=2e-5 * scale, rtol=1e-4)


def test_the_twins_gradients_are_those_of_differences():
    texels, directions, level = drawn(40)
    directions = torch.nn.functional.normalize(directions, dim=1)
    chosen = torch.arange(0, len(texels), 17)

    def colors(some: Tensor, directions: Tensor, level: Tensor) -> Tensor:
        return cube_lookup(texels.index_copy(0, chosen, some), SIDES, directions, level)

    given = (texels[chosen].requires_grad_(), directions.requires_grad_(), level.requires_grad_())
    assert torch.autograd.gradcheck(colors, given, eps=1e-7, atol=1e-5)


def test_a_lookup_at_a_texel_is_the_texel_and_the_length_does_not_count():
    texels, *_ = drawn(1, (8,))
    directions = torch.from_numpy(texel_directions(8).copy())
    for length in (1e-3, 1.0, 50.0):
        torch.testing.assert_close(cube_lookup(texels, (8,), length * directions), texels)
    along = directions[:50].clone().requires_grad_()
    cube_lookup(texels, (8,), along).sum().backward()
    torch.testing.assert_close((along.grad * along).sum(1), torch.zeros(50, dtype=torch.float64), atol=1e-9, rtol=0)


def test_colours_are_continuous_over_all_edges_and_corners():
    """Along great circles around the cube and through its corners a colour changes no faster than texels differ."""
    generator = torch.Generator().manual_seed(3)
    sides = (8, 4)
    texels = torch.rand(texel_count(sides), 3, generator=generator, dtype=torch.float64)
    angle = torch.linspace(0, 2 * torch.pi, 200_001, dtype=torch.float64)[:, None]
    largest = 0.0
    for _ in range(6):
        one, other = torch.linalg.qr(torch.randn(3, 2, generator=generator, dtype=torch.float64))[0].T
        colors = cube_lookup(texels, sides, angle.cos() * one + angle.sin() * other, torch.full((len(angle),), 0.4))
        largest = max(largest, float((colors[1:] - colors[:-1]).abs().max()))
    corner = torch.ones(3, dtype=torch.float64) / 3**0.5
    other = torch.linalg.cross(corner, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), dim=0)
    colors = cube_lookup(texels, sides, angle.cos() * corner + angle.sin() * other / other.norm(), None)
    largest = max(largest, float((colors[1:] - colors[:-1]).abs().max()))
    step = 2 * torch.pi / 200_000  # of the circle; a face is 8 texels over 2, seen at most twice as steep
    assert largest <= 2 * 4 * 2 * step, f"{largest} in {step} rad: a seam"


def test_a_constant_map_has_one_colour_everywhere():
    texels = torch.full((texel_count(SIDES), 3), 0.37, dtype=torch.float64)
    _, directions, level = drawn(500)
    torch.testing.assert_close(cube_lookup(texels, SIDES, directions, level), torch.full((500, 3), 0.37).double())


@pytest.mark.usefixtures("isa")
def test_directions_without_a_direction_are_harmless_and_what_is_no_number_stays_none():
    texels, directions, level = drawn(40, SIDES, torch.float32)
    directions[3] = 0
    directions[7] = float("nan")
    directions[9] = torch.tensor([float("inf"), 1.0, 0.0])
    level[11] = float("nan")
    directions.requires_grad_()
    colors = cube_lookup(texels, SIDES, directions, level)
    bad = ~colors.isfinite().all(1)
    assert bad[7]
    assert not bad[3]
    assert set(torch.nonzero(bad)[:, 0].tolist()) <= {7, 9, 11}
    colors[torch.tensor([3, 4])].sum().backward()
    assert (directions.grad[3] == 0).all()
    assert directions.grad[4].isfinite().all()


@pytest.mark.parametrize("sides", [(8,), SIDES])
def test_bits_do_not_depend_on_the_number_of_threads(isa, sides: tuple[int, ...]):
    texels, directions, level = drawn(5000, sides, torch.float32)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        given = [each.clone().requires_grad_() for each in (texels, directions, level)]
        color = cube_lookup(given[0], sides, *given[1:])
        color.backward(directions)
        results.append([color.detach(), *(each.grad for each in given[: 2 if len(sides) == 1 else 3])])
    for found in results[1:]:
        assert all(torch.equal(mine, first) for mine, first in zip(found, results[0]))


def test_shapes_that_do_not_fit_are_refused():
    texels, directions, level = drawn(5)
    with pytest.raises(ValueError, match=r"have 2016 texels, got \(2015, 3\)"):
        cube_lookup(texels[1:], SIDES, directions, level)
    with pytest.raises(ValueError, match=r"directions must be \(P, 3\)"):
        cube_lookup(texels, SIDES, directions.T, level)
    with pytest.raises(ValueError, match=r"level must be \(5,\)"):
        cube_lookup(texels, SIDES, directions, level[1:])
    with pytest.raises(ValueError, match="17 levels"):
        core.cube_lookup(
            *(torch.zeros(4).numpy(), torch.ones(17, dtype=torch.int32).numpy()), *[texels.float().numpy()] * 3, 1
        )
