"""Hand-made sets of surfels and ellipsoids for the tests."""

from __future__ import annotations

import torch

from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import Surfels


def random_surfels(
    count: int, coefficients: int = 15, seed: int = 0, dtype: torch.dtype = torch.float32, kind=Surfels
) -> Surfels | Ellipsoids:
    """Ordinary Gaussians: standard normal raw parameters, SH rest 0.3."""
    scales = 3 if kind is Ellipsoids else 2
    generator = torch.Generator().manual_seed(seed)

    def rows(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator).to(dtype)

    return kind(rows(3), rows(scales), rows(4), rows(), rows(3), 0.3 * rows(coefficients, 3)).requires_grad_()
