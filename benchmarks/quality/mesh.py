"""Meshes of the stand-ins' containers against the true ones: `python -m benchmarks.quality.mesh [scene or folder ...]`.

The hull is carved from the captures' own masks and the exact depth of everything opaque (what a perfect base set would
have); the TSDF mesh is fused from the exact depth of the *container*, which no base set reaches (docs/mesh.md). Scenes
are shipped captures, by name (default: ball_statue). Times are CPU seconds of one process.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.hull import carve_hull
from rtgs.mesh.score import container_mesh, hit_score, mesh_distance
from rtgs.mesh.settings import HullSettings, TsdfSettings
from rtgs.mesh.silhouettes import mask_set, silhouette_score
from rtgs.mesh.triangles import TriangleMesh
from rtgs.mesh.tsdf import DepthView, fuse_depths, import_open3d, object_fusion
from rtgs.scenes.importers.embedded import embedded_capture, embedded_names
from rtgs.scenes.scene import Scene, load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.synthetic.description import TRANSPARENT, named_scene
from rtgs.scenes.synthetic.geometry import build, merge

HEADER = "| scene | mesh | voxel | IoU | IoU, all pixels | distance / size | front | back | normal | CPU s |"


def opaque_depths(name: str, cameras: list[Camera]) -> list[torch.Tensor]:
    """Depth of the first opaque surface in every view."""
    meshes = [build(shape) for shape in named_scene(name).shapes if shape.material.kind not in TRANSPARENT]
    solid = merge(meshes)
    guide = MeshGuide(TriangleMesh(solid.vertices, solid.faces), 0.0)
    return [guide.nearest(camera) for camera in cameras]


def measure(name: str, scene: Scene) -> list[str]:
    """Rows of the table for one capture."""
    truth = container_mesh(name)
    assert truth is not None
    cameras = [view.camera for view in scene.train]
    masks = mask_set(cameras, [view.mask for view in scene.train], opaque_depths(name, cameras))
    start = time.process_time()
    hull = carve_hull(masks, HullSettings())
    seconds = time.process_time() - start
    rows = []

    def row(source: str, kind: str, mesh: TriangleMesh, voxel: float, seconds: float) -> None:
        hits = hit_score(ObjectMesh(mesh, source, voxel, False), truth, [view.camera for view in scene.test])
        distance = mesh_distance(mesh, truth)
        iou = silhouette_score(mesh, masks.views, hull.hidden).mean
        plain = silhouette_score(mesh, masks.views).mean
        rows.append(
            f"| {name} | {kind} | {voxel:.4f} | {iou:.3f} | {plain:.3f} | {distance.mean / distance.size:.4f} | "
            f"{hits.front:.3f} | {hits.back:.3f} | {hits.normal_mean:.1f} / {hits.normal_median:.1f} | {seconds:.1f} |"
        )

    row("hull", f"hull, k = {hull.outvoted}", hull.mesh, hull.voxel, seconds)
    guide = MeshGuide(truth, 0.0)
    box = np.stack([truth.vertices.min(0), truth.vertices.max(0)]).astype(np.float64)
    box += np.array([[-0.05], [0.05]]) * (box[1] - box[0]).max()
    settings, crop = object_fusion(TsdfSettings(), 256, 5, cameras, box)
    views = [
        crop(DepthView(camera, guide.nearest(camera), mask=view.mask)) for camera, view in zip(cameras, scene.train)
    ]
    start = time.process_time()
    fused = fuse_depths(views, cameras, settings)
    row("tsdf", "TSDF of the true depth", fused.mesh, fused.voxel, time.process_time() - start)
    return rows


def main() -> None:
    """Print the table and what Open3D costs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["ball_statue"], help="names or folders")
    words = parser.parse_args().scenes
    folders = [embedded_capture(word) if word in embedded_names() else Path(word) for word in words]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    import_open3d()
    seconds = time.process_time() - start
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"import of Open3D: {seconds:.1f} CPU s, {(after - before) / 1024:.0f} MB")
    print(HEADER)
    print("|---" * 10 + "|")
    for folder in folders:
        scene = load_scene(SceneSettings(name=folder.name, path=str(folder)))
        print("\n".join(measure(folder.name, scene)), flush=True)


if __name__ == "__main__":
    main()
