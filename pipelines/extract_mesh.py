"""The trained surfels as a triangle mesh: depths of the training views, fused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.training import last_training, load_method
from rtgs.mesh.tsdf import TsdfSettings
from rtgs.pipeline import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.mesh.tsdf import DepthView, MeshResult
    from rtgs.methods import Method
    from rtgs.scenes.scene import Scene

MESH_FILE = "mesh.ply"
PICTURE_FILE = "mesh.png"
SUMMARY_FILE = "mesh.json"


@dataclass(frozen=True)
class ExtractMeshParams:
    """How the mesh is made (methods.md 6.3)."""

    tsdf: TsdfSettings = field(default_factory=TsdfSettings)
    only_masked: bool = False
    """Fuse only what lies inside the scene's masks: the mesh of the glass object instead of the scene."""
    depth_ratio: float = 0.0
    """0: expected depth (2DGS for meshes of real scenes), 1: median depth."""
    obj: bool = False
    """Also write ``mesh.obj``."""
    source: str = ""
    """How the transparent object's mesh is found, for the third stage; empty: a mesh of the scene."""


def object_params(config: RunConfig) -> ExtractMeshParams:
    """Parameters of the transparent object's mesh."""
    mesh = config.mesh
    return ExtractMeshParams(mesh.tsdf, mesh.of == "object", mesh.depth_ratio, mesh.obj, mesh.source)


def extract_mesh(params: ExtractMeshParams, context: StepContext) -> None:
    """Write ``mesh.ply``, ``mesh.json`` (counts, lengths), ``mesh.png`` (seen from a test view, else a training view).

    Raises:
        RtgsError: no depth to fuse, or masks are asked for and the scene has none.
    """
    from rtgs.errors import RtgsError
    from rtgs.mesh.triangles import write_mesh_obj, write_mesh_ply
    from rtgs.mesh.tsdf import fuse_depths
    from rtgs.scenes.canonical import read_scene

    scene = read_scene(context.inputs["import_scene"])
    if params.only_masked and all(view.mask is None for view in scene.train):
        raise RtgsError(f"scene {scene.name!r} has no masks, but the mesh is to be made of masked pixels only")
    method, stage = load_method(last_training(context.inputs), scene)
    views = _depth_views(method, stage.until, scene, params)
    result = fuse_depths(views, [view.camera for view in scene.train], params.tsdf)
    write_mesh_ply(context.out / MESH_FILE, result.mesh)
    if params.obj:
        write_mesh_obj(context.out / "mesh.obj", result.mesh)
    _write_summary(context.out, result, scene)
    if params.source:
        from rtgs.mesh.container import ObjectMesh, write_object_mesh

        record = json.loads((context.out / SUMMARY_FILE).read_text(encoding="utf-8"))
        write_object_mesh(context.out, ObjectMesh(result.mesh, "tsdf", result.voxel, flat=False), record)
    counts = {"mesh/vertices": float(len(result.mesh.vertices)), "mesh/triangles": float(len(result.mesh.faces))}
    context.tracker.metrics(counts)
    context.log.info("mesh of %d triangles in %d pieces, voxel %.4g", len(result.mesh.faces), result.kept, result.voxel)


def _depth_views(method: Method, step: int, scene: Scene, params: ExtractMeshParams) -> Iterator[DepthView]:
    """The depth of every training view, rendered when it is needed."""
    import torch

    from rtgs.errors import RtgsError
    from rtgs.mesh.tsdf import DepthView
    from rtgs.methods import RenderOptions
    from rtgs.train.losses import surface_depth

    if params.depth_ratio > 0 and "median_depth" not in method.maps:
        raise RtgsError(f"method {method.settings.name} has no median depth: mesh.depth_ratio must be 0")
    options = RenderOptions(depth=True, median_depth=params.depth_ratio > 0)
    for view in scene.train:
        if params.only_masked and view.mask is None:
            continue
        with torch.no_grad():
            rendered = method.render(view.camera, step, options)
        buffers = rendered.buffers
        assert buffers.depth is not None
        depth = surface_depth(buffers.depth, buffers.alpha, buffers.median_depth, params.depth_ratio)
        mask = view.mask if params.only_masked else None
        yield DepthView(view.camera, depth, rendered.image, buffers.alpha, mask)


def _write_summary(out: Path, result: MeshResult, scene: Scene) -> None:
    from rtgs.evaluate.images import write_png
    from rtgs.report.figures import mesh_picture

    view = (scene.test or scene.train)[0]
    write_png(out / PICTURE_FILE, mesh_picture(result.mesh, view.camera), f"mesh seen from {view.name}")
    record = {
        "vertices": len(result.mesh.vertices),
        "faces": len(result.mesh.faces),
        "voxel": result.voxel,
        "depth_trunc": result.depth_trunc,
        "pieces_found": result.clusters,
        "pieces_kept": result.kept,
        "picture_from": view.name,
    }
    (out / SUMMARY_FILE).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


STEP = StepKind(
    "extract_mesh",
    1,
    extract_mesh,
    helpers=(
        "pipelines.training",
        "rtgs.mesh.tsdf",
        "rtgs.mesh.triangles",
        "rtgs.methods.surfel_base",
        "rtgs.methods.gs3d",
        "rtgs.native",
    ),
)
