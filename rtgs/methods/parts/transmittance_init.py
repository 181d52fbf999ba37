"""Where the transmittance set comes from: base surfels inside the object or behind the pane, or random ones in a box
(method.md 6.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.density import RowPlan, apply_plan, select_rows
from rtgs.gaussians.initialize import points_box
from rtgs.gaussians.materials import MaterialSurfels, without_materials
from rtgs.gaussians.surfels import Surfels
from rtgs.mesh.container import ObjectMesh
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.parts.stratified import stratified_surfels
from rtgs.methods.settings import TransmittanceSettings


def rows_inside(surfels: Surfels, mesh: ObjectMesh, margin: float, cameras: Sequence[Camera]) -> Tensor:
    """(N,) bool: the centre lies in the object, or within ``margin`` (world units) of it along an axis; of a pane:
    behind it for one of the ``cameras``, for straight rays through a pane meet the transmittance set alone."""
    means = surfels.means.detach()
    if mesh.flat:
        return mesh.seen_through(cameras, means)
    inside = mesh.inside(means)
    if margin > 0:
        for axis in range(3):
            for side in (-margin, margin):
                shift = torch.zeros(3)
                shift[axis] = side
                inside |= mesh.inside(means + shift)
    return inside


@torch.no_grad()
def take_out(base: GaussianSet, rows: Tensor, kept: Tensor) -> Surfels:
    """Remove the surfels ``rows`` (N,) bool of the base set, with their moments, and return them without materials;
    those that are ``kept`` (N,) bool are copied."""
    taken = select_rows(base.gaussians, rows)
    nothing = select_rows(base.gaussians, torch.zeros(0, dtype=torch.int64))
    apply_plan(RowPlan((~rows | kept).nonzero()[:, 0], nothing), base.gaussians, base.optimizer, base.density)
    return without_materials(taken) if isinstance(taken, MaterialSurfels) else taken  # type: ignore[return-value]


def random_surfels(settings: TransmittanceSettings, box: Tensor, generator: torch.Generator) -> Surfels:
    """Stratified random surfels in the box (2, 3), small enough that a ray meets ``most_hits`` of them at most.

    A convex box of surface S shows S / 4 on average (Cauchy), a disc half its area: that gives the expected number.
    """
    surfels = stratified_surfels(box, settings.cells, settings.per_cell, settings.init, generator)
    side = (box[1] - box[0]).clamp_min(1e-12)
    shown = float(side[0] * side[1] + side[1] * side[2] + side[2] * side[0]) / 2
    visible = max(settings.init.opacity / settings.alpha_cutoff, 1.0 + 1e-6)
    with torch.no_grad():
        areas = math.pi * 2 * math.log(visible) * surfels.log_scales.exp().prod(dim=1)
        hits = float(areas.double().sum()) / 2 / max(shown, 1e-24)
        if hits > settings.most_hits:
            surfels.log_scales += 0.5 * math.log(settings.most_hits / hits)
    return surfels


def initial_box(settings: TransmittanceSettings, mesh: ObjectMesh, cameras, points: Tensor) -> Tensor:
    """(2, 3) where a random set begins: the object's box, or the scene's (decision 16)."""
    usable = points[torch.isfinite(points).all(dim=1)]
    return points_box(usable) if settings.box == "scene" else mesh.transmittance_box(cameras, usable)
