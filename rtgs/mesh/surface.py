"""The surface that light is traced with: the hull smoothed, where its outlines and those of the masks agree on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rtgs.core.decisions import Decision
from rtgs.mesh.fairing import Fairing, fair_surface
from rtgs.mesh.hull import HullResult
from rtgs.mesh.record import SurfaceFit
from rtgs.mesh.rims import rim_views
from rtgs.mesh.settings import SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, SilhouetteScore
from rtgs.mesh.triangles import TriangleMesh

Score = Callable[[TriangleMesh], SilhouetteScore]
"""Silhouette IoU of a mesh with the masks."""


@dataclass(frozen=True)
class Surface:
    """What became of the hull."""

    mesh: TriangleMesh
    kind: str  # "free", or empty: the hull stays
    fit: SurfaceFit
    decision: Decision


def find_surface(hull: HullResult, masks: MaskSet, settings: SurfaceSettings, score: Score) -> Surface:
    """The hull smoothed as far as the outlines of the masks allow; the hull itself where that costs silhouette IoU."""
    views = rim_views(masks.views, hull.hidden)
    found = fair_surface(hull.mesh, hull.voxel, views, settings)
    before, after = score(hull.mesh).mean, score(found.mesh).mean
    fit = SurfaceFit(
        before, after, found.spread_before, found.spread, found.strength, found.sharp, found.unseen, found.feet,
        found.held,
    )  # fmt: skip
    if after < before - settings.iou_cost:
        why = f"silhouette IoU {after:.4f}, {before:.4f} as carved (mesh.object.surface.iou_cost {settings.iou_cost:g})"
        return Surface(hull.mesh, "", fit, Decision("hull not smoothed", why))
    return Surface(found.mesh, "free", fit, Decision("hull smoothed", _why(found, fit)))


def _why(found: Fairing, fit: SurfaceFit) -> str:
    said = f"over {found.strength:.1f} voxels, less at {100 * found.sharp:.0f} % of the vertices, where the outlines"
    said += f" contradict; silhouette IoU {fit.iou:.4f}, {fit.iou_before:.4f} as carved; outlines {fit.outline:.2f} px "
    said += f"off, {fit.outline_before:.2f} as carved; no outline tells of {100 * found.unseen:.1f} %"
    parts = [(found.feet, "made plane"), (found.held, "held where the hull is")]
    said += "".join(f", {count} {'part' if count == 1 else 'parts'} {what}" for count, what in parts if count)
    return said
