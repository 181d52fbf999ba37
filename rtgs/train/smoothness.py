"""Maps that change only where the photo does (Ref-Gaussian's loss on normals)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def edge_aware_smoothness(values: Tensor, image: Tensor) -> Tensor:
    """Mean over channels and pixels of |Sobel v| exp(-|Sobel I|), summed over both axes; scalar.

    ``values``, ``image`` (C, H, W), the same shape, any dtype: each channel by its own edges. Sobel's filter divided by
    8, over borders that are repeated. Differentiable in ``values``; the image is a constant.

    Raises:
        ValueError: the shapes differ.
    """
    if values.shape != image.shape:
        raise ValueError(f"smoothness needs maps of one shape, got {tuple(values.shape)} and {tuple(image.shape)}")
    edges = sobel(image.detach())
    return sum(
        ((change.abs() * (-edge.abs()).exp()).mean() for change, edge in zip(sobel(values), edges)),
        torch.zeros((), dtype=values.dtype),
    )


def sobel(values: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (C, H, W) across and down."""
    wide = pad(values[None], (1, 1, 1, 1), mode="replicate")[0]
    across = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    down = wide[..., :-2] + 2 * wide[..., 1:-1] + wide[..., 2:]
    return (across[..., 2:] - across[..., :-2]) / 8, (down[:, 2:] - down[:, :-2]) / 8
