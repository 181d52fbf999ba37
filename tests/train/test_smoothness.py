"""Edge-aware smoothness against convolutions written out, by finite differences, and what it means."""

from __future__ import annotations

import pytest
import torch

from rtgs.train.smoothness import edge_aware_smoothness, sobel

KERNEL = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]], dtype=torch.float64) / 8


def pictures(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.rand(3, 7, 9, generator=generator, dtype=torch.float64) for _ in range(2))  # type: ignore[return-value]


def test_derivatives_are_sobels():
    values, _ = pictures()
    wide = torch.nn.functional.pad(values[:, None], (1, 1, 1, 1), mode="replicate")
    for found, kernel in zip(sobel(values), (KERNEL, KERNEL.T), strict=True):
        torch.testing.assert_close(found, torch.nn.functional.conv2d(wide, kernel[None, None])[:, 0])
    slope = torch.arange(9.0).expand(3, 7, 9)
    across, down = sobel(slope)
    assert float(across[:, :, 1:-1].min()) == float(across[:, :, 1:-1].max()) == 1.0
    assert float(down.abs().max()) == 0.0


def test_gradient_by_finite_differences():
    values, image = pictures()
    assert torch.autograd.gradcheck(edge_aware_smoothness, (values.requires_grad_(), image))


def test_edges_of_the_photo_excuse_edges_of_the_map():
    values = torch.zeros(3, 8, 8)
    values[:, :, 4:] = 1.0
    flat, same = edge_aware_smoothness(values, torch.zeros(3, 8, 8)), edge_aware_smoothness(values, 8 * values)
    assert float(flat) == pytest.approx(0.125)
    assert float(same) < 0.02 * float(flat)
    assert float(edge_aware_smoothness(torch.ones(3, 8, 8), torch.zeros(3, 8, 8))) == 0.0
    with pytest.raises(ValueError, match="one shape"):
        edge_aware_smoothness(values, values[:1])
