"""Native fused activation of surfels and ellipsoids: tangents, scales, opacities, SH colours, and the backward pass.

The readable twin is :func:`rtgs.gaussians.surfels.activate`; rules at degenerate input (zero
quaternion, mean at the camera centre, extreme logits and log-scales) are the same in both.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.gaussians.primitives import PARAMETERS, Gaussians
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads


def activate_gaussians(gaussians: Gaussians, camera_center: Tensor, sh_degree: int) -> ActivatedGaussians:
    """Activate for one camera, float32, differentiable by every raw parameter.

    Parameters
    ----------
    gaussians : Surfels or Ellipsoids
        N of them, float32 on the CPU.
    camera_center : (3,) Tensor
        World. It gets a gradient, of the colours, where it requires one.
    sh_degree : int
        Active degree of the spherical harmonics; capped by what they hold.

    Returns
    -------
    ActivatedGaussians
        What the renderers take.

    Raises
    ------
    TypeError
        A parameter is not float32 on the CPU.
    ValueError
        Shapes do not match.
    """
    for name in PARAMETERS:  # not the channels
        tensor = gaussians[name]
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(
                f"gaussians.{name} is {tensor.dtype} on {tensor.device}; activate_gaussians takes float32 on the CPU "
                "(rtgs.gaussians.surfels.activate takes any dtype)"
            )
    raw = tuple(gaussians[name] for name in PARAMETERS)
    center = tuple(camera_center.tolist())
    learned = camera_center if camera_center.requires_grad else None
    outputs = _Activate.apply(learned, center, min(sh_degree, gaussians.sh_degree), *raw)
    return ActivatedGaussians(gaussians.means, *outputs)


def activate_geometry(gaussians: Gaussians) -> ActivatedGaussians:
    """Tangents, scales and opacities alone, differentiable; the colours of the result mean nothing.

    For the tracer, which evaluates colours itself, at the direction of each ray.
    """
    raw = [gaussians[name] for name in PARAMETERS]
    raw[0], raw[4] = raw[0].detach(), raw[4].detach()  # colours alone would give them a gradient
    raw[5] = raw[5].new_empty(len(raw[5]), 0, 3)
    return ActivatedGaussians(gaussians.means, *_Activate.apply(None, (0.0, 0.0, 0.0), 0, *raw))


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, learned: Tensor | None, center: tuple[float, float, float], degree: int, *raw: Tensor):
        count = len(raw[0])
        rows = raw[0].new_empty
        outputs = (rows(count, 3), rows(count, 3), rows(raw[1].shape), rows(count), rows(count, 3))
        needs_backward = any(ctx.needs_input_grad)
        saved = rows(core.activation_saved_size(count)) if needs_backward else None
        core.activate_gaussians(
            arrays_of(*raw),
            center,
            degree,
            arrays_of(*outputs),
            *arrays_of(saved),
            threads(),
        )
        if saved is not None:
            ctx.save_for_backward(*raw, outputs[2], saved)
            ctx.center, ctx.degree = center, degree
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        *raw, scales, saved = ctx.saved_tensors
        gradients = tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in raw)
        core.activate_gaussians_backward(
            arrays_of(*raw),
            ctx.center,
            ctx.degree,
            *arrays_of(scales, saved),
            arrays_of(*upstream),
            arrays_of(*gradients),
            threads(),
        )
        by_center = None
        if ctx.needs_input_grad[0]:  # the means that pass here are read for the direction from the centre alone
            by_center = -gradients[0].double().sum(0).to(gradients[0].dtype)
        return by_center, None, None, *gradients
