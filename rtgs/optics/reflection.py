"""The weight w_r of the reflected colour alone: a native kernel for the default model, plain torch for the others."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads
from rtgs.optics.microfacet import specular_weights
from rtgs.optics.settings import OpticsSettings


def reflection_weight(cosine: Tensor, roughness: Tensor, f0: Tensor, settings: OpticsSettings) -> Tensor:
    """``specular_weights(...).reflection``, its twin, several times as fast where the native kernel knows the model.

    That is float32 on the CPU, one f0 for all colours, weight "microfacet", masking "correlated", remap "pbrt", fresnel
    "schlick".

    Args:
        cosine: (P,) n . omega_o; any value.
        roughness: (P,) in 0..1.
        f0: (P,) in 0..1, or (P, 3) for rgb.
        settings: which weight, which bound.

    Returns:
        The shape of ``f0``.
    """
    maps = (cosine, roughness, f0)
    model = (settings.weight, settings.masking, settings.remap, settings.fresnel)
    plain = model == ("microfacet", "correlated", "pbrt", "schlick")
    if not (plain and all(m.dtype == torch.float32 and m.ndim == 1 and m.device.type == "cpu" for m in maps)):
        return specular_weights(cosine, roughness, f0, settings).reflection
    cosine = cosine.detach() if settings.detach_cosine else cosine
    bound = 1 / settings.max_gain if settings.max_gain > 0 else 0.0
    return _Reflection.apply(cosine, roughness, f0, (settings.cosine_floor, settings.roughness_floor, bound))  # type: ignore[return-value]


class _Reflection(torch.autograd.Function):
    @staticmethod
    def forward(ctx, cosine: Tensor, roughness: Tensor, f0: Tensor, numbers: tuple[float, float, float]) -> Tensor:
        maps = [m.detach().contiguous() for m in (cosine, roughness, f0)]
        weight = torch.empty_like(maps[0])
        core.microfacet_reflection(*(m.numpy() for m in maps), *numbers, weight.numpy(), threads())
        ctx.save_for_backward(*maps)
        ctx.numbers = numbers
        return weight

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        maps = [m.numpy() for m in ctx.saved_tensors]
        gradients = [torch.empty_like(m) for m in ctx.saved_tensors]
        arrays = (upstream.contiguous().numpy(), *(g.numpy() for g in gradients))
        core.microfacet_reflection_backward(*maps, *ctx.numbers, *arrays, threads())
        return (*gradients, None)
