"""What is seen through transparent objects: their contents, and behind these the light that the far wall sends.

    C_t = C + (1 - A) enc( T B + R I )

for each ray: C and A of the contents, B the light from behind the object, R the reflectance of the far wall and T what
it lets pass, I the light that comes to it from inside (docs/glass_light.md). Where it is no wall that mirrors, T is 1
and R is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.methods.shading.inner import LINEAR, far_wall
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.optics.dielectric import all_native, glass_numbers
from rtgs.optics.light import decoded, encoded


@dataclass(frozen=True)
class Behind:
    """What lies behind the contents, of R rays."""

    rows: Tensor  # (B,) int64 into the rays, each once: those that go on
    color: Tensor  # (B, 3) encoded, what they meet; the others meet nothing
    mirrored: Tensor  # (K,) int64 into the rays, each once: those with a wall that mirrors
    arriving: Tensor  # (K, 3) linear light that comes to it from inside
    cosine: Tensor  # (K,) of the angle of incidence there
    index: Tensor | float  # of refraction
    tint: Tensor | None = None  # (3,) of light that passes; None: none

    def passing(self, count: int) -> Tensor:
        """(R, 3) linear light from behind the object."""
        return decoded(torch.zeros(count, 3, dtype=self.color.dtype).index_add(0, self.rows, self.color), LINEAR)

    def sent(self, passing: Tensor) -> Tensor:
        """(R, 3) linear light that the far wall sends on: ``passing`` light, less what it reflects, and mirrored."""
        return far_wall(passing, self.arriving, self.mirrored, self.cosine, self.index, self.tint)


def seen_through(contents: Tensor, alpha: Tensor | None, behind: Behind) -> Tensor:
    """(R, 3) encoded colours of R rays. float32 goes through a native kernel.

    Args:
        contents: (R, 3) C, encoded.
        alpha: (R,) A; None: what lies behind is added to the contents.
        behind: them.
    """
    given = (alpha, behind.color, behind.arriving, behind.cosine)
    if not all_native(behind.index, contents, *given, behind.tint):
        return seen_through_twin(contents, alpha, behind)
    planes = _SeenThrough.apply(contents.T, *given, behind.rows, behind.mirrored, behind.index, behind.tint)
    return planes.T  # type: ignore[union-attr]


def seen_through_twin(contents: Tensor, alpha: Tensor | None, behind: Behind) -> Tensor:
    """:func:`seen_through` in plain torch."""
    light = encoded(behind.sent(behind.passing(len(contents))), LINEAR)
    return contents + (light if alpha is None else (1 - alpha)[:, None] * light)


class _SeenThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given) -> Tensor:
        contents, *maps, rows, mirrored, index, tint = given
        color = torch.empty(contents.shape)
        ctx.glass, ctx.index_shape = glass_numbers(index, tint), getattr(index, "shape", None)
        places = arrays_of(rows, mirrored)
        core.far_wall(*arrays_of(contents), arrays_of(*maps), places, ctx.glass, color.numpy(), threads())
        ctx.save_for_backward(contents, *maps, rows, mirrored)
        return color

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        contents, *maps, rows, mirrored = ctx.saved_tensors
        gradients, to_glass = [None if each is None else torch.empty(each.shape) for each in maps], torch.empty(4)
        given = (*arrays_of(contents), arrays_of(*maps), arrays_of(rows, mirrored), ctx.glass, *arrays_of(upstream))
        core.far_wall_backward(*given, arrays_of(*gradients), to_glass.numpy(), threads())
        to_index = None if ctx.index_shape is None else to_glass[:1].reshape(ctx.index_shape)
        return (upstream, *gradients, None, None, to_index, None if ctx.glass[1] is None else to_glass[1:])
