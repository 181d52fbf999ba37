"""How the transparent object's mesh is found: one schema of everything that can be chosen."""

from __future__ import annotations

from dataclasses import dataclass, field

from rtgs.mesh.hull import HullSettings
from rtgs.mesh.pane import PaneSettings

SOURCES = ("auto", "hull", "tsdf", "given")
FLAT = ("auto", "yes", "no")


@dataclass(frozen=True)
class ObjectSettings:
    """The mesh of the transparent object (methods.md 6.3; docs/mesh.md)."""

    given: str = ""
    """Path of a PLY or OBJ file in the capture's world frame, for ``mesh.source=given``."""
    given_sha256: str = ""
    """Of that file; set when the run is planned, so that another file makes the step run again."""
    flat: str = "auto"
    """A pane of glass: one wall, nothing inside. ``yes``, ``no``, or ``auto``: whether one plane explains the masks."""
    accept: float = 0.95
    """Silhouette IoU from which on ``auto`` takes the hull without making a TSDF mesh to compare it with."""
    tsdf_resolution: int = 256
    """Voxels along the object's longest side for the TSDF mesh; no finer than ``mesh.tsdf.finest_pixels``."""
    tsdf_pieces: int = 5
    """Largest connected pieces of the TSDF mesh that stay."""
    hull: HullSettings = field(default_factory=HullSettings)
    pane: PaneSettings = field(default_factory=PaneSettings)
