"""Losses on rendered pictures, native forward and backward (method.md 3.1 "Post", 5, 9).

Float32 on the CPU. The same functions in plain torch, for any dtype: ``rtgs.train.reference_losses``. Every kernel
computes its gradient in the forward sweep, so a backward pass costs at most one multiplication. Reductions run in a
fixed order: results are the same bit for bit whatever ``torch.set_num_threads``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.native.threads import threads

MIN_ALPHA = 1e-6  # at or below it a pixel has no surface: its expected depth is 0
PERCENTILE_SAMPLES = 16_384  # depth percentiles are taken over about this many pixels of a regular grid


@dataclass(frozen=True)
class PhotometricLoss:
    """``total`` = l1 weight * l1 + dssim weight * dssim, differentiable; the parts are plain, unweighted numbers."""

    total: Tensor  # scalar
    l1: float  # mean |image - target|
    dssim: float  # 1 - mean SSIM; 0.0 when its weight is 0, for then it is never computed


def photometric_loss(image: Tensor, target: Tensor, l1: float = 0.8, dssim: float = 0.2) -> PhotometricLoss:
    """l1 * mean|image - target| + dssim * (1 - SSIM), method.md 5 L_rgb.

    ``image``, ``target`` (C, H, W) float32, range 0..1 (values outside are legal). SSIM as in method.md 9: Gaussian
    window 11x11 of sigma 1.5, zero padding, per channel, C1 = 0.01^2, C2 = 0.03^2. Differentiable in ``image`` only.
    Raises ValueError for other shapes, dtypes, or a target that requires a gradient.
    """
    _check_pair(image, target)
    total, l1_value, dssim_value = _Photometric.apply(image, target, float(l1), float(dssim))
    return PhotometricLoss(total, l1_value, dssim_value)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM (scalar tensor, no gradient) of two pictures (C, H, W) float32, range 0..1, as in method.md 9."""
    _check_pair(image, target)
    _, dissimilarity = core.photometric_loss(_data(image), _data(target), 0.0, 1.0, True, None, None, threads())
    return torch.tensor(1.0 - dissimilarity)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """(C, H, W) SSIM of every pixel and channel (no gradient); its mean is :func:`ssim`."""
    _check_pair(image, target)
    dissimilarity = torch.empty_like(image, memory_format=torch.contiguous_format, requires_grad=False)
    core.photometric_loss(_data(image), _data(target), 0.0, 1.0, True, None, dissimilarity, threads())
    return 1.0 - dissimilarity


def normal_consistency_loss(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Camera,
    *,
    inverse_depth_weight: bool = False,
    depth_override: Tensor | None = None,
) -> Tensor:
    """mean over all pixels of weight * (1 - N . (A N_d)), method.md 5 L_norm; scalar.

    ``normal`` (3, H, W) world, sum of w n; ``depth`` (H, W) sum of w z; ``alpha`` (H, W). N_d is the unit normal of the
    back-projected surface depth = depth / alpha (0 where alpha <= MIN_ALPHA): central differences over +-1 pixel,
    facing the camera, zero on the border and where two opposite neighbours have no depth. So border and empty pixels
    add a constant.
    ``depth_override`` (H, W): this surface depth instead, e.g. from :func:`surface_depth` with a median depth.
    ``inverse_depth_weight`` (EnvGS): weight = :func:`inverse_depth_weights`, else 1.

    Gradient flows to normal and, through N_d, to depth and to alpha as the divisor of depth (or to ``depth_override``
    alone). The factor A and the weight are constants.
    Raises ValueError for shapes or dtypes that do not fit the camera.
    """
    _check_map("normal", normal, (3, camera.height, camera.width))
    for name, value in (("depth", depth), ("alpha", alpha), ("depth_override", depth_override)):
        if value is not None:
            _check_map(name, value, (camera.height, camera.width))
    surface = depth if depth_override is None else depth_override
    near, inverse_range = 0.0, 0.0
    if inverse_depth_weight:
        near, inverse_range = _depth_ramp(surface, alpha if depth_override is None else None)
    return _NormalConsistency.apply(
        normal, surface, alpha, depth_override is not None, _rotation(camera), _intrinsics(camera), near, inverse_range
    )


def mono_normal_loss(
    normal: Tensor, mono_normal: Tensor, camera: Camera, *, form: str = "cosine", weight: Tensor | None = None
) -> Tensor:
    """Distance to monocular normals, mean over all pixels, method.md 5 L_mono; scalar.

    ``normal`` (3, H, W) world, any length: turned to the camera frame and normalised to n (zero where shorter than
    1e-6). ``mono_normal`` m (3, H, W) camera frame (x right, y down, z forward), unit and facing the camera, or zero
    where there is no estimate: such pixels count 0. ``form``: "cosine" 1 - n . m (the paper) or "envgs"
    |n - m|_1 + 1 - n . m.
    ``weight`` (H, W): a factor without gradient, e.g. :func:`inverse_depth_weights`. Differentiable in ``normal`` only.
    Raises ValueError for another form, shape or dtype.
    """
    if form not in ("cosine", "envgs"):
        raise ValueError(f"mono_normal_loss: form must be 'cosine' or 'envgs', got {form!r} (loss.mono_normal_form)")
    _check_map("normal", normal, (3, camera.height, camera.width))
    _check_map("mono_normal", mono_normal, (3, camera.height, camera.width))
    if weight is not None:
        _check_map("weight", weight, (camera.height, camera.width))
    return _MonoNormal.apply(normal, mono_normal, weight, _rotation(camera), form == "envgs")


def distortion_loss(distortion: Tensor) -> Tensor:
    """Mean of the rasteriser's distortion map (H, W); scalar (2DGS)."""
    return distortion.mean()


def surface_depth(depth: Tensor, alpha: Tensor, median_depth: Tensor | None = None, depth_ratio: float = 0.0) -> Tensor:
    """(1 - depth_ratio) * depth / alpha + depth_ratio * median_depth, (H, W); method.md 3.1 "Post".

    Differentiable, any dtype. The quotient is 0 where alpha <= MIN_ALPHA. Raises ValueError when a ratio above 0 has no
    median depth to mix.
    """
    if depth_ratio > 0 and median_depth is None:
        raise ValueError(f"depth_ratio={depth_ratio} needs median_depth: render with RasterOptions(median_depth=True)")
    if depth_ratio == 1 and median_depth is not None:
        return median_depth
    covered = alpha > MIN_ALPHA
    expected = torch.where(covered, depth / torch.where(covered, alpha, 1.0), 0.0)
    return expected if median_depth is None or depth_ratio == 0 else torch.lerp(expected, median_depth, depth_ratio)


def inverse_depth_weights(depth: Tensor, alpha: Tensor | None = None) -> Tensor:
    """(H, W) 1 - (d - p1) / (p99 - p1) clipped to 0..1 (EnvGS, method.md 5), no gradient.

    d = depth / alpha, or ``depth`` itself without ``alpha``; both (H, W) float32. The percentiles are those of the
    covered pixels (d > 0: empty ones say nothing of the scene's depth), nearest rank, over a regular grid of about
    PERCENTILE_SAMPLES pixels. 1 everywhere when no depth varies.
    """
    if depth.ndim != 2:
        raise ValueError(f"depth must be (H, W), got {tuple(depth.shape)}")
    for name, value in (("depth", depth), ("alpha", depth if alpha is None else alpha)):
        _check_map(name, value, tuple(depth.shape))
    near, inverse_range = _depth_ramp(depth, alpha)
    surface = depth.detach() if alpha is None else surface_depth(depth.detach(), alpha.detach())
    return (1 - (surface - near) * inverse_range).clamp_(0, 1)


def _depth_ramp(depth: Tensor, alpha: Tensor | None) -> tuple[float, float]:
    """First percentile p1 of the depth (divided by alpha, if given) and 1 / (p99 - p1), 0 when that range is empty."""
    step = max(1, math.ceil(math.sqrt(depth.numel() / PERCENTILE_SAMPLES)))
    low, high = core.depth_percentiles(_data(depth), None if alpha is None else _data(alpha), MIN_ALPHA, step)
    return low, 1 / (high - low) if high > low else 0.0


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, l1: float, dssim: float):
        gradient = _gradient_like(image) if ctx.needs_input_grad[0] else None
        l1_value, dssim_value = core.photometric_loss(
            _data(image), _data(target), l1, dssim, dssim != 0, gradient, None, threads()
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return torch.tensor(l1 * l1_value + dssim * dssim_value, dtype=torch.float32), l1_value, dssim_value

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor, *_parts):
        return _scaled(ctx.saved_tensors[0], upstream), None, None, None


class _NormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(ctx, normal, surface, alpha, is_surface, rotation, intrinsics, near, inverse_range):
        gradients: list[Tensor | None] = [None, None, None]
        if any(ctx.needs_input_grad):
            gradients = [_gradient_like(normal), _gradient_like(surface), None if is_surface else _gradient_like(alpha)]
            ctx.save_for_backward(*gradients)
        maps = (_data(normal), _data(surface), _data(alpha))
        value = core.normal_consistency_loss(
            *maps, is_surface, rotation, intrinsics, near, inverse_range, *gradients, threads()
        )
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):
        scaled = (
            _scaled(gradient, upstream) if gradient is not None and needed else None
            for gradient, needed in zip(ctx.saved_tensors, ctx.needs_input_grad, strict=False)
        )
        return (*scaled, None, None, None, None, None)


class _MonoNormal(torch.autograd.Function):
    @staticmethod
    def forward(ctx, normal, mono_normal, weight, rotation, with_l1):
        gradient = _gradient_like(normal) if ctx.needs_input_grad[0] else None
        weight = None if weight is None else _data(weight)
        maps = (_data(normal), _data(mono_normal), weight)
        value = core.mono_normal_loss(*maps, rotation, float(with_l1), gradient, threads())
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):
        return _scaled(ctx.saved_tensors[0], upstream), None, None, None, None


def _scaled(gradient: Tensor, upstream: Tensor) -> Tensor:
    return gradient if upstream.item() == 1.0 else gradient * upstream  # CPU: no device to wait for


def _gradient_like(value: Tensor) -> Tensor:
    return torch.empty(value.shape, dtype=torch.float32)


def _data(value: Tensor) -> Tensor:
    return value.detach().contiguous()


def _rotation(camera: Camera) -> Tensor:
    return camera.rotation.to(torch.float32).contiguous()


def _intrinsics(camera: Camera) -> Tensor:
    return torch.tensor((camera.fx, camera.fy, camera.cx, camera.cy), dtype=torch.float32)


def _check_pair(image: Tensor, target: Tensor) -> None:
    if image.ndim != 3 or image.numel() == 0:
        raise ValueError(f"image must be (C, H, W) with at least one pixel, got {tuple(image.shape)}")
    _check_map("image", image, tuple(image.shape))
    _check_map("target", target, tuple(image.shape))
    if target.requires_grad:
        raise ValueError("target requires a gradient, but these losses are differentiable in the image only; detach it")


def _check_map(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} must have the shape {shape} of its view, got {tuple(value.shape)}")
    if value.dtype != torch.float32 or value.device.type != "cpu":
        raise ValueError(
            f"{name} must be float32 on the CPU, got {value.dtype} on {value.device}; "
            "for other dtypes use rtgs.train.reference_losses"
        )
