"""The ellipsoid rasteriser (3DGS) on the native core: docs/rasterizer.md, "Ellipsoids", says what it computes."""

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
from rtgs.render.buffers import EllipsoidBuffers, EllipsoidOptions
from rtgs.render.native_call import as_array, empty_if, native_camera

_DEFAULT_OPTIONS = EllipsoidOptions()


def rasterize_ellipsoids(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    options: EllipsoidOptions = _DEFAULT_OPTIONS,
    screen_probe: Tensor | None = None,
) -> EllipsoidBuffers:
    """Render N ellipsoids; :func:`rtgs.render.reference.ellipsoids.rasterize_ellipsoids` is its float64 twin.

    Runs on as many threads as :func:`rtgs.native.threads.threads` says; no bit of the result depends on it. First
    derivatives only: a second backward pass through the gradients raises.

    Parameters
    ----------
    means : (N, 3) Tensor
        Centres, float32, world frame. N = 0 is legal.
    tangent_u, tangent_v : (N, 3) Tensor
        Axes, world; taken as given, not normalised. The third axis is their cross product.
    scales : (N, 3) Tensor
        Standard deviations along the three axes, world units.
    opacities : (N,) Tensor
        In (0, 1].
    features : (N, C) Tensor
        What is composited, 1 <= C <= 32; colours, for example.
    camera : Camera
        Pinhole camera; not differentiated.
    background : (C,) Tensor, optional
        Composited behind everything; None is black. Not differentiated.
    options : EllipsoidOptions, optional
        Cut rules, dilation, antialiasing, optional outputs.
    screen_probe : (N, 2) Tensor, optional
        Any values: its gradient receives 3DGS's densification signal, the gradient by the projected centre in
        normalised device coordinates.

    Returns
    -------
    EllipsoidBuffers
        The composited features, the coverage, and the maps that were asked for.

    Raises
    ------
    ValueError
        A shape, a dtype or an option does not fit; the message names the argument.

    References
    ----------
    .. [1] Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023.
    .. [2] docs/rasterizer.md, "Ellipsoids"
    """
    check_shapes(means, tangent_u, tangent_v, scales, opacities, features, background, screen_probe, scale_axes=3)
    named = {"means": means, "tangent_u": tangent_u, "tangent_v": tangent_v, "scales": scales, "opacities": opacities}
    named |= {"features": features, "background": background, "screen_probe": screen_probe}
    check_float32(named, "rtgs.render.reference.ellipsoids")
    _check_options(options)
    check_size(camera)
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
    return EllipsoidBuffers(*outputs)


@dataclass(frozen=True)
class _Call:
    camera: Camera
    options: EllipsoidOptions
    background: Tensor | None
    threads: int

    def start(self) -> core.EllipsoidRasterization:
        o = self.options
        camera = native_camera(self.camera, o.near, math.inf)
        shape = (o.dilation, o.radius_sigmas, o.antialiased)
        return core.EllipsoidRasterization(camera, *shape, o.depth, o.absolute_probe)


class _Rasterize(torch.autograd.Function):
    """Memory of the forward pass lives in ``ctx.native`` and returns to a pool when autograd drops the context."""

    @staticmethod
    def forward(ctx, means, tangent_u, tangent_v, scales, opacities, features, screen_probe, call: _Call):
        options, size = call.options, (call.camera.height, call.camera.width)
        native = call.start()
        arrays = [as_array(t) for t in (means, tangent_u, tangent_v, scales, opacities, features)]
        native.project(*arrays, call.threads)

        image = torch.empty(features.shape[1], *size, dtype=torch.float32)
        alpha = torch.empty(size, dtype=torch.float32)
        depth = empty_if(options.depth, *size)
        weight_sum = empty_if(options.weight_sum, means.shape[0])
        outputs = (image, alpha, depth, weight_sum)
        native.forward(as_array(call.background), *(as_array(t) for t in outputs))
        if any(ctx.needs_input_grad):
            ctx.native = native
            ctx.save_for_backward(means, tangent_u, tangent_v, scales, opacities, features, image, depth)
            if weight_sum is not None:
                ctx.mark_non_differentiable(weight_sum)
            ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, g_image, g_alpha, g_depth, _g_weight_sum):  # type: ignore[override]
        *inputs, image, depth = ctx.saved_tensors
        upstream = [g_image, g_alpha, g_depth]
        if all(g is None for g in upstream):
            return (None,) * 8
        like = [*inputs, inputs[0][:, :2]]
        gradients = [empty_if(needed, *t.shape) for t, needed in zip(like, ctx.needs_input_grad, strict=False)]
        ctx.native.backward(
            *(as_array(t) for t in inputs),
            as_array(image),
            as_array(depth),
            *(None if g is None else as_array(g.contiguous()) for g in upstream),
            *(as_array(g) for g in gradients),
        )
        return (*gradients, None)


def _check_options(options: EllipsoidOptions) -> None:
    if not (0 < options.near < math.inf):
        raise ValueError(f"near={options.near} must be positive and finite (world units)")
    if not (0 < options.dilation < math.inf):
        raise ValueError(
            f"dilation={options.dilation} must be positive and finite (px^2): without it a needle has no area"
        )
    if not options.radius_sigmas > 0:
        raise ValueError(f"radius_sigmas={options.radius_sigmas} must be positive; inf is the exact support")
