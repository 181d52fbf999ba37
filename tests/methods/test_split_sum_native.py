"""Split-sum shading: native kernels against plain torch in float64, every instruction set and number of threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods.shading.mirror_light import indirect_light, indirect_light_twin
from rtgs.methods.shading.split_sum import mean_normal, mirrored, mirrored_means
from rtgs.optics.split_sum import WIDEST, split_sum_weight, split_sum_weight_twin

COUNTS = (0, 1, 15, 16, 33, 500)


def both(native: Callable, twin: Callable, given: Sequence[Tensor]) -> list[list[Tensor]]:
    """Outputs and gradients of the native call on these leaves, and of the twin on the same in float64."""
    found = []
    for function, dtype in ((native, torch.float32), (twin, torch.float64)):
        leaves = [each.to(dtype).requires_grad_() for each in given]
        outputs = function(*leaves)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        drawn = [torch.randn(each.shape, generator=torch.Generator().manual_seed(3)).to(dtype) for each in outputs]
        gradients = torch.autograd.grad(outputs, leaves, drawn, materialize_grads=True)
        found.append([each.detach() for each in (*outputs, *gradients)])
    return found


def agree(pair: list[list[Tensor]], tolerance: float = 5e-6) -> bool:
    """Each within ``tolerance``, of its largest number where that is above 1."""
    scales = [float(exact.abs().max()) if exact.numel() else 1.0 for exact in pair[1]]
    errors = [float((each - exact).abs().max()) if exact.numel() else 0.0 for each, exact in zip(*pair, strict=True)]
    return all(error <= tolerance * max(scale, 1.0) for error, scale in zip(errors, scales, strict=True))


def drawn_lobes(count: int, colors: int = 3) -> list[Tensor]:
    """Lobes, cosines and roughness also beyond both ends of the table."""
    generator = torch.Generator().manual_seed(count)
    cosine = 1.4 * torch.rand(count, generator=generator) - 0.2
    roughness = 1.5 * torch.rand(count, generator=generator) - 0.1
    return [cosine, roughness, torch.rand(colors, count, generator=generator)]


@pytest.mark.parametrize("count", COUNTS)
def test_the_weight_of_a_lobe_is_that_of_the_twin(isa: str, count: int):
    assert agree(both(split_sum_weight, split_sum_weight_twin, drawn_lobes(count)))


def test_lobes_may_have_any_number_of_colours(isa: str):
    assert agree(both(split_sum_weight, split_sum_weight_twin, drawn_lobes(40, colors=1)))


def test_what_lies_beyond_the_table_learns_nothing_and_what_is_no_number_stays_none(isa: str):
    cosine = torch.tensor([-0.1, 1.1, 0.5, 0.5, float("nan"), 0.5], requires_grad=True)
    roughness = torch.tensor([0.5, 0.5, -0.5, 1.01 * WIDEST**0.5, 0.5, float("nan")], requires_grad=True)
    weight = split_sum_weight(cosine, roughness, torch.full((3, 6), 0.5))
    weight.sum().backward()
    assert torch.isnan(weight.detach()).all(0).tolist() == [False] * 4 + [True] * 2
    assert cosine.grad is not None
    assert roughness.grad is not None
    assert cosine.grad[:2].tolist() == [0, 0]
    assert roughness.grad[2:4].tolist() == [0, 0]


def drawn_pixels(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Composited normals that agree more or less, some of almost no coverage; the camera rays."""
    generator = torch.Generator().manual_seed(count)
    alpha = 0.2 + 0.8 * torch.rand(count, generator=generator)
    normal = torch.nn.functional.normalize(torch.randn(3, count, generator=generator), dim=0)
    normal = normal * alpha * (0.8 + 0.2 * torch.rand(count, generator=generator))
    normal[:, ::7] *= 1e-9
    alpha[::7] *= 1e-9
    return normal, alpha, torch.randn(3, count, generator=generator)


def _rows(values: Tensor, count: int) -> Tensor:
    """(P, ...) of (P, 3), (3, P) or (P,)."""
    return values if len(values) == count else values.T


@pytest.mark.parametrize("form", ["mean", "unit"])
@pytest.mark.parametrize("count", COUNTS)
def test_mirror_directions_of_mean_normals_are_those_of_the_twin(isa: str, count: int, form: str):
    normal, alpha, view = drawn_pixels(count)

    def twin(normal: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        return mirrored(mean_normal(normal, alpha, form), view.to(normal.dtype))

    pair = both(lambda normal, alpha: mirrored_means(normal, alpha, view, form), twin, (normal, alpha))
    covered = alpha > 1e-3  # the gradients of the others are a million times larger: each with its own kind
    for chosen in (covered, ~covered):
        assert agree([[_rows(each, count)[chosen] for each in half] for half in pair])


def test_twins_by_finite_differences():
    normal, alpha, view = (each.double() for each in drawn_pixels(33))
    normal, alpha, view = normal[:, 1:7], alpha[1:7], view[:, 1:7]
    for form in ("mean", "unit"):
        given = (normal.clone().requires_grad_(), alpha.clone().requires_grad_())
        assert torch.autograd.gradcheck(lambda n, a, form=form: mirrored_means(n, a, view, form), given)
    rows = [each[1:5].double().requires_grad_() for each in drawn_rows(33)]
    assert torch.autograd.gradcheck(light_of(indirect_light), rows)


def drawn_rows(count: int) -> list[Tensor]:
    """Means, tangents, and coefficients of surfels; every fifth has none, as at the start."""
    generator = torch.Generator().manual_seed(count)
    frames = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))[0]
    means, dc = (torch.randn(count, 3, generator=generator) for _ in range(2))
    rest = 0.3 * torch.randn(count, 45, generator=generator)
    dc[::5], rest[::5] = 0, 0
    return [means, frames[:, 0].contiguous(), frames[:, 1].contiguous(), dc, rest]


def light_of(function: Callable) -> Callable:
    center = torch.tensor([0.3, -2.0, 1.0])

    def call(means: Tensor, tangent_u: Tensor, tangent_v: Tensor, dc: Tensor, rest: Tensor) -> Tensor:
        rows = ActivatedGaussians(means, tangent_u, tangent_v, means[:, :2], means[:, 0], means)
        return function(rows, center.to(means.dtype), dc, rest)

    return call


@pytest.mark.parametrize("count", COUNTS)
def test_indirect_light_is_that_of_the_twin(isa: str, count: int):
    """Also of coefficients that are 0, which must be able to begin."""
    pair = both(light_of(indirect_light), light_of(indirect_light_twin), drawn_rows(count))
    assert agree(pair, 2e-5)
    if count:
        assert float(pair[0][4][0].abs().min()) > 0


def test_a_surfel_at_the_camera_has_no_direction_and_finite_gradients(isa: str):
    rows = drawn_rows(16)
    rows[0][3] = torch.tensor([0.3, -2.0, 1.0])
    rows = [each.requires_grad_() for each in rows]
    light_of(indirect_light)(*rows).sum().backward()
    assert all(each.grad is not None and bool(torch.isfinite(each.grad).all()) for each in rows)


def test_the_bits_do_not_depend_on_the_number_of_threads(isa: str):
    normal, alpha, view = drawn_pixels(500)
    calls = (
        (split_sum_weight, drawn_lobes(500)),
        (lambda n, a: mirrored_means(n, a, view, "mean"), [normal, alpha]),
        (light_of(indirect_light), drawn_rows(500)),
    )
    before = torch.get_num_threads()
    try:
        for function, given in calls:
            found = []
            for threads in (1, 3):
                torch.set_num_threads(threads)
                found.append(both(function, function, given)[0])
            assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
    finally:
        torch.set_num_threads(before)
