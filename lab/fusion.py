"""Ways to fuse depths into a mesh, side by side: `python -m lab.fusion [--scene ball_statue]`.

Depths of the true container at the training views, inside the masks, as they are and with noise (each pixel 0.5 % of
its depth, a smooth field over the picture another 0.5 % at its nodes, a third less in between, one pixel in fifty off
by up to 5 %). All ways get the same voxel, truncation (5 voxels) and views, and lose the same small pieces
(`rtgs.mesh.tsdf.largest_pieces`). Each is a process of its own on one thread: CPU seconds, its peak memory, and what
importing its library adds. Distances, in diagonals of the container: mean and 95th percentile, mesh to truth and truth
to mesh; front: share of the test views' pixels whose first surface lies within 3 % of the true one. Last line: a JSON
object.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.machine import machine
from rtgs.core.cameras import Camera
from rtgs.mesh.settings import TsdfSettings
from rtgs.mesh.triangles import TriangleMesh
from rtgs.mesh.tsdf import (
    BLOCK,
    DepthView,
    blocks_near_surface,
    fuse_depths,
    import_open3d,
    largest_pieces,
    object_fusion,
    unpacked,
    usable_depth,
)

HEADER = "| fusion | depths | mesh to truth | 95 % | truth to mesh | 95 % | front | triangles | CPU s | peak MB | import CPU s | import MB |"  # noqa: E501
PIXEL_NOISE, SMOOTH_NOISE, OUTLIERS, OUTLIER = 0.005, 0.005, 0.02, 0.05  # of the depth; share; of the depth


@dataclass(frozen=True)
class Spent:
    """What one process took."""

    cpu_seconds: float  # of the fusion, mesh extraction included
    peak_mb: float
    import_seconds: float  # CPU, of the library
    import_mb: float


def block_grid(views: Sequence[DepthView], cameras: Sequence[Camera], settings: TsdfSettings) -> TriangleMesh:
    """What `extract_mesh` does: Open3D's VoxelBlockGrid with blocks chosen from every pixel."""
    return fuse_depths(views, cameras, settings).mesh


def uniform_volume(views: Sequence[DepthView], cameras: Sequence[Camera], settings: TsdfSettings) -> TriangleMesh:
    """Open3D's older, dense UniformTSDFVolume; its pixel centres lie at integers.

    (Its sparse sister, ScalableTSDFVolume, finds no surface in Open3D 0.20: it takes metres for millimetres.)
    """
    open3d = import_open3d()
    tools = open3d.pipelines.integration
    depths = [usable_depth(view, np.inf, settings.min_alpha) for view in views]
    side = BLOCK * settings.voxel
    blocks = _blocks(views, depths, settings)
    low, high = blocks.min(0) * side, (blocks.max(0) + 1) * side
    count = round(float((high - low).max()) / settings.voxel)
    truncation, plain = settings.truncation_voxels * settings.voxel, tools.TSDFVolumeColorType.RGB8
    volume = tools.UniformTSDFVolume(count * settings.voxel, count, truncation, plain, origin=low)
    for view, depth in zip(views, depths, strict=True):
        camera = view.camera
        blank = open3d.geometry.Image(np.zeros((*depth.shape, 3), np.uint8))
        pair = open3d.geometry.RGBDImage.create_from_color_and_depth(
            blank, open3d.geometry.Image(depth), 1.0, 1e6, convert_rgb_to_intensity=False
        )
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation.numpy(), camera.translation.numpy()
        volume.integrate(pair, open3d.camera.PinholeCameraIntrinsic(*lens), pose)
    found = volume.extract_triangle_mesh()
    return TriangleMesh(np.asarray(found.vertices, np.float32), np.asarray(found.triangles, np.int32))


def _blocks(views: Sequence[DepthView], depths: Sequence[np.ndarray], settings: TsdfSettings) -> np.ndarray:
    """(B, 3) int64 blocks of voxels near a surface of any view."""
    seen = [
        blocks_near_surface(view.camera, depth, settings.voxel, settings.truncation_voxels)
        for view, depth in zip(views, depths, strict=True)
    ]
    return unpacked(np.unique(np.concatenate(seen))).astype(np.int64)


def plain_volume(views: Sequence[DepthView], cameras: Sequence[Camera], settings: TsdfSettings) -> TriangleMesh:
    """The same average of truncated distances in NumPy, in the blocks near a surface; scikit-image's marching cubes."""
    from skimage.measure import marching_cubes

    voxel, truncation = settings.voxel, settings.truncation_voxels * settings.voxel
    depths = [usable_depth(view, np.inf, settings.min_alpha) for view in views]
    blocks = _blocks(views, depths, settings)
    inside = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = (blocks[:, None] * BLOCK + inside).reshape(-1, 3)
    points = index.astype(np.float32) * np.float32(voxel)
    total, weight = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for view, depth in zip(views, depths, strict=True):
        camera = view.camera
        local = points @ camera.rotation.numpy().T.astype(np.float32) + camera.translation.numpy().astype(np.float32)
        z = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = camera.fx * local[:, 0] / z + camera.cx
            y = camera.fy * local[:, 1] / z + camera.cy
        rows = np.flatnonzero((z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
        surface = depth[y[rows].astype(np.int64), x[rows].astype(np.int64)]
        distance = surface - z[rows]
        kept = (surface > 0) & (distance > -truncation)
        rows = rows[kept]
        total[rows] += np.minimum(distance[kept] / truncation, 1)
        weight[rows] += 1
    low = index.min(0)
    shape = tuple(index.max(0) - low + 1)
    field, known = np.ones(shape, np.float32), np.zeros(shape, bool)
    place = tuple((index - low).T)
    field[place], known[place] = total / np.maximum(weight, 1), weight >= settings.min_weight
    for axis in range(3):  # a cube of eight voxels counts where all of them are known; the mask names its last corner
        ahead = np.moveaxis(known, axis, 0)
        ahead[1:] &= ahead[:-1].copy()
        ahead[0] = False
    vertices, faces, _, _ = marching_cubes(field, 0.0, mask=known)
    return TriangleMesh(((vertices + low) * voxel).astype(np.float32), faces.astype(np.int32))


WAYS: dict[str, tuple[str, str, str, Callable[..., TriangleMesh]]] = {
    "block_grid": ("Open3D VoxelBlockGrid (ours)", "open3d", "t", block_grid),
    "uniform": ("Open3D UniformTSDFVolume", "open3d", "pipelines", uniform_volume),
    "plain": ("NumPy and scikit-image", "skimage.measure", "marching_cubes", plain_volume),
}
"""By key: name, module and what is used of it (some load only then), the fusion."""


def noisy(depth: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """(H, W) depth as a trained set would have it, roughly; 0 stays 0."""
    smooth = torch.nn.functional.interpolate(
        torch.randn(1, 1, 8, 8, generator=generator), depth.shape, mode="bilinear", align_corners=True
    )[0, 0]
    relative = PIXEL_NOISE * torch.randn(depth.shape, generator=generator) + SMOOTH_NOISE * smooth
    wrong = torch.rand(depth.shape, generator=generator) < OUTLIERS
    relative = torch.where(wrong, OUTLIER * (2 * torch.rand(depth.shape, generator=generator) - 1), relative)
    return depth * (1 + relative)


def one(way: str, source: Path, out: Path) -> Spent:
    """In a process of its own: read the views, fuse, write vertices and faces."""
    import importlib

    torch.set_num_threads(1)
    before, start = _memory("VmRSS"), time.process_time()
    _, module, used, fuse = WAYS[way]
    getattr(importlib.import_module(module), used)
    imported = time.process_time() - start
    after = _memory("VmRSS")
    views, settings = torch.load(source, weights_only=False)
    start = time.process_time()
    whole = fuse(views, [view.camera for view in views], settings)
    mesh, _, _ = largest_pieces(whole, settings.keep_clusters, settings.min_triangles)
    spent = time.process_time() - start
    np.savez(out, vertices=mesh.vertices, faces=mesh.faces)
    return Spent(spent, _memory("VmHWM"), imported, after - before)


def _memory(key: str) -> float:
    """MB that Linux states for this process (``getrusage`` starts with the peak of the parent)."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))


def measure(name: str, ways: Sequence[str], folder: Path, long_side: int | None) -> list[dict[str, object]]:
    """Make the depths, run every way on them, score the meshes; prints the rows."""
    from rtgs.mesh.container import ObjectMesh
    from rtgs.mesh.guide import MeshGuide
    from rtgs.mesh.score import container_mesh, hit_score, mesh_distance
    from rtgs.scenes.importers.embedded import embedded_capture
    from rtgs.scenes.scene import load_scene
    from rtgs.scenes.settings import SceneSettings

    scene = load_scene(SceneSettings(name=name, path=str(embedded_capture(name)), long_side=long_side))
    truth = container_mesh(name)
    assert truth is not None
    guide, cameras = MeshGuide(truth, 0.0), [view.camera for view in scene.train]
    box = np.stack([truth.vertices.min(0), truth.vertices.max(0)]).astype(np.float64)
    box += np.array([[-0.05], [0.05]]) * (box[1] - box[0]).max()
    settings, crop = object_fusion(TsdfSettings(), 256, 5, cameras, box)
    exact = [crop(DepthView(view.camera, guide.nearest(view.camera), mask=view.mask)) for view in scene.train]
    generator = torch.Generator().manual_seed(0)
    sets = {"exact": exact, "noisy": [DepthView(v.camera, noisy(v.depth, generator), mask=v.mask) for v in exact]}
    figures = []
    for kind, views in sets.items():
        torch.save((views, settings), folder / "views.pt")
        for way in ways:
            words = ["--one", way, str(folder / "views.pt"), str(folder / "mesh.npz")]
            done = subprocess.run(
                [sys.executable, "-m", "lab.fusion", *words],
                check=True,
                stdout=subprocess.PIPE,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
            spent = Spent(**json.loads(done.stdout.splitlines()[-1]))
            with np.load(folder / "mesh.npz") as made:
                mesh = TriangleMesh(made["vertices"], made["faces"])
            found = mesh_distance(mesh, truth)
            hits = hit_score(ObjectMesh(mesh, "tsdf", settings.voxel, False), truth, [v.camera for v in scene.test])
            lengths = (found.accuracy, found.accuracy_95, found.completeness, found.completeness_95)
            cells = [f"{value / found.size:.4f}" for value in lengths] + [f"{hits.front:.3f}", f"{len(mesh.faces):,}"]
            cells += [f"{spent.cpu_seconds:.2f}", f"{spent.peak_mb:.0f}"]
            cells += [f"{spent.import_seconds:.2f}", f"{spent.import_mb:.0f}"]
            print("| " + " | ".join([WAYS[way][0], kind, *cells]) + " |", flush=True)
            figures.append({"way": way, "depths": kind, "distance": found.mean / found.size, **asdict(spent)})
    return figures


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m lab.fusion", description=__doc__)
    parser.add_argument("--scene", default="ball_statue", help="a shipped scene with a transparent object")
    parser.add_argument("--long-side", type=int, help="of the pictures, in pixels (default: as they are)")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--one", nargs=3, metavar=("WAY", "VIEWS", "MESH"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        way, source, out = options.one
        print(json.dumps(asdict(one(way, Path(source), Path(out)))))
        return
    print(HEADER, "|---" * HEADER.count(" | ") + "|---|", sep="\n")
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(options.scene, options.ways, Path(folder), options.long_side)
    print(json.dumps({"machine": machine(), "scene": options.scene, "figures": figures}))


if __name__ == "__main__":
    main()
