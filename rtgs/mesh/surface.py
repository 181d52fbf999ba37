"""The surface that light is traced with: what explains the masks' outlines most simply.

A sphere, a surface of revolution, a body of planes, or the hull made as smooth as the outlines allow: the first that
they do not contradict. Of several objects each has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtgs.core.decisions import Decision
from rtgs.mesh.ball import fit_ball
from rtgs.mesh.fairing import contradicted_share, fair_surface
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.hull import HullResult
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.pieces import joined, pieces
from rtgs.mesh.polyhedron import fit_planes
from rtgs.mesh.record import AND, CARVED, SurfaceFit
from rtgs.mesh.revolution import fit_revolution
from rtgs.mesh.rims import RimView, find_rims, rim_views
from rtgs.mesh.settings import SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, SilhouetteScore, silhouette
from rtgs.mesh.triangles import TriangleMesh

_OWN, _OTHERS = 5, 4  # pixels around an object's silhouette: within the one an outline may be its own
_MOST_UNSEEN = 0.5  # share of the vertices of one of several objects

Score = Callable[[TriangleMesh], SilhouetteScore]
"""Silhouette IoU of a mesh with the masks."""


@dataclass(frozen=True)
class Surface:
    """What became of the hull."""

    mesh: TriangleMesh
    kind: (
        str  # "sphere", "revolution", "planes", "free", or empty: the hull stays; of several objects joined by ``AND``
    )
    fit: SurfaceFit  # where the hull stays: of the last surface that was refused; of several objects: of all together
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
    silhouette IoU. Where no one form fits all of the hull, each connected piece is an object with a surface of its own.
    """
    views = rim_views(masks.views, hull.hidden, [outline.whole for outline in hull.outlines])
    objects = pieces(hull.mesh)
    whole = _surface_of(hull.mesh, hull.voxel, views, views, settings, score)
    if len(objects) == 1 or whole.kind not in ("free", ""):
        return whole
    return _surfaces_of(objects, hull, views, settings, score)


def _surface_of(
    hull: TriangleMesh,
    voxel: float,
    views: list[RimView],
    around: list[RimView],
    settings: SurfaceSettings,
    score: Score,
) -> Surface:
    """Of one object. ``views`` have those outlines alone that can be its own; a free surface is never far from the hull
    and takes what is near it of all outlines (``around``)."""
    before = find_rims(MeshShape.of(hull), views).spread
    carved = score(hull).mean
    fit, refused = None, []
    for found in _candidates(hull, voxel, views, around, settings):
        shape = MeshShape.of(found.mesh)
        rims = find_rims(shape, views)
        share = found.contradicted
        if share is None:
            share = contradicted_share(shape, rims, voxel, settings.tolerance)
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
    return Surface(hull, "", fit, Decision("hull not smoothed", "; ".join(refused)))


def _surfaces_of(
    objects: Sequence[TriangleMesh], hull: HullResult, views: list[RimView], settings: SurfaceSettings, score: Score
) -> Surface:
    """Of several objects, one after the other, beside what the others have become. They share what a surface may cost.
    Where no outline tells of most of a free surface, that object stays as it was carved."""
    meshes, kinds, said, worst, fit = list(objects), [], [], 0.0, None
    each_settings = replace(settings, iou_cost=settings.iou_cost / len(objects))
    for number, (mesh, own) in enumerate(zip(objects, _own_views(objects, views), strict=True)):

        def together(each: TriangleMesh, number: int = number) -> SilhouetteScore:
            return score(joined([*meshes[:number], each, *meshes[number + 1 :]]))

        found = _surface_of(mesh, hull.voxel, own, views, each_settings, together)
        fit, kind, why = found.fit, found.kind or CARVED, found.decision.why
        unseen = found.fit.unseen or 0.0
        if kind == "free" and unseen > _MOST_UNSEEN:
            kind, why = CARVED, f"no outline tells of {100 * unseen:.0f} %"
        if kind != CARVED:
            meshes[number], worst = found.mesh, max(worst, found.fit.contradicted)
        kinds.append(kind)
        said.append(f"object {number + 1}, {kind}: {why}")
    if set(kinds) == {CARVED}:
        assert fit is not None  # there are objects
        return Surface(hull.mesh, "", fit, Decision("hull not smoothed", "; ".join(said)))
    whole = joined(meshes)
    before, after = (find_rims(MeshShape.of(mesh), views).spread for mesh in (hull.mesh, whole))
    fit = SurfaceFit(score(hull.mesh).mean, score(whole).mean, before, after, worst)
    kind = AND.join(kinds)
    return Surface(whole, kind, fit, Decision(f"hull smoothed: {kind}", "; ".join([*said, _figures(fit)])))


def _own_views(objects: Sequence[TriangleMesh], views: Sequence[RimView]) -> list[list[RimView]]:
    """For each object the views with those outlines alone that can be its own: near its silhouette, and not near
    another one's."""
    from scipy.ndimage import binary_dilation

    guides = [MeshGuide(mesh, 0.0) for mesh in objects]
    own: list[list[RimView]] = [[] for _ in objects]
    for view in views:
        seen = np.stack([silhouette(guide, view.camera) for guide in guides])
        wide = np.stack([binary_dilation(each, iterations=_OTHERS) for each in seen])
        crowd = wide.sum(0)
        for number, views_of_it in enumerate(own):
            near = binary_dilation(seen[number], iterations=_OWN) & (crowd == wide[number])
            views_of_it.append(replace(view, usable=view.usable & near))
    return own


def _candidates(
    hull: TriangleMesh, voxel: float, views: list[RimView], around: list[RimView], settings: SurfaceSettings
) -> Iterator[_Candidate]:
    """What is tried, the simplest first."""
    if settings.fit == "auto":
        ball = fit_ball(hull, views)
        if ball is not None:
            yield _Candidate(ball.mesh(), "sphere", f"a sphere of radius {ball.radius:.4g}")
        turned = fit_revolution(hull, voxel, views, settings.foot_degrees)
        if turned is not None:
            said = f"a surface of revolution, its profile smoothed over {turned.length:g} voxels"
            said += "" if turned.straight == 0 else f", straight between edges in {turned.straight} places"
            unseen = 1 - float(turned.seen.mean())
            yield _Candidate(turned.mesh(), "revolution", said, strength=turned.length, unseen=unseen)
        flat = fit_planes(hull, voxel, views, settings.tolerance)
        if flat is not None:
            said = f"a body of {len(flat.body.normals)} planes"
            yield _Candidate(flat.body.mesh(voxel), "planes", said, flat.contradicted)
    free = fair_surface(hull, voxel, around, settings)
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
