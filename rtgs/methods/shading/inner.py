"""Light mirrored inside transparent objects: from what was traced along a path to what it brings to the far wall.

    I_k = C_k + (1 - A_k) [ (1 - R_k) t E_k + R_k I_{k+1} ]

of leg k of a path: C_k and A_k what the contents show along it, E_k the surroundings seen through the wall at its end,
R_k the reflectance of that wall, t its tint. Contents are composited over what lies behind them in the encoding of the
photos, as everywhere; walls mix linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.mesh.inner_paths import InnerPaths
from rtgs.optics.dielectric import passed, wall_reflectance
from rtgs.optics.light import decoded, encoded

LINEAR = "linear"


@dataclass(frozen=True)
class TracedLeg:
    """What was traced along the L rays of one leg."""

    contents: Tensor  # (L, 3) C, encoded
    alpha: Tensor  # (L,) A
    surroundings: Tensor  # (L, 3) E, encoded


def inner_light(
    paths: InnerPaths, traced: Sequence[TracedLeg], index: Tensor | float, tint: Tensor | None = None
) -> Tensor:
    """(K, 3) linear light that comes to the far wall from inside, before it is mirrored there; any dtype.

    ``tint`` (3,): of light that passes a wall; None: none.
    """
    arriving: Tensor | None = None
    for k in reversed(range(len(traced))):
        leg, met = paths.legs[k], traced[k]
        reflected = (leg.wall * wall_reflectance(leg.cosine.to(met.alpha.dtype), index))[:, None]
        light = passed(reflected, leg.wall[:, None], tint) * decoded(met.surroundings, LINEAR)
        if arriving is not None:
            later = torch.zeros_like(light).index_copy(0, paths.legs[k + 1].parent, arriving)
            light = light + reflected * later
        arriving = decoded(met.contents + (1 - met.alpha)[:, None] * encoded(light, LINEAR), LINEAR)
    assert arriving is not None
    return arriving


def far_wall(
    behind: Tensor,
    arriving: Tensor,
    rows: Tensor,
    cosine: Tensor,
    index: Tensor | float,
    tint: Tensor | None = None,
) -> Tensor:
    """(R, 3) linear light that the far wall sends to the eye: what it lets pass, and in ``rows`` what it mirrors.

    Args:
        behind: (R, 3) linear light from behind the object.
        arriving: (K, 3) of :func:`inner_light`.
        rows: (K,) int64 into the R rays, those with a wall that mirrors.
        cosine: (K,) of the angle of incidence there.
        index: of refraction.
        tint: (3,) of light that passes; None: none.
    """
    reflected = wall_reflectance(cosine.to(behind.dtype), index)[:, None]
    through = passed(reflected, 1.0, tint)
    passing = torch.ones(len(behind), through.shape[1], dtype=behind.dtype).index_copy(0, rows, through)
    return (passing * behind).index_add(0, rows, reflected * arriving)
