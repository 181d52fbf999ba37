"""The surface that light is traced with: what explains the masks' outlines most simply.

A sphere, a surface of revolution, a body of planes, or the hull made as smooth as the outlines allow: the first that
they do not contradict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rtgs.core.decisions import Decision
from rtgs.mesh.ball import fit_ball
from rtgs.mesh.fairing import contradicted_share, fair_surface
from rtgs.mesh.hull import HullResult
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.polyhedron import fit_planes
from rtgs.mesh.record import SurfaceFit
from rtgs.mesh.revolution import fit_revolution
from rtgs.mesh.rims import RimView, find_rims, rim_views
from rtgs.mesh.settings import SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, SilhouetteScore
from rtgs.mesh.triangles import TriangleMesh

Score = Callable[[TriangleMesh], SilhouetteScore]
"""Silhouette IoU of a mesh with the masks."""


@dataclass(frozen=True)
class Surface:
    """What became of the hull."""

    mesh: TriangleMesh
    kind: str  # "sphere", "revolution", "planes", "free", or empty: the hull stays
    fit: SurfaceFit  # where the hull stays: of the last surface that was refused
    decision: Decision


@dataclass(frozen=True)
class _Candidate:
    mesh: TriangleMesh
    kind: str
    said: str  # what it is
    contradicted: float | None = None  # share where the outlines are off; None: by its rims
    strength: float | None = None  # these as in SurfaceFit
    sharp: float | None = None
    unseen: float | None = None
    feet: int | None = None
    held: int | None = None


def find_surface(hull: HullResult, masks: MaskSet, settings: SurfaceSettings, score: Score) -> Surface:
    """The simplest surface that the masks' outlines do not contradict; the hull itself where none costs little enough
    silhouette IoU."""
    views = rim_views(masks.views, hull.hidden)
    before = find_rims(MeshShape.of(hull.mesh), views).spread
    carved = score(hull.mesh).mean
    fit, refused = None, []
    for found in _candidates(hull, views, settings):
        shape = MeshShape.of(found.mesh)
        rims = find_rims(shape, views)
        share = found.contradicted
        if share is None:
            share = contradicted_share(shape, rims, hull.voxel, settings.tolerance)
        cost = settings.iou_cost if found.kind != "planes" else 0.0  # edges alone tell too little of what lies between
        iou = score(found.mesh).mean
        known = (found.strength, found.sharp, found.unseen, found.feet, found.held)
        fit = SurfaceFit(carved, iou, before, rims.spread, share, *known)
        if found.kind != "free" and share > settings.contradicted:
            why = f"outlines contradict it on {100 * share:.0f} % of its area"
            refused.append(f"{found.said}: {why} (mesh.object.surface.contradicted {settings.contradicted:g})")
        elif iou < carved - cost:
            why = f"silhouette IoU {iou:.4f}, {carved:.4f} as carved"
            refused.append(f"{found.said}: {why} (it may cost {cost:g}, mesh.object.surface.iou_cost)")
        else:
            why = "; ".join([f"{found.said}; {_figures(fit)}", *(f"not {text}" for text in refused)])
            return Surface(found.mesh, found.kind, fit, Decision(f"hull smoothed: {found.kind}", why))
    assert fit is not None  # a free surface is always tried
    return Surface(hull.mesh, "", fit, Decision("hull not smoothed", "; ".join(refused)))


def _candidates(hull: HullResult, views: list[RimView], settings: SurfaceSettings) -> Iterator[_Candidate]:
    """What is tried, the simplest first."""
    if settings.fit == "auto":
        ball = fit_ball(hull.mesh, views)
        if ball is not None:
            yield _Candidate(ball.mesh(), "sphere", f"a sphere of radius {ball.radius:.4g}")
        turned = fit_revolution(hull.mesh, hull.voxel, views, settings.foot_degrees)
        if turned is not None:
            said = f"a surface of revolution, its profile smoothed over {turned.length:g} voxels"
            said += "" if turned.straight == 0 else f", straight between edges in {turned.straight} places"
            unseen = 1 - float(turned.seen.mean())
            yield _Candidate(turned.mesh(), "revolution", said, strength=turned.length, unseen=unseen)
        flat = fit_planes(hull.mesh, hull.voxel, views, settings.tolerance)
        if flat is not None:
            said = f"a body of {len(flat.body.normals)} planes"
            yield _Candidate(flat.body.mesh(hull.voxel), "planes", said, flat.contradicted)
    free = fair_surface(hull.mesh, hull.voxel, views, settings)
    said = f"smoothed over {free.strength:.1f} voxels, less at {100 * free.sharp:.0f} % of the vertices, where the "
    said += f"outlines contradict; no outline tells of {100 * free.unseen:.1f} %"
    parts = [(free.feet, "made plane"), (free.held, "held where the hull is")]
    said += "".join(f", {count} part{'s' if count > 1 else ''} {what}" for count, what in parts if count)
    known = (free.strength, free.sharp, free.unseen, free.feet, free.held)
    yield _Candidate(free.mesh, "free", said, None, *known)


def _figures(fit: SurfaceFit) -> str:
    iou = f"silhouette IoU {fit.iou:.4f}, {fit.iou_before:.4f} as carved"
    if fit.outline is None:
        return f"{iou}; no rim of it is near an outline"
    before = "" if fit.outline_before is None else f", {fit.outline_before:.2f} as carved"
    return f"{iou}; outlines {fit.outline:.2f} px off{before}"
