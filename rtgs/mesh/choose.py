"""Which mesh stands for the transparent object: hull, pane, TSDF or a given file, decided by what the training views
show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_unknown
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.hull import HullResult, carve_hull
from rtgs.mesh.outlines import Outline, plain_outlines
from rtgs.mesh.pane import drawn_pane, fit_pane, is_flat
from rtgs.mesh.record import SurfaceFit
from rtgs.mesh.settings import MeshSource, ObjectSettings
from rtgs.mesh.silhouettes import MaskSet, SilhouetteScore, direction_spread, silhouette_scores
from rtgs.mesh.smoothing import volume
from rtgs.mesh.surface import find_surface
from rtgs.mesh.triangles import TriangleMesh, read_mesh_obj, read_mesh_ply
from rtgs.native.threads import serial_torch

_REMEDY = (
    "mask it in more photos, give its mesh (mesh.source=given), or train without the third stage (ablation=two_stages)"
)
_ELSEWHERE = 0.05  # silhouette IoU below which a given mesh is another thing, or in another frame
Fusion = Callable[[np.ndarray | None], tuple[TriangleMesh, float]]
"""From the object's box (2, 3), None: not known, to the TSDF mesh and its voxel."""


@dataclass(frozen=True)
class Choice:
    """The chosen mesh, and what was decided on the way."""

    mesh: ObjectMesh
    iou: SilhouetteScore  # with the masks, where nothing opaque hides the object
    iou_all: SilhouetteScore  # with the masks as they are
    candidates: dict[str, float]  # mean IoU of every mesh that was made
    decisions: tuple[Decision, ...]
    hull: HullResult | None
    fit: SurfaceFit | None = None  # of the chosen mesh: how the hull was smoothed


class _Candidates:
    """Makes the meshes one by one, and scores them alike."""

    def __init__(
        self, masks: MaskSet, settings: ObjectSettings, fuse: Fusion, panes: Sequence[np.ndarray] = ()
    ) -> None:
        self.masks, self.settings, self.fuse, self.panes = masks, settings, fuse, panes
        self.decisions: list[Decision] = []
        self.hull: HullResult | None = None
        self.scores: dict[str, float] = {}
        self.fit: SurfaceFit | None = None
        self._scored: list[tuple[TriangleMesh, tuple[SilhouetteScore, SilhouetteScore]]] = []

    @cached_property
    def outlines(self) -> list[Outline]:
        """Of the masks as they are."""
        return plain_outlines(self.masks.views)

    def score(self, mesh: TriangleMesh) -> SilhouetteScore:
        """Where an opaque thing may hide the object, pixels are left out; only a hull knows where."""
        return self.scores_of(mesh)[0]

    def scores_of(self, mesh: TriangleMesh) -> tuple[SilhouetteScore, SilhouetteScore]:
        """:meth:`score`, and that with all pixels; found once for a mesh."""
        for known, found in self._scored:
            if known is mesh:
                return found
        found = silhouette_scores(mesh, self.masks.views, self.hull.hidden if self.hull else None)
        self._scored.append((mesh, found))
        return found

    def carve(self) -> ObjectMesh:
        """The hull; remembered. Pixels are left out of scores from now on."""
        self.hull = hull = carve_hull(self.masks, self.settings.hull, self.outlines)
        self._scored.clear()
        self.scores["hull"] = self.score(hull.mesh).mean
        if hull.note:
            done = f"hull trimmed to what {hull.trim_views} views see" if hull.trim_views else "hull not trimmed"
            self.decisions.append(Decision(done, hull.note))
        return ObjectMesh(hull.mesh, "hull", hull.voxel, flat=False)

    def smoothed(self, found: ObjectMesh) -> ObjectMesh:
        """The chosen hull with the surface that ``mesh.object.surface`` asks for."""
        assert self.hull is not None
        surface = find_surface(self.hull, self.masks, self.settings.surface, self.score)
        self.decisions.append(surface.decision)
        if surface.kind == "":
            return found
        self.fit, self.scores["surface"] = surface.fit, surface.fit.iou
        return replace(found, mesh=surface.mesh, surface=surface.kind)

    def drawn(self) -> ObjectMesh | None:
        """The panes that somebody drew, where they explain the masks."""
        if not self.panes:
            return None
        try:
            pane = drawn_pane(self.panes, self.masks.views)
        except RtgsError as error:
            self.decisions.append(Decision("drawn panes not taken", str(error)))
            return None
        self.scores["drawn panes"] = score = self.score(pane.mesh).mean
        if score >= self.settings.pane.agree:
            return ObjectMesh(pane.mesh, "given", pane.voxel, flat=True)
        why = (
            f"their silhouette IoU with the masks is {score:.3f} (mesh.object.pane.agree {self.settings.pane.agree:g})"
        )
        self.decisions.append(Decision("drawn panes not taken", why))
        return None

    def pane(self) -> ObjectMesh:
        """The plane on which the masks agree."""
        pane = fit_pane(self.outlines)
        self.scores["pane"] = self.score(pane.mesh).mean
        return ObjectMesh(pane.mesh, "hull", pane.voxel, flat=True)

    def fused(self) -> ObjectMesh:
        """The TSDF mesh inside the hull's box, where there is a hull."""
        box = None
        if self.hull is not None:
            low, high = self.hull.mesh.vertices.min(0), self.hull.mesh.vertices.max(0)
            margin = 0.05 * (high - low).max()
            box = np.stack([low - margin, high + margin]).astype(np.float64)
        mesh, voxel = self.fuse(box)
        self.scores["tsdf"] = self.score(mesh).mean
        return ObjectMesh(mesh, "tsdf", voxel, flat=self._flat(mesh))

    def given(self) -> ObjectMesh:
        """The mesh of the file; a closed one that faces inward is turned.

        Raises:
            RtgsError: no surface, or one that the masks do not show.
        """
        path, mesh = self.settings.given, read_given(self.settings.given)
        side = float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0
        if not mesh.face_normals().any():
            raise RtgsError(f"{path} holds no surface: mesh.object.given needs triangles")
        self.scores["given"] = score = self.score(mesh).mean
        if score < _ELSEWHERE:
            raise RtgsError(
                f"{path} is not where the masks show the object (silhouette IoU {score:.3f}): it must be in the "
                "capture's world frame and of its size"
            )
        found = ObjectMesh(mesh, "given", side / self.settings.hull.voxels, flat=self._flat(mesh))
        if not found.closed or volume(mesh) >= 0:
            return found
        self.decisions.append(Decision("given mesh turned inside out", "its triangles face inward"))
        return replace(found, mesh=replace(mesh, faces=mesh.faces[:, ::-1]))

    def _flat(self, mesh: TriangleMesh) -> bool:
        return is_flat(mesh) if self.settings.flat == "auto" else self.settings.flat == "yes"


def choose_object_mesh(
    source: str, masks: MaskSet, settings: ObjectSettings, fuse: Fusion, panes: Sequence[np.ndarray] = ()
) -> Choice:
    """The mesh of the transparent object.

    Args:
        source: ``hull``, ``tsdf``, ``given``, or ``auto``: a pane where one plane explains the masks, else hull or
            TSDF, whichever silhouette agrees better with the masks of the training views.
        masks: of the training views, with the base set's depth.
        settings: what else can be chosen.
        fuse: makes the TSDF mesh when it is needed.
        panes: flat polygons (K, 3) that the masks were drawn as, in the world; taken instead of a plane that is looked
            for where they explain the masks.

    Raises:
        RtgsError: an unknown name, or no mesh can be made; with what was tried.
    """
    refuse_unknown("mesh.source", source, MeshSource)
    tried = _Candidates(masks, settings, fuse, panes)
    make = {"hull": _hull_or_pane, "auto": _automatic}.get(source, lambda found: getattr(found, _MADE[source])())
    with serial_torch():  # thousands of small operations, which several threads make slower
        try:
            mesh = make(tried)
        except RtgsError as error:
            if source != "hull":
                raise
            raise RtgsError(f"{error}: {_REMEDY}") from error
        if mesh.source == "hull" and not mesh.flat and settings.surface.fit != "carved":
            mesh = tried.smoothed(mesh)
    about = f"{len(masks.views)} masks, {masks.cut} cut by the image border"
    left = [f"{masks.without} views have no mask", f"{masks.empty} masks are empty", f"{masks.full} cover everything"]
    about += "".join(f", {text}" for text, count in zip(left, (masks.without, masks.empty, masks.full)) if count)
    scores = ", ".join(f"{name} {value:.3f}" for name, value in tried.scores.items())
    what = f"object mesh: {'a flat pane' if mesh.flat else mesh.source}"
    tried.decisions.insert(0, Decision(what, f"mesh.source is {source}; silhouette IoU: {scores}; {about}"))
    score, plain = tried.scores_of(mesh.mesh)
    return Choice(mesh, score, plain, tried.scores, tuple(tried.decisions), tried.hull, tried.fit)


_MADE = {"tsdf": "fused", "given": "given"}


def _hull_or_pane(tried: _Candidates) -> ObjectMesh:
    """A pane where the masks are those of a pane, else the hull."""
    flat, masks, pane = tried.settings.flat, tried.masks, tried.settings.pane
    if flat != "no" and (drawn := tried.drawn()) is not None:
        return drawn
    if flat == "yes":
        return tried.pane()
    spread = direction_spread(masks.views)
    try:
        hull = tried.carve()
    except RtgsError as error:
        if flat == "no":
            raise
        tried.decisions.append(Decision("no hull", str(error)))
        hull = None
    if flat == "no" and hull is not None:
        return hull
    if len(masks.views) >= pane.min_views and spread >= pane.min_spread:
        found = tried.pane()
        needed = max(pane.agree, tried.scores["hull"] - pane.better if hull is not None and not _thin(tried) else 0.0)
        if tried.scores["pane"] >= needed:
            return found
    if hull is None:
        raise RtgsError(f"neither a hull nor a pane explains the masks: {tried.decisions[-1].why}")
    return hull


def _thin(tried: _Candidates) -> bool:
    """The hull cannot tell flat from deep: too few directions."""
    return direction_spread(tried.masks.views) < tried.settings.hull.min_spread


def _automatic(tried: _Candidates) -> ObjectMesh:
    hull, masks = tried.settings.hull, tried.masks
    spread = direction_spread(masks.views)
    trusted = len(masks.views) >= hull.min_views and spread >= hull.min_spread
    first: ObjectMesh | None = None
    try:
        first = _hull_or_pane(tried)
    except RtgsError as error:
        tried.decisions.append(Decision("no hull", str(error)))
    if first is not None and first.flat:
        return first
    if first is not None and not trusted:
        why = f"{len(masks.views)} masks (mesh.object.hull.min_views {hull.min_views}) from directions {spread:.0f} "
        why += f"degrees apart at most (min_spread {hull.min_spread:g})"
        tried.decisions.append(Decision("hull not chosen", why))
    elif first is not None and tried.scores["hull"] >= tried.settings.accept:
        return first
    try:
        fused = tried.fused()
        if (score := tried.scores["tsdf"]) < (least := tried.settings.tsdf_accept):
            raise RtgsError(f"its silhouette IoU with the masks is {score:.3f} (mesh.object.tsdf_accept {least:g})")
    except RtgsError as error:
        tried.decisions.append(Decision("no TSDF mesh", str(error)))
        if first is None:
            last = {decision.what: decision for decision in tried.decisions}  # of each kind
            reasons = "; ".join(map(str, last.values()))
            raise RtgsError(f"no mesh of the transparent object can be made ({reasons}): {_REMEDY}") from error
        return first
    better = first is None or not trusted or score > tried.scores["hull"]
    return fused if better or first is None else first


def read_given(path: str) -> TriangleMesh:
    """A triangle mesh from a PLY or OBJ file.

    Raises:
        RtgsError: no path, no such file, another format, or unreadable.
    """
    file = Path(path)
    if not path or not file.is_file():
        raise RtgsError(f"mesh.source=given needs mesh.object.given, a PLY or OBJ file; {path!r} is none")
    readers = {".ply": read_mesh_ply, ".obj": read_mesh_obj}
    if file.suffix.lower() not in readers:
        raise RtgsError(f"mesh.object.given is {path}: only .ply and .obj are read")
    return readers[file.suffix.lower()](file)
