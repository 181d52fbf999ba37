"""``mesh.json``: what is known of the mesh beside it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rtgs.core.decisions import Decision
from rtgs.core.records import damaged, read_json, record_of, write_json

RECORD_FILE = "mesh.json"
AND = "+"
"""Between the kinds of several objects' surfaces, in the order of their faces."""
CARVED = "carved"
"""Kind of an object, of several, whose surface is as its hull was carved."""


@dataclass(frozen=True)
class MeshTruth:
    """The object's mesh against the true container of a described scene. NaN: no pixel to judge.

    Attributes:
        distance: of the two surfaces to each other, mean of both ways, world units.
        distance_to_truth: mean from the mesh to the container.
        distance_from_truth: mean from the container to the mesh.
        front_within_3_percent: share of first surfaces within 3 % of the true one, over the test views.
        back_within_3_percent: of second surfaces.
        normal_degrees_median: angle between first surfaces' normals.
    """

    distance: float
    distance_to_truth: float
    distance_from_truth: float
    front_within_3_percent: float
    back_within_3_percent: float
    normal_degrees_median: float


@dataclass(frozen=True)
class SurfaceFit:
    """A smoothed hull beside the hull.

    Attributes:
        iou_before, iou: silhouette IoU of the hull and of the surface with the masks, where nothing hides the object.
        outline_before, outline: pixels between their outlines and those of the masks, root mean square; None:
            the surface has no rim near an outline.
        contradicted: share of the surface's seen area where the outlines are off by more than their noise; of several
            objects that of the worst, and nothing of what follows.
        strength: of smoothing: voxels, median over the vertices.
        sharp: of a free surface: share of the vertices at which the outlines asked for less smoothing: edges.
        unseen: share of the vertices that no outline tells of.
        feet: of a free surface: unseen parts that were made plane.
        held: of a free surface: unseen parts that stay as the hull has them.
    """

    iou_before: float
    iou: float
    outline_before: float | None
    outline: float | None
    contradicted: float
    strength: float | None = None
    sharp: float | None = None
    unseen: float | None = None
    feet: int | None = None
    held: int | None = None


@dataclass(frozen=True)
class MeshRecord:
    """One mesh, or why there is none. None: not known, or not of this kind of mesh; such a key is not written.

    Attributes:
        absent: why there is no mesh of a transparent object; then nothing else is known but ``decisions``.
        note: one line for the report.
        silhouette_iou: of the object's mesh with the masks, where nothing opaque hides the object; mean over views.
        silhouette_iou_lowest: of the worst view, whose name is ``silhouette_iou_lowest_view``.
        silhouette_iou_all_pixels: with the masks as they are.
        candidates: mean IoU of every mesh that was made.
        masks_outvoted: of the hull: pixels of masks that other views outvoted.
        trimmed: of the hull: share that fewer than ``trim_views`` views see.
        picture_from: view that ``mesh.png`` is seen from.
        depth_trunc: of a fusion: depths beyond it are left out, world units.
        pieces_found, pieces_kept: of a fusion: connected pieces.
        truth: the object's mesh against the truth.
        source: how the object's mesh was found: ``hull``, ``tsdf``, ``given``; None: a mesh of the scene.
        voxel: side of the grid's cells, world units.
        flat: the object is a pane.
        surface: how the hull was smoothed: ``free``, ``sphere``, ``revolution``, ``planes``; of several objects these
            in the order of the faces, joined by ``+``, also ``carved``; None: it was not.
        surface_fit: figures of that.
    """

    absent: str | None = None
    note: str | None = None
    silhouette_iou: float | None = None
    silhouette_iou_lowest: float | None = None
    silhouette_iou_lowest_view: str | None = None
    silhouette_iou_all_pixels: float | None = None
    candidates: dict[str, float] | None = None
    decisions: tuple[Decision, ...] = ()
    masks_outvoted: int | None = None
    trimmed: float | None = None
    trim_views: int | None = None
    picture_from: str | None = None
    depth_trunc: float | None = None
    pieces_found: int | None = None
    pieces_kept: int | None = None
    truth: MeshTruth | None = None
    source: str | None = None
    voxel: float | None = None
    flat: bool | None = None
    surface: str | None = None
    surface_fit: SurfaceFit | None = None
    vertices: int | None = None
    faces: int | None = None

    def write(self, folder: Path) -> None:
        """Write ``folder/mesh.json``."""
        values: dict[str, Any] = {key: value for key, value in asdict(self).items() if value is not None}
        values["decisions"] = [[decision.what, decision.why] for decision in self.decisions]
        if not self.decisions:
            del values["decisions"]
        write_json(folder / RECORD_FILE, values)

    @staticmethod
    def read(folder: Path) -> MeshRecord:
        """Read ``folder/mesh.json``.

        Raises:
            RtgsError: it is missing or damaged.
        """
        path = folder / RECORD_FILE
        values = read_json(path)
        try:
            values["decisions"] = [{"what": what, "why": why} for what, why in values.get("decisions", ())]
        except (TypeError, ValueError) as error:
            raise damaged(path, f"decisions: {error}") from error
        values["truth"] = values.get("truth") or None  # {}: of a scene without truth, as older versions wrote it
        return record_of(MeshRecord, values, path)
