"""The mesh of a trained method: of the scene (depths of the training views, fused) or of the transparent object."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.mesh.record import MeshRecord, MeshTruth
from rtgs.mesh.settings import ObjectSettings, TsdfSettings
from rtgs.runs.training import last_training, load_method
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from rtgs.config.schema import RunConfig
    from rtgs.mesh.choose import Choice
    from rtgs.mesh.triangles import TriangleMesh
    from rtgs.mesh.tsdf import DepthView, MeshResult
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

MESH_FILE = "mesh.ply"
PICTURE_FILE = "mesh.png"


@dataclass(frozen=True)
class ExtractMeshParams:
    """How the mesh is made (method.md 6.3)."""

    tsdf: TsdfSettings = field(default_factory=TsdfSettings)
    only_masked: bool = False
    """Fuse only what lies inside the scene's masks: the mesh of the glass object instead of the scene."""
    depth_ratio: float = 0.0
    """0: expected depth (2DGS for meshes of real scenes), 1: median depth."""
    obj: bool = False
    """Also write ``mesh.obj``."""
    source: str = ""
    """How the transparent object's mesh is found, for the third stage; empty: a mesh of the scene."""
    object: ObjectSettings = field(default_factory=ObjectSettings)
    """What can be chosen about the object's mesh."""


def object_params(config: RunConfig) -> ExtractMeshParams:
    """Parameters of the transparent object's mesh.

    Raises:
        RtgsError: mesh.source is given and there is no such file, or it holds no mesh.
    """
    mesh = config.mesh
    chosen = mesh.object
    if mesh.source == "given":
        from rtgs.mesh.choose import read_given

        read_given(chosen.given)  # refuses what is none before two stages are trained
        file = Path(chosen.given)
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        chosen = replace(chosen, given=str(file.resolve()), given_sha256=digest)
    return ExtractMeshParams(mesh.tsdf, mesh.of == "object", mesh.depth_ratio, mesh.obj, mesh.source, chosen)


def extract_mesh(params: ExtractMeshParams, context: StepContext) -> None:
    """Write ``mesh.ply``, ``mesh.json`` (counts, lengths, scores, decisions) and ``mesh.png`` (seen from a test view,
    else a training view). With a ``source``: the artifact :func:`rtgs.mesh.container.read_object_mesh` reads, or, where
    no mask shows an object (masks that a step makes are known only now), ``mesh.json`` alone: :func:`why_absent`.

    Raises:
        RtgsError: no depth to fuse, masks are asked for and the scene has none, or no object mesh can be made.
    """
    from rtgs.mesh.silhouettes import why_unbounded
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    if params.source and params.only_masked and (why := why_unbounded([view.mask for view in scene.train])):
        MeshRecord(absent=why, decisions=(Decision("no transmittance stage", why),)).write(context.out)
        context.log.info("no mesh of a transparent object: %s", why)
        return
    if params.only_masked and all(view.mask is None for view in scene.train):
        raise RtgsError(f"scene {scene.name!r} has no masks, but the mesh is to be made of masked pixels only")
    method, stage = load_method(last_training(context.inputs), scene)
    if params.source and params.only_masked:
        _object_mesh(method, stage.until, scene, params, context)
    else:
        _scene_mesh(method, stage.until, scene, params, context)


def why_absent(folder: Path) -> str:
    """Why an artifact of this step holds no mesh of the transparent object; empty: it holds one.

    Raises:
        RtgsError: its record is missing or damaged.
    """
    return MeshRecord.read(folder).absent or ""


def _scene_mesh(method: Model, step: int, scene: Scene, params: ExtractMeshParams, context: StepContext) -> None:
    """Of everything, or of everything masked."""
    from rtgs.mesh.container import ObjectMesh, write_object_mesh
    from rtgs.mesh.triangles import write_mesh_ply
    from rtgs.mesh.tsdf import fuse_depths

    views = _depth_views(method, step, scene, params)
    result = fuse_depths(views, [view.camera for view in scene.train], params.tsdf)
    note = f"Voxel {result.voxel:.4g}, depths up to {result.depth_trunc:.4g}."
    record = _with_fusion(
        MeshRecord(note=note, picture_from=_pictured(result.mesh, scene, params, context.out)), result
    )
    if params.source:
        write_object_mesh(context.out, ObjectMesh(result.mesh, "tsdf", result.voxel, flat=False), record)
    else:
        write_mesh_ply(context.out / MESH_FILE, result.mesh)
        vertices, faces = len(result.mesh.vertices), len(result.mesh.faces)
        replace(record, vertices=vertices, faces=faces, voxel=result.voxel).write(context.out)
    context.tracker.metrics(_sizes(result.mesh))
    context.log.info("mesh of %d triangles in %d pieces, voxel %.4g", len(result.mesh.faces), result.kept, result.voxel)


def _object_mesh(method: Model, step: int, scene: Scene, params: ExtractMeshParams, context: StepContext) -> None:
    """Of the transparent object: hull, pane, TSDF or a given file."""
    import numpy as np

    from rtgs.mesh.container import write_object_mesh
    from rtgs.prepare.masks.report import MaskReport

    drawn = "masks" in context.inputs  # of a scene whose panes somebody drew
    panes = [np.array(pane.corners) for pane in MaskReport.read(context.inputs["masks"]).panes] if drawn else []
    choice, fused = find_object_mesh(method, step, scene, params, panes)
    truth = _against_truth(choice, scene)
    pictured = _pictured(choice.mesh.mesh, scene, params, context.out)
    record = replace(_choice_record(choice), picture_from=pictured, truth=truth)
    if choice.mesh.source == "tsdf":
        assert fused is not None
        record = _with_fusion(record, fused)
    write_object_mesh(context.out, choice.mesh, record)
    for decision in choice.decisions:
        context.log.info("%s", decision)
    numbers = {"silhouette_iou": choice.iou.mean, "silhouette_iou_lowest": choice.iou.lowest}
    numbers |= {"silhouette_iou_all_pixels": choice.iou_all.mean} | ({} if truth is None else asdict(truth))
    numbers |= {f"silhouette_iou_{name}": value for name, value in choice.candidates.items()}
    context.tracker.metrics({f"mesh/{name}": value for name, value in numbers.items()} | _sizes(choice.mesh.mesh))


def find_object_mesh(
    method: Model, step: int, scene: Scene, params: ExtractMeshParams, panes: Sequence[np.ndarray] = ()
) -> tuple[Choice, MeshResult | None]:
    """The mesh of the transparent object from the masks of the training views and the base set's depth after ``step``,
    and the fusion of depths if one was made. ``panes``: flat polygons (K, 3) that somebody drew, world frame.

    Raises:
        RtgsError: no mask shows an object, or no mesh can be made.
    """
    from rtgs.mesh.choose import choose_object_mesh
    from rtgs.mesh.silhouettes import mask_set
    from rtgs.mesh.tsdf import fuse_depths, object_fusion

    made: list[MeshResult] = []
    cameras = [view.camera for view in scene.train]

    def fuse(box: np.ndarray | None) -> tuple[TriangleMesh, float]:
        settings, crop = object_fusion(
            params.tsdf, params.object.tsdf_resolution, params.object.tsdf_pieces, cameras, box
        )
        views = (crop(view) for view in _depth_views(method, step, scene, params))
        made.append(fuse_depths(views, cameras, settings))
        return made[-1].mesh, made[-1].voxel

    masks = mask_set(cameras, [view.mask for view in scene.train], _median_depths(method, step, scene))
    choice = choose_object_mesh(params.source, masks, params.object, fuse, panes)
    return choice, made[-1] if made else None


def _choice_record(choice: Choice) -> MeshRecord:
    """What is worth knowing of a chosen mesh."""
    kinds = {"hull": "visual hull of the masks", "tsdf": "TSDF of the depths", "given": "from the given file"}
    kind = "a flat pane" if choice.mesh.flat else kinds[choice.mesh.source]
    agreement = f"IoU with the masks {choice.iou.mean:.3f}"
    note = f"Of the transparent object: {kind}, voxel {choice.mesh.voxel:.4g}; {agreement}."
    hull = choice.hull
    return MeshRecord(
        note=note,
        silhouette_iou=choice.iou.mean,
        silhouette_iou_lowest=choice.iou.lowest,
        silhouette_iou_lowest_view=choice.iou.lowest_view,
        silhouette_iou_all_pixels=choice.iou_all.mean,
        candidates=choice.candidates,
        decisions=choice.decisions,
        masks_outvoted=None if hull is None else hull.outvoted,
        trimmed=None if hull is None else hull.trimmed,
        trim_views=None if hull is None else hull.trim_views,
        surface_fit=choice.fit,
    )


def _against_truth(choice: Choice, scene: Scene) -> MeshTruth | None:
    """The mesh against the true container; None: nothing is known of one."""
    from rtgs.mesh.score import container_mesh, hit_score, mesh_distance

    views = [view for view in scene.test if view.truth is not None]
    truth = container_mesh(scene.name) if views else None
    if truth is None:
        return None
    distance = mesh_distance(choice.mesh.mesh, truth)
    hits = hit_score(choice.mesh, truth, [view.camera for view in views])
    return MeshTruth(
        distance=distance.mean,
        distance_to_truth=distance.accuracy,
        distance_from_truth=distance.completeness,
        front_within_3_percent=hits.front,
        back_within_3_percent=hits.back,
        normal_degrees_median=hits.normal_median,
    )


def _median_depths(method: Model, step: int, scene: Scene) -> list[Tensor]:
    """(H, W) depth of the base set in every training view, the median where the method has one; 0 where nothing is."""
    import torch

    from rtgs.methods import RenderOptions
    from rtgs.train.losses import surface_depth

    median = "median_depth" in method.maps
    wanted = RenderOptions(depth=True, median_depth=median)
    depths = []
    for view in scene.train:
        if view.mask is None:
            depths.append(torch.zeros(view.camera.height, view.camera.width))
            continue
        buffers = method.surface(view.camera, step, wanted)
        assert buffers.depth is not None
        depth = surface_depth(buffers.depth, buffers.alpha, buffers.median_depth, 1.0 if median else 0.0)
        depths.append(torch.where(torch.isfinite(depth) & (buffers.alpha >= 0.5), depth, 0.0).float())
    return depths


def _depth_views(method: Model, step: int, scene: Scene, params: ExtractMeshParams) -> Iterator[DepthView]:
    """The depth of every training view, rendered when it is needed."""
    import torch

    from rtgs.mesh.tsdf import DepthView
    from rtgs.methods import Mode, RenderOptions
    from rtgs.train.losses import surface_depth

    if params.depth_ratio > 0 and "median_depth" not in method.maps:
        raise RtgsError(f"method {method.name} has no median depth: mesh.depth_ratio must be 0")
    options = RenderOptions(depth=True, median_depth=params.depth_ratio > 0)
    for view in scene.train:
        if params.only_masked and view.mask is None:
            continue
        with torch.no_grad():
            rendered = method.render(view.camera, step, Mode.EVALUATE, options)
        buffers = rendered.buffers
        assert buffers.depth is not None
        depth = surface_depth(buffers.depth, buffers.alpha, buffers.median_depth, params.depth_ratio)
        mask = view.mask if params.only_masked else None
        yield DepthView(rendered.camera, depth, rendered.image, buffers.alpha, mask)


def _pictured(mesh: TriangleMesh, scene: Scene, params: ExtractMeshParams, out: Path) -> str:
    """Write the picture, and the OBJ where it is asked for; the view that the picture is seen from."""
    from rtgs.evaluate.images import write_png
    from rtgs.mesh.triangles import write_mesh_obj
    from rtgs.report.figures import mesh_picture

    view = (scene.test or scene.train)[0]
    write_png(out / PICTURE_FILE, mesh_picture(mesh, view.camera), f"mesh seen from {view.name}")
    if params.obj:
        write_mesh_obj(out / "mesh.obj", mesh)
    return view.name


def _with_fusion(record: MeshRecord, result: MeshResult) -> MeshRecord:
    return replace(record, depth_trunc=result.depth_trunc, pieces_found=result.clusters, pieces_kept=result.kept)


def _sizes(mesh: TriangleMesh) -> dict[str, float]:
    return {"mesh/vertices": float(len(mesh.vertices)), "mesh/triangles": float(len(mesh.faces))}


STEP = StepKind("extract_mesh", 9, extract_mesh)
