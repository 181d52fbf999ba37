"""The pipeline step: from an imported scene and a trained method (here an analytic sphere) to mesh files."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.steps import evaluate, report
from pipelines.steps import extract_mesh as step
from rtgs.config.schema import MeshConfig, RunConfig
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import read_object_mesh
from rtgs.mesh.record import MeshRecord
from rtgs.mesh.score import container_mesh
from rtgs.mesh.settings import HullSettings, ObjectSettings, TsdfSettings
from rtgs.mesh.triangles import TriangleMesh, read_mesh_ply, write_mesh_ply
from rtgs.methods import Mode, RenderedView, RenderOptions
from rtgs.render.buffers import RasterBuffers
from rtgs.scenes.canonical import save_scene
from rtgs.scenes.importers.embedded import embedded_capture
from rtgs.scenes.scene import Scene, View, load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.track.null import NullTracker
from rtgs.workflow import Artifacts, StepContext
from tests.mesh.shapes import camera_at, sphere, sphere_depths

PARAMS = step.ExtractMeshParams(TsdfSettings(depth_trunc=6.0, voxel=6.0 / 96), obj=True)


class SphereMethod:
    """Renders a half-transparent unit sphere: the buffers hold sums of w z, as the rasteriser's do."""

    maps = ("depth", "median_depth")

    def surface(self, camera: Camera, step: int, options: RenderOptions) -> RasterBuffers:
        assert options.depth
        near, _ = sphere_depths(camera, 1.0)
        alpha = torch.isfinite(near).float() * 0.8
        depth = torch.where(alpha > 0, near, 0.0).float() * alpha
        image = torch.full((3, camera.height, camera.width), 0.4)
        return RasterBuffers(image, alpha, depth=depth, median_depth=torch.where(alpha > 0, near, 0.0).float())

    def render(self, camera: Camera, step: int, mode: Mode, options: RenderOptions) -> RenderedView:
        buffers = self.surface(camera, step, options)
        return RenderedView(camera, buffers.features, buffers)


def sphere_scene(masked: bool) -> Scene:
    views = []
    for k in range(13):
        angle, z = 2.4 * k, 1 - 2 * (k + 0.5) / 13
        ring = (1 - z * z) ** 0.5
        camera = camera_at((3 * ring * np.cos(angle), 3 * ring * np.sin(angle), 3 * z), width=96, height=80, focal=110)
        camera = replace(camera, name=f"{k:02d}.png")
        upper = torch.zeros(80, 96, dtype=torch.bool)
        upper[:40] = True
        views.append(View(camera, torch.full((3, 80, 96), 0.4), upper if masked else None, None, f"{k:02d}.png"))
    return Scene("sphere", tuple(views[1:]), tuple(views[:1]), torch.zeros(4, 3), torch.zeros(4, 3), 3.3, "test")


@pytest.fixture
def context(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StepContext:
    monkeypatch.setattr(step, "last_training", lambda inputs: inputs["train_diffuse"])
    monkeypatch.setattr(step, "load_method", lambda folder, scene: (SphereMethod(), SimpleNamespace(until=100)))
    for name in ("scene", "out", "partial"):
        (tmp_path / name).mkdir()
    save_scene(sphere_scene(masked=False), tmp_path / "scene")
    inputs = {"import_scene": tmp_path / "scene", "train_diffuse": tmp_path}
    return StepContext(inputs, tmp_path / "out", tmp_path / "partial", logging.getLogger("test"), NullTracker())


def another(context: StepContext) -> StepContext:
    """Of another run: it reads the scene again."""
    return replace(context, artifacts=Artifacts())


@pytest.mark.parametrize("depth_ratio", [0.0, 1.0])
def test_mesh_of_the_training_views(context: StepContext, depth_ratio: float) -> None:
    step.extract_mesh(replace(PARAMS, depth_ratio=depth_ratio), context)
    mesh = read_mesh_ply(context.out / "mesh.ply")
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)
    assert error.mean() < 0.3 * 6.0 / 96
    record = json.loads((context.out / "mesh.json").read_text())
    assert record["faces"] == len(mesh.faces)
    assert record["picture_from"] == "00.png"
    with Image.open(context.out / "mesh.png") as picture:
        assert picture.size == (96, 80)
        assert picture.getpixel((48, 40)) != (255, 255, 255)
    assert (context.out / "mesh.obj").is_file()


def test_masked_mesh_needs_masks(context: StepContext) -> None:
    params = replace(PARAMS, only_masked=True)
    with pytest.raises(RtgsError, match="'sphere' has no masks"):
        step.extract_mesh(params, context)


def test_masked_mesh_holds_less(context: StepContext) -> None:
    step.extract_mesh(PARAMS, context)
    whole = len(read_mesh_ply(context.out / "mesh.ply").faces)
    save_scene(sphere_scene(masked=True), context.inputs["import_scene"])
    step.extract_mesh(replace(PARAMS, only_masked=True), another(context))
    assert len(read_mesh_ply(context.out / "mesh.ply").faces) < whole


def whole_masks(scene: Scene) -> Scene:
    """Every view's mask is the sphere's silhouette."""
    train = tuple(replace(view, mask=torch.isfinite(sphere_depths(view.camera, 1.0)[0])) for view in scene.train)
    return replace(scene, train=train)


@pytest.mark.parametrize("source", ["auto", "tsdf"])
def test_mesh_of_the_transparent_object(context: StepContext, source: str) -> None:
    save_scene(whole_masks(sphere_scene(masked=False)), context.inputs["import_scene"])
    settings = ObjectSettings(hull=HullSettings(voxels=40, outvoted=0), tsdf_resolution=64)
    step.extract_mesh(replace(PARAMS, tsdf=TsdfSettings(), only_masked=True, source=source, object=settings), context)
    mesh = read_object_mesh(context.out)
    record = json.loads((context.out / "mesh.json").read_text())
    assert mesh.source == {"auto": "hull", "tsdf": "tsdf"}[source]
    assert record["silhouette_iou"] > 0.93
    assert record["decisions"][0][0] == f"object mesh: {mesh.source}"
    assert record["note"].startswith("Of the transparent object")
    assert "truth" not in record  # no such described scene
    if source == "tsdf":  # the pictures end at the sphere, so that the masks allow more where few views look
        assert np.abs(np.linalg.norm(mesh.mesh.vertices, axis=1) - 1).mean() < 0.06
    assert (context.out / "mesh.png").is_file()
    assert (context.out / "mesh.obj").is_file()


def test_on_a_path_traced_scene_the_distance_to_the_true_container_is_tracked(
    context: StepContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the true container itself: none. It is in mesh.json, in the tracker and in what tables are made of."""
    tracked: dict[str, float] = {}
    monkeypatch.setattr(context.tracker, "metrics", lambda values, step=None: tracked.update(values))
    path = str(embedded_capture("ball_statue"))
    scene = load_scene(SceneSettings(name="ball_statue", path=path, long_side=48))
    save_scene(scene, context.inputs["import_scene"])
    true = container_mesh("ball_statue")
    assert true is not None
    write_mesh_ply(tmp_path / "true.ply", true)
    settings = ObjectSettings(given=str(tmp_path / "true.ply"))
    step.extract_mesh(replace(PARAMS, only_masked=True, source="given", object=settings), context)
    truth = json.loads((context.out / "mesh.json").read_text())["truth"]
    diagonal = float(np.linalg.norm(np.ptp(true.vertices, axis=0)))
    assert max(truth[name] for name in ("distance", "distance_to_truth", "distance_from_truth")) < 1e-3 * diagonal
    assert min(truth["front_within_3_percent"], truth["back_within_3_percent"]) == 1
    assert truth["normal_degrees_median"] < 0.1
    assert {f"mesh/{name}": value for name, value in truth.items()}.items() <= tracked.items()
    known = evaluate.object_facts(context.out, scene)
    assert known is not None
    assert known.distance == pytest.approx(truth["distance"] / diagonal)
    assert "distance" in known.numbers()


def test_without_a_mask_that_shows_something_there_is_no_object_and_no_error(context: StepContext) -> None:
    """A step that makes masks may find nothing: the run goes on, and whoever reads the artifact is told."""
    params = replace(PARAMS, only_masked=True, source="auto")
    step.extract_mesh(params, context)
    assert step.why_absent(context.out) == "there are no masks"
    assert [path.name for path in context.out.iterdir()] == ["mesh.json"]
    blank = sphere_scene(masked=True)
    for fill, why in ((0, "all 12 masks are empty"), (1, "12 masks cover the whole picture")):
        train = tuple(replace(view, mask=torch.full((80, 96), bool(fill))) for view in blank.train)
        save_scene(replace(blank, train=train), context.inputs["import_scene"])
        step.extract_mesh(params, another(context))
        assert why in step.why_absent(context.out)
    assert evaluate.object_facts(context.out, blank) is None
    assert report._mesh(context.out, MeshRecord.read(context.out)) is None
    assert MeshRecord.read(context.out).decisions[0].what == "no transmittance stage"
    save_scene(whole_masks(sphere_scene(masked=False)), context.inputs["import_scene"])
    step.extract_mesh(replace(params, object=ObjectSettings(hull=HullSettings(voxels=24))), another(context))
    assert step.why_absent(context.out) == ""


def test_an_empty_mesh_is_an_error_and_nothing_is_written(context: StepContext, tmp_path: Path) -> None:
    save_scene(whole_masks(sphere_scene(masked=False)), context.inputs["import_scene"])
    write_mesh_ply(tmp_path / "flat.ply", TriangleMesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]])))
    settings = ObjectSettings(given=str(tmp_path / "flat.ply"))
    params = replace(PARAMS, tsdf=TsdfSettings(), only_masked=True, source="given", object=settings)
    with pytest.raises(RtgsError, match="holds no surface"):
        step.extract_mesh(params, context)
    hopeless = replace(PARAMS, only_masked=True, tsdf=replace(PARAMS.tsdf, min_triangles=1_000_000))
    with pytest.raises(RtgsError, match="no piece of 1000000 triangles"):
        step.extract_mesh(hopeless, context)
    assert not list(context.out.iterdir())


def test_a_given_mesh_belongs_to_the_plan(tmp_path: Path) -> None:
    file = tmp_path / "mesh.ply"
    config = RunConfig(mesh=MeshConfig(source="given", object=ObjectSettings(given=str(file))))
    with pytest.raises(RtgsError, match="given needs mesh"):
        step.object_params(config)
    write_mesh_ply(file, sphere(1.0, 8))
    first = step.object_params(config).object.given_sha256
    write_mesh_ply(file, sphere(1.1, 8))
    assert first != step.object_params(config).object.given_sha256
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(RtgsError, match=r"mesh\.ply"):
        step.object_params(config)
