"""How the transparent object's mesh is found: one schema of everything that can be chosen.

Without torch: a plan is made from the cache alone, and reading the schema is part of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS
from rtgs.core.refuse import refuse_bad_numbers, refuse_unknown_words, refuse_unless

MeshSource = Literal["auto", "hull", "tsdf", "given"]
COVERED = 0.999  # share of the picture from which on a mask says that everything is the object
AUTOMATIC = -1  # of HullSettings.outvoted


@dataclass(frozen=True)
class TsdfSettings:
    """Numbers of the fusion. Lengths in world units; 0 means derived, as its comment says."""

    depth_trunc: float = 0.0  # depths beyond it are ignored; 0: depth_trunc_radii * radius of the cameras
    depth_trunc_radii: float = 2.0  # 2DGS bounded mode
    voxel: float = 0.0  # 0: depth_trunc / resolution
    resolution: int = 1024  # 2DGS
    finest_pixels: float = 1.0  # a derived voxel is no finer than this many pixels seen from the radius; 0: as 2DGS
    truncation_voxels: float = 5.0  # 2DGS
    min_alpha: float = 0.5  # depths of pixels with less alpha are ignored (2DGS, its mask rule)
    min_weight: float = 1.0  # observations a voxel needs to carry surface; 2DGS takes any
    keep_clusters: int = 50  # largest connected pieces that stay (2DGS); 0: all
    min_triangles: int = 50  # pieces with fewer go in any case (2DGS)
    max_blocks: int = 400_000  # of 8^3 voxels, 8 GB at the end; beyond it the fusion stops with an error

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "mesh.tsdf")
        for name in ("depth_trunc_radii", "truncation_voxels"):
            refuse_unless(getattr(self, name) > 0, f"mesh.tsdf.{name}", getattr(self, name), "above 0")
        refuse_unless(self.min_alpha <= 1, "mesh.tsdf.min_alpha", self.min_alpha, "between 0 and 1")
        for name, least in {"resolution": 2, "keep_clusters": 0, "min_triangles": 0, "max_blocks": 1}.items():
            _at_least(least, f"mesh.tsdf.{name}", getattr(self, name))


@dataclass(frozen=True)
class HullSettings:
    """Numbers of the carving; measured in docs/lab/mesh.md."""

    voxels: int = 96  # along the longest side of the object
    outvoted: int = AUTOMATIC  # k: masks that may be wrong about a point; -1: what agrees best with most masks
    tie: float = 0.004  # a larger k must raise the median silhouette IoU by more than this
    explained: float = 0.98  # median IoU from which on nothing opaque is thought to hide parts of the object
    min_seen: float = 0.4  # share of the views that must have a point in the picture for it to belong to the object
    smoothing: int = 10  # iterations of Taubin's filter
    trim: bool = True  # cut off what the base set's depth shows to lie behind other surfaces (the unseen bottom)
    trim_views: int = 8  # views in front of whose depth a point must lie to stay, at first
    trim_cost: float = 0.003  # silhouette IoU that the cut may cost; else half the views must agree, and so on
    trim_margin: float = 0.5  # voxels that it may lie behind it
    min_piece: float = 0.05  # pieces with a smaller share of the largest one's volume go
    min_views: int = 12  # masks; with fewer the hull is not chosen by mesh.source = auto
    min_spread: float = 60.0  # degrees between the two farthest views; with less the hull is not chosen either

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "mesh.object.hull")
        for name in ("tie", "explained", "min_seen", "trim_cost", "min_piece"):
            value = getattr(self, name)
            refuse_unless(value <= 1, f"mesh.object.hull.{name}", value, "between 0 and 1")
        least = {"voxels": 8, "outvoted": AUTOMATIC, "smoothing": 0, "trim_views": 1, "min_views": 3}
        for name, smallest in least.items():
            _at_least(smallest, f"mesh.object.hull.{name}", getattr(self, name))


@dataclass(frozen=True)
class PaneSettings:
    """When one plane counts as an explanation of the masks."""

    agree: float = 0.9  # silhouette IoU over the training views a pane needs
    better: float = 0.02  # IoU by which a hull, where there can be one, must beat it
    min_views: int = 3
    min_spread: float = 10.0  # degrees between the two farthest views: below, every plane explains them

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "mesh.object.pane")
        refuse_unless(self.agree <= 1, "mesh.object.pane.agree", self.agree, "between 0 and 1")
        _at_least(1, "mesh.object.pane.min_views", self.min_views)


@dataclass(frozen=True)
class SurfaceSettings:
    """How the hull is smoothed; light is mirrored in its normals (decision 62)."""

    fit: Literal["carved", "free", "auto"] = "auto"
    """``free``: as smooth as the masks' outlines allow; ``auto``: a sphere, a surface of revolution or a body of planes
    where they do not contradict it, else free."""
    weakest: float = 1.5  # voxels that the smoothing begins with
    strongest: float = 6.0  # and that it ends with where nothing contradicts
    tolerance: float = 0.1  # pixels that the outlines may be off around a vertex, on the mean
    iou_cost: float = 0.003  # silhouette IoU that the smoothed surface may lose against the hull
    fill: float = 3.0  # voxels that an unseen part may leave the hull
    contradicted: float = 0.15  # share of its seen area where the outlines may contradict a fitted form
    foot_degrees: float = 30.0  # between an unseen part's plane border and the wall: from here on the part is plane

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "mesh.object.surface")
        refuse_unknown_words(self, "mesh.object.surface")
        for name, least in {"weakest": 1.0, "strongest": self.weakest}.items():
            value = getattr(self, name)
            refuse_unless(value >= least, f"mesh.object.surface.{name}", value, f"at least {least:g}")
        for name, most in {"iou_cost": 1.0, "contradicted": 1.0, "foot_degrees": 90.0}.items():
            value = getattr(self, name)
            refuse_unless(value <= most, f"mesh.object.surface.{name}", value, f"between 0 and {most:g}")


@dataclass(frozen=True)
class ObjectSettings:
    """The mesh of the transparent object (method.md 6.3; docs/mesh.md)."""

    given: str = ""
    """Path of a PLY or OBJ file in the capture's world frame, for ``mesh.source=given``."""
    given_sha256: str = ""
    """Of that file; set when the run is planned, so that another file makes the step run again."""
    flat: Literal["auto", "yes", "no"] = "auto"
    """A pane of glass: one wall, nothing inside. ``yes``, ``no``, or ``auto``: whether one plane explains the masks."""
    accept: float = 0.95
    """Silhouette IoU from which on ``auto`` takes the hull without making a TSDF mesh to compare it with."""
    tsdf_accept: float = 0.5
    """Silhouette IoU below which ``auto`` takes no TSDF mesh: better a hull of too few masks, or an error."""
    tsdf_resolution: int = 256
    """Voxels along the object's longest side for the TSDF mesh; no finer than ``mesh.tsdf.finest_pixels``."""
    tsdf_pieces: int = 5
    """Largest connected pieces of the TSDF mesh that stay."""
    hull: HullSettings = field(default_factory=HullSettings)
    pane: PaneSettings = field(default_factory=PaneSettings)
    surface: SurfaceSettings = field(
        default=SurfaceSettings(), metadata={"recipe": UNLESS, "value": SurfaceSettings(fit="carved")}
    )

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "mesh.object")
        refuse_unknown_words(self, "mesh.object")
        for name in ("accept", "tsdf_accept"):
            value = getattr(self, name)
            refuse_unless(value <= 1, f"mesh.object.{name}", value, "between 0 and 1")
        _at_least(2, "mesh.object.tsdf_resolution", self.tsdf_resolution)
        _at_least(1, "mesh.object.tsdf_pieces", self.tsdf_pieces)


def _at_least(least: int, key: str, value: int) -> None:
    refuse_unless(value >= least, key, value, f"at least {least}")
