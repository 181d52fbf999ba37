"""What the rasterisers and their twins ask of their arguments."""

from __future__ import annotations

from torch import Tensor

MAX_CHANNELS = 32


def check_shapes(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    background: Tensor | None,
    screen_probe: Tensor | None,
    scale_axes: int = 2,
) -> None:
    """Raise ValueError, naming the tensor, when a shape does not fit N Gaussians of this many scales and C channels."""
    count = means.shape[0] if means.ndim else 0
    channels = features.shape[1] if features.ndim == 2 else 0
    if not 1 <= channels <= MAX_CHANNELS:
        raise ValueError(f"features must be (N, C) with 1 <= C <= {MAX_CHANNELS}, got {tuple(features.shape)}")
    expected = {
        "means": (means, (count, 3)),
        "tangent_u": (tangent_u, (count, 3)),
        "tangent_v": (tangent_v, (count, 3)),
        "scales": (scales, (count, scale_axes)),
        "opacities": (opacities, (count,)),
        "features": (features, (count, channels)),
        "background": (background, (channels,)),
        "screen_probe": (screen_probe, (count, 2)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape} to fit means and features, got {tuple(tensor.shape)}")
