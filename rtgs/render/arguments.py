"""What the rasterisers, the tracer and their twins ask of their arguments."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.channels import MAX_CHANNELS
from rtgs.gaussians.harmonics import MAX_DEGREE, rest_count
from rtgs.render.buffers import TraceOptions

MAX_SIDE = 1 << 18  # pixels: the kernels' tile numbers are 16-bit


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


def check_trace_shapes(
    surfels: dict[str, Tensor],
    origins: Tensor,
    directions: Tensor,
    features: Tensor | None,
    sh_dc: Tensor | None,
    sh_rest: Tensor | None,
    probe: Tensor | None,
    options: TraceOptions,
) -> None:
    """Raise ValueError, naming the argument, when a shape or an option does not fit N surfels and R rays.

    ``surfels``: means, tangent_u, tangent_v, scales, opacities by name.
    """
    check_tree_shapes(surfels, options.alpha_cutoff)
    count, rays = len(surfels["means"]), _rows(origins)
    channels = features.shape[1] if features is not None and features.ndim == 2 else 0
    if features is not None and not 1 <= channels <= MAX_CHANNELS:
        raise ValueError(f"features must be (N, C) with 1 <= C <= {MAX_CHANNELS}, got {tuple(features.shape)}")
    if sh_rest is not None and sh_dc is None:
        raise ValueError("sh_rest is given without sh_dc; pass both, or sh_dc alone for degree 0")
    check_trace_options(options, rays)
    expected = {
        "origins": (origins, (rays, 3)),
        "directions": (directions, (rays, 3)),
        "features": (features, (count, channels)),
        "sh_dc": (sh_dc, (count, 3)),
        "probe": (probe, (count, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor is not None:
            _check_shape(name, tensor, shape)
    if sh_rest is not None:
        counts = [rest_count(degree) for degree in range(MAX_DEGREE + 1)]
        if sh_rest.ndim != 3 or sh_rest.shape[1] not in counts or (sh_rest.shape[0], sh_rest.shape[2]) != (count, 3):
            raise ValueError(f"sh_rest must have shape ({count}, K, 3), K in {counts}, got {tuple(sh_rest.shape)}")


def check_tree_shapes(surfels: dict[str, Tensor], alpha_cutoff: float) -> None:
    """Raise ValueError when the geometry of N surfels, by name, or the cutoff that bounds it does not fit."""
    count = _rows(surfels["means"])
    shapes = {"means": (3,), "tangent_u": (3,), "tangent_v": (3,), "scales": (2,), "opacities": ()}
    for name, shape in shapes.items():
        _check_shape(name, surfels[name], (count, *shape))
    if not 0 < alpha_cutoff < 0.99:
        raise ValueError(f"alpha_cutoff={alpha_cutoff} must be in (0, 0.99): it bounds a surfel's support")


def check_float32(tensors: Mapping[str, Tensor | None], twin: str) -> None:
    """Raise ValueError, naming the tensor, when one is not float32 on the CPU; ``twin``: the module that takes any."""
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device.type != "cpu"):
            raise ValueError(
                f"{name} must be float32 on the CPU, got {tensor.dtype} on {tensor.device}; convert it, or use {twin} "
                "for float64"
            )


def check_trace_options(options: TraceOptions, rays: int) -> None:
    """Raise ValueError, naming the option, when its value is outside what the tracer computes."""
    rest_count(options.sh_degree)
    if not 0 <= options.transmittance_cutoff < 1:
        raise ValueError(f"transmittance_cutoff={options.transmittance_cutoff} must be in [0, 1); 0 never stops a ray")
    legal = {"direction_gradient": ("full", "last_sh"), "sh_direction": ("unit", "raw")}
    for name, choices in (legal | {"order": ("auto", "given", "sorted")}).items():
        if getattr(options, name) not in choices:
            raise ValueError(f"{name}={getattr(options, name)!r} is not one of {', '.join(choices)}")
    for name in ("t_min", "t_max"):
        value = getattr(options, name)
        if isinstance(value, Tensor) and tuple(value.shape) != (rays,):
            raise ValueError(f"{name} must be one number or have shape ({rays},), got {tuple(value.shape)}")


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} must have shape {shape} to fit means and origins, got {tuple(tensor.shape)}")


def _rows(tensor: Tensor) -> int:
    return tensor.shape[0] if tensor.ndim else 0


def check_size(camera: Camera) -> None:
    """Raise ValueError when the image is larger than the native core counts."""
    if max(camera.width, camera.height) > MAX_SIDE:
        raise ValueError(f"image of {camera.width}x{camera.height}: sides above {MAX_SIDE} pixels are not supported")
