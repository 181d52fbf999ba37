"""How well the surface of a transparent object is known: of a render, pixel by pixel against the truth of path-traced
captures, and of the object's mesh, against its masks and its true container."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import torch
from torch import Tensor

from rtgs.evaluate.records import SURFACE_METRICS

DEPTH_TOLERANCE = 0.03  # of the true depth
NORMAL_TOLERANCE = 15.0  # degrees
DEPTH_OFF = 0.05  # of the true depth: from here on it is wrong


class SurfaceTruth(Protocol):
    """What the figures need of a view's truth; :class:`rtgs.scenes.truth.ViewTruth` has it."""

    @property
    def depth(self) -> Tensor: ...  # (H, W) z-depth of the first surface, 0 where nothing
    @property
    def normal(self) -> Tensor: ...  # (3, H, W) unit, camera frame


class MeshSurfaces(Protocol):
    """Where the pixels of a camera meet the object; :class:`rtgs.mesh.container.ObjectSurfaces` has it."""

    @property
    def hit(self) -> Tensor: ...  # (H, W) bool
    @property
    def second(self) -> Tensor: ...  # (H, W) bool


def surface_errors(depth: Tensor, normal: Tensor | None, truth: SurfaceTruth, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Of the P pixels in ``mask`` (H, W) bool where something is: (P,) relative error of ``depth`` (H, W), and (P,)
    degrees between ``normal`` (3, H, W), camera frame, any length, and the true one; (0,) without a normal."""
    inside = mask & (truth.depth > 0)
    error = (depth[inside] / truth.depth[inside] - 1).abs()
    if normal is None:
        return error, torch.zeros(0)
    unit = torch.nn.functional.normalize(normal[:, inside], dim=0)
    return error, torch.rad2deg(torch.acos((unit * truth.normal[:, inside]).sum(0).clamp(-1, 1)))


def depth_off(depth: Tensor, truth: SurfaceTruth) -> float | None:
    """Share of the pixels where something is whose ``depth`` (H, W) is off by more than 5 %; None: nothing anywhere."""
    error, _ = surface_errors(depth, None, truth, torch.ones_like(depth, dtype=torch.bool))
    return float((error > DEPTH_OFF).double().mean()) if len(error) else None


def surface_scores(depth: Tensor | None, normal: Tensor | None, truth: SurfaceTruth, mask: Tensor) -> dict[str, float]:
    """Those of SURFACE_METRICS that can be had: medians of the errors, shares within 3 % and 15 degrees."""
    if depth is None:
        return {}
    error, angle = surface_errors(depth, normal, truth, mask)
    names = iter(SURFACE_METRICS)
    found = {}
    for values, tolerance in ((error, DEPTH_TOLERANCE), (angle, NORMAL_TOLERANCE)):
        median, share = next(names), next(names)
        if len(values):
            found |= {median: float(values.median()), share: float((values < tolerance).double().mean())}
    return found


def hit_shares(seen: Iterable[tuple[MeshSurfaces, Tensor]]) -> tuple[float | None, float | None]:
    """Shares of the masked pixels whose ray meets one surface only, and none; from surfaces and masks (H, W) bool of
    views. None: nothing is masked."""
    one = none = count = 0
    for surfaces, mask in seen:
        one += int((mask & surfaces.hit & ~surfaces.second).sum())
        none += int((mask & ~surfaces.hit).sum())
        count += int(mask.sum())
    return (one / count, none / count) if count else (None, None)
