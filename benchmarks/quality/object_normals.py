"""Normals of the transparent object's mesh against the truth, as carved and smoothed.

``python -m benchmarks.quality.object_normals [SCENE ...] [--long-side N] [--depth exact|none] [--fits FIT ...]``

For each shipped scene with a true container: the hull of its training masks, then what every asked
``mesh.object.surface.fit`` makes of it. Degrees between its normals and the true ones, median and 90th percentile over
the visible glass of the test views: front, the first surface; back, the second one where nothing opaque hides it. IoU
with the training masks, CPU seconds of carving and of fitting (one thread), and what was chosen. Of ``popcorn_cup``,
which is open, the hull's lid counts too.

``--depth exact`` trims the hull by the true depth of everything opaque, which a trained base set has only about;
``none``: masks only, nothing is trimmed and a label is a hole. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, replace

import torch

from benchmarks.quality.mesh import opaque_depths
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.hull import HullResult, carve_hull
from rtgs.mesh.score import NormalScore, container_mesh, normal_score
from rtgs.mesh.settings import HullSettings, SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, SilhouetteScore, mask_set, silhouette_score
from rtgs.mesh.surface import find_surface
from rtgs.mesh.triangles import TriangleMesh
from rtgs.scenes.importers.embedded import embedded_capture, embedded_names
from rtgs.scenes.scene import Scene, load_scene
from rtgs.scenes.settings import SceneSettings

SCENES = ("ball_statue", "tall_bottle", "real_bottle", "popcorn_cup", "thick_ball")
FITS = ("carved", "free", "auto")
HEADER = "| scene | fit | front | back | IoU | s | chosen |"


@dataclass(frozen=True)
class Row:
    """One mesh of one scene."""

    scene: str
    fit: str  # mesh.object.surface.fit
    normals: NormalScore
    iou: float
    seconds: float  # CPU: of carving, or of fitting
    chosen: str  # what the decision says

    def line(self) -> str:
        """Of the table."""
        found = self.normals
        angles = f"{found.front:.2f} / {found.front_90:.1f} | {found.back:.2f} / {found.back_90:.1f}"
        return f"| {self.scene} | {self.fit} | {angles} | {self.iou:.4f} | {self.seconds:.1f} | {self.chosen} |"


def measure(name: str, scene: Scene, fits: tuple[str, ...], exact: bool, settings: HullSettings) -> list[Row]:
    """The hull of a scene's masks, and what each fit makes of it."""
    cameras = [view.camera for view in scene.train]
    depths = opaque_depths(name, cameras) if exact else None
    masks = mask_set(cameras, [view.mask for view in scene.train], depths)
    start = time.process_time()
    hull = carve_hull(masks, settings)
    carved = time.process_time() - start
    truth = container_mesh(name)
    assert truth is not None, f"{name} has no true container"
    seen = [view for view in scene.test if view.mask is not None]
    views = [view.camera for view in seen]
    glass, opaque = [view.mask for view in seen if view.mask is not None], opaque_depths(name, views)
    rows = []
    for fit in fits:
        mesh, chosen, seconds = _fitted(hull, masks, fit)
        found = normal_score(mesh, truth, views, glass, opaque)
        iou = silhouette_score(mesh.mesh, masks.views, hull.hidden).mean
        rows.append(Row(name, fit, found, iou, seconds if fit != "carved" else carved, chosen))
    return rows


def _fitted(hull: HullResult, masks: MaskSet, fit: str) -> tuple[ObjectMesh, str, float]:
    """The object's mesh, what was decided, and CPU seconds of the fit."""
    carved = ObjectMesh(hull.mesh, "hull", hull.voxel, flat=False)
    if fit == "carved":
        return carved, f"hull, k = {hull.outvoted}", 0.0

    def score(mesh: TriangleMesh) -> SilhouetteScore:
        return silhouette_score(mesh, masks.views, hull.hidden)

    start = time.process_time()
    surface = find_surface(hull, masks, SurfaceSettings(fit=fit), score)  # type: ignore[arg-type]
    seconds = time.process_time() - start
    return replace(carved, mesh=surface.mesh, surface=surface.kind), str(surface.decision), seconds


def main() -> None:
    """Print the table, then a JSON object of all rows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.object_normals", description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)}; none: all of them")
    parser.add_argument("--long-side", type=int, default=None, help="pixels of the pictures; default: as shipped")
    parser.add_argument("--depth", choices=("exact", "none"), default="exact")
    parser.add_argument("--fits", nargs="+", choices=FITS, default=FITS)
    parser.add_argument("--voxels", type=int, default=HullSettings().voxels, help="of the hull")
    words = parser.parse_args()
    if unknown := sorted(set(words.scenes) - set(embedded_names())):
        parser.error(f"no shipped scene is called {', '.join(unknown)}; there are {', '.join(SCENES)}")
    torch.set_num_threads(1)
    print(f"{HEADER}\n{'|---' * (HEADER.count('|') - 1)}|")
    rows: list[Row] = []
    for name in words.scenes or SCENES:
        scene = load_scene(SceneSettings(name=name, path=str(embedded_capture(name)), long_side=words.long_side))
        found = measure(name, scene, tuple(words.fits), words.depth == "exact", HullSettings(voxels=words.voxels))
        print("\n".join(row.line() for row in found), flush=True)
        rows += found
    print(json.dumps({"long_side": words.long_side, "depth": words.depth, "rows": [asdict(row) for row in rows]}))


if __name__ == "__main__":
    main()
