"""The surfel rasteriser on the native core: docs/rasterizer.md says what it computes, rtgs/native/raster* how."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.native.threads import threads
from rtgs.render.arguments import check_float32, check_shapes, check_size
from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.native_call import as_array, empty_if, native_camera
from rtgs.render.surfel_filter import convolve_surfels, rasterize_convolved

_DEFAULT_OPTIONS = RasterOptions()


def rasterize_surfels(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    options: RasterOptions = _DEFAULT_OPTIONS,
    screen_probe: Tensor | None = None,
) -> RasterBuffers:
    """Render N surfels; :func:`rtgs.render.reference.surfels.rasterize_surfels` is its float64 twin.

    Runs on as many threads as :func:`rtgs.native.threads.threads` says; no bit of the result depends on it. First
    derivatives only: a second backward pass through the gradients raises.

    Parameters
    ----------
    means : (N, 3) Tensor
        Centres, float32, world frame. N = 0 is legal.
    tangent_u, tangent_v : (N, 3) Tensor
        Axes, world; taken as given, not normalised.
    scales : (N, 2) Tensor
        Standard deviations along the tangents, world units.
    opacities : (N,) Tensor
        In (0, 1].
    features : (N, C) Tensor
        What is composited, 1 <= C <= 32; colours, for example.
    camera : Camera
        Pinhole camera; not differentiated.
    background : (C,) Tensor, optional
        Composited behind everything; None is black. Not differentiated.
    options : RasterOptions, optional
        Optional outputs, near and far plane, cutoffs.
    screen_probe : (N, 2) Tensor, optional
        Any values: its gradient receives the densification signal (method.md 3.1).

    Returns
    -------
    RasterBuffers
        The composited features, the coverage, and the maps that were asked for.

    Raises
    ------
    ValueError
        A shape, a dtype or an option does not fit; the message names the argument.

    References
    ----------
    .. [1] Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH 2024.
    .. [2] docs/rasterizer.md
    """
    check_shapes(means, tangent_u, tangent_v, scales, opacities, features, background, screen_probe)
    named = {"means": means, "tangent_u": tangent_u, "tangent_v": tangent_v, "scales": scales, "opacities": opacities}
    named |= {"features": features, "background": background, "screen_probe": screen_probe}
    check_float32(named, "rtgs.render.reference.surfels")
    _check_options(options, camera)
    if options.convolved:
        surfels = (means, tangent_u, tangent_v, scales, opacities)
        seen = (features, camera, background, options, screen_probe)
        return rasterize_convolved(rasterize_surfels, convolve_surfels, surfels, *seen)
    if background is not None:
        background = background.detach().contiguous()
    call = _Call(camera, options, background, threads())
    outputs = _Rasterize.apply(
        means.contiguous(),
        tangent_u.contiguous(),
        tangent_v.contiguous(),
        scales.contiguous(),
        opacities.contiguous(),
        features.contiguous(),
        screen_probe,
        call,
    )
    return RasterBuffers(*outputs)


@dataclass(frozen=True)
class _Call:
    camera: Camera
    options: RasterOptions
    background: Tensor | None
    threads: int


class _Rasterize(torch.autograd.Function):
    """Memory of the forward pass lives in ``ctx.native`` and returns to a pool when autograd drops the context."""

    @staticmethod
    def forward(ctx, means, tangent_u, tangent_v, scales, opacities, features, screen_probe, call: _Call):
        options, width, height = call.options, call.camera.width, call.camera.height
        arrays = [as_array(t) for t in (means, tangent_u, tangent_v, scales, opacities, features)]
        needs_depth = options.depth or options.median_depth or options.distortion
        cutoffs = (options.alpha_cutoff, options.transmittance_cutoff)
        camera = native_camera(call.camera, options.near, options.far, cutoffs, options.low_pass)
        native = core.Rasterization(camera, options.normal, needs_depth, options.absolute_probe)
        native.project(*arrays, call.threads)

        image = torch.empty(features.shape[1], height, width, dtype=torch.float32)
        alpha = torch.empty(height, width, dtype=torch.float32)
        depth = empty_if(options.depth, height, width)
        median_depth = empty_if(options.median_depth, height, width)
        normal = empty_if(options.normal, 3, height, width)
        distortion = empty_if(options.distortion, height, width)
        weight_sum = empty_if(options.weight_sum, means.shape[0])
        native.forward(
            as_array(call.background),
            as_array(image),
            as_array(normal),
            as_array(alpha),
            as_array(depth),
            as_array(median_depth),
            as_array(distortion),
            as_array(weight_sum),
        )
        if any(ctx.needs_input_grad):
            ctx.native = native
            ctx.save_for_backward(
                means, tangent_u, tangent_v, scales, opacities, features, image, normal, depth, distortion
            )
            if weight_sum is not None:
                ctx.mark_non_differentiable(weight_sum)
            ctx.set_materialize_grads(False)
        return image, alpha, depth, median_depth, normal, distortion, weight_sum

    @staticmethod
    @once_differentiable
    def backward(ctx, g_image, g_alpha, g_depth, g_median, g_normal, g_distortion, _g_weight_sum):  # type: ignore[override]
        *inputs, image, normal, depth, distortion = ctx.saved_tensors
        upstream = [g_image, g_normal, g_alpha, g_depth, g_median, g_distortion]
        if all(g is None for g in upstream):
            return (None,) * 8
        means = inputs[0]
        like = [*inputs, means[:, :2]]
        gradients = [empty_if(needed, *t.shape) for t, needed in zip(like, ctx.needs_input_grad, strict=False)]
        ctx.native.backward(
            *(as_array(t) for t in inputs),
            as_array(image),
            as_array(normal),
            as_array(depth),
            as_array(distortion),
            *(None if g is None else as_array(g.contiguous()) for g in upstream),
            *(as_array(g) for g in gradients),
        )
        return (*gradients, None)


def _check_options(options: RasterOptions, camera: Camera) -> None:
    if not 0 < options.near < options.far:
        raise ValueError(f"near={options.near} and far={options.far} must satisfy 0 < near < far (world units)")
    for name in ("alpha_cutoff", "transmittance_cutoff"):
        if not 0 < getattr(options, name) < 0.99:
            raise ValueError(f"{name}={getattr(options, name)} must be above 0 and below 0.99, the largest alpha")
    if not 0 < options.low_pass < math.inf:
        raise ValueError(f"low_pass={options.low_pass} must be positive and finite (px^2)")
    check_size(camera)
