"""Every reader of files that somebody else may have written: sound files to damage, and what a sound result is."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image, ImageCms
from safetensors.torch import save_file

from pipelines.cli.show import read_transform
from pipelines.steps.external import ExternalRecord
from rtgs.core.cameras import Camera
from rtgs.evaluate.external import read_external
from rtgs.evaluate.records import METRICS, EvaluationTable, RunFacts, ViewScore, read_json, write_json
from rtgs.evaluate.settings import ExternalSettings
from rtgs.mesh.record import MeshRecord
from rtgs.mesh.triangles import TriangleMesh, read_mesh_obj, read_mesh_ply, write_mesh_obj, write_mesh_ply
from rtgs.prepare.masks.drawn import read_drawing
from rtgs.prepare.masks.report import MaskReport, MaskRow
from rtgs.prepare.normals.make import NormalReport, read_message
from rtgs.prepare.poses.export import read_lenses, write_lenses
from rtgs.prepare.poses.photos import lay_out, read_photo_set
from rtgs.prepare.poses.quality import SfmReport
from rtgs.prepare.poses.world import WorldChange
from rtgs.pretrained.weights import read_tensors
from rtgs.render.camera_path import read_camera_path
from rtgs.runs.record import RunRecord
from rtgs.scenes.canonical import read_scene, save_scene
from rtgs.scenes.check import check_capture
from rtgs.scenes.images import read_mask, read_normals, read_photo
from rtgs.scenes.importers.transforms import read_point_file
from rtgs.scenes.scene import View, load_scene
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.splits import read_split_file
from rtgs.scenes.synthetic.description import SCENES, read_description
from rtgs.scenes.truth import ViewTruth, read_truth, write_truth
from rtgs.scenes.undistort import Lens
from rtgs.train.checkpoint import Checkpoint, CheckpointRecord, load_checkpoint, save_checkpoint
from rtgs.workflow.manifest import Manifest
from tests.fuzz.reader import Files, Reader, files_of
from tests.fuzz.splats import SPLATS
from tests.scenes import captures


def _capture(folder: Path) -> None:
    """What the check calls sound must load; what it refuses must not."""
    settings = SceneSettings(path=str(folder))
    refused = [finding for finding in check_capture(settings) if finding.severity == "error"]
    try:
        scene = load_scene(settings)
    except CaptureError:
        assert refused, "the check calls ready what the import refuses"
        raise
    assert not refused, f"the import takes what the check refuses: {refused[0].message}"
    for view in (*scene.train, *scene.test):
        assert torch.isfinite(view.image).all()
        assert view.image.min() >= 0
        assert view.image.max() <= 1
        assert view.normal is None or torch.isfinite(view.normal).all()
    assert torch.isfinite(scene.points).all()
    assert torch.isfinite(scene.point_colors).all()


def _colmap(*, text: bool, model: str = "PINHOLE") -> Callable[[], Files]:
    params = captures.PINHOLE if model == "PINHOLE" else (*captures.PINHOLE, 0.02, 0.01, 0.0, 0.0)

    def write(folder: Path) -> None:
        captures.ColmapCapture(folder, views=4, points=12, text=text, model=model, params=params).write()

    return files_of(write)


def _parts(suffix: str) -> tuple[str, ...]:
    return tuple(f"sparse/0/{part}{suffix}" for part in ("cameras", "images", "points3D", "rigs", "frames"))


def _write_transforms(folder: Path) -> None:
    keys = {"k1": 0.01, "ply_file_path": "points.ply", "mask_path": None}
    captures.write_transforms(folder, views=4, **keys)
    captures.write_ply(folder / "points.ply", np.random.default_rng(0).normal(size=(20, 3)))


def _write_blender(folder: Path) -> None:
    captures.write_transforms(folder, views=4, camera_angle_x=0.8)
    (folder / "transforms.json").rename(folder / "transforms_train.json")


MESH = TriangleMesh(np.eye(4, 3), np.array([[0, 1, 2], [1, 2, 3]]), np.full((4, 3), 0.5))


def _mesh(read: Callable[[Path], TriangleMesh], name: str) -> Callable[[Path], None]:
    def check(folder: Path) -> None:
        mesh = read(folder / name)
        assert len(mesh.faces)
        assert np.isfinite(mesh.vertices).all()

    return check


def _write_photos(folder: Path) -> None:
    pixels = (captures.pinhole_picture() * 255).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = 6, "Maker", "Model"
    exif.get_ifd(0x8769).update({0x920A: 4.2, 0xA405: 28})
    Image.fromarray(pixels).save(folder / "a.jpg", exif=exif)
    Image.fromarray(pixels).save(folder / "b.png", exif=exif)
    Image.fromarray(pixels[..., 0]).convert("P").save(folder / "c.png", transparency=3)
    Image.fromarray(pixels).save(folder / "d.tif", exif=exif)
    Image.fromarray(pixels).save(folder / "e.bmp")
    Image.fromarray(pixels).save(folder / "f.webp", exif=exif)


def _read_photos(folder: Path) -> None:
    errors: list[CaptureError] = []
    for path in sorted(folder.glob("?.*")):
        try:
            photo = read_photo(path, expected=(captures.WIDTH, captures.HEIGHT))
            read_mask(path, (captures.WIDTH, captures.HEIGHT))
            assert photo.dtype == np.float32
            assert 0 <= photo.min() <= photo.max() <= 1
        except CaptureError as error:
            errors.append(error)
    lay_out(read_photo_set(folder), folder / "out", (0.0, 0.0, 0.0), lambda number: None)
    if errors:
        raise errors[0]


def _write_normals(folder: Path) -> None:
    normals = np.random.default_rng(0).normal(size=(6, 8, 3))
    np.save(folder / "a.npy", normals.astype(np.float32))
    np.save(folder / "b.npy", np.asfortranarray(normals.astype(">f8")))
    Image.fromarray((normals * 20 + 128).clip(0, 255).astype(np.uint8)).save(folder / "c.png")


def _read_normals(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        length = np.linalg.norm(read_normals(path, "opengl", (8, 6)), axis=-1)
        assert ((np.abs(length - 1) < 1e-3) | (length == 0)).all()


MARKS = b"""units: pixels
panes:
  door: &door
    a.jpg: [[120, 80], [430, 92], [425, 610], [118, 600]]
    b.jpg: [[101, 85], [398, 70], [402, 598], [99, 611]]
  again: *door
cutouts:
  a.jpg: {outline: [[110, 70], [400, 66], [412, 300]]}
  c.jpg: {box: [100, 60, 420, 560], inside: [[250, 300]], outside: [[110, 70]]}
"""


def _read_marks(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        drawing = read_drawing(path, ("a.jpg", "b.jpg", "c.jpg"))
        assert drawing.marked
        assert all(np.isfinite(marks).all() for pane in drawing.panes.values() for marks in pane.values())


def _write_metrics(folder: Path) -> None:
    rows = tuple(ViewScore(name, 8, 6, 0.5, dict.fromkeys(METRICS, 0.25)) for name in ("a.jpg", "b.jpg"))
    write_json(folder / "metrics.json", EvaluationTable(RunFacts("s", "m"), rows, {}))


def _read_metrics(folder: Path) -> None:
    table = read_json(folder / "metrics.json")
    assert all(isinstance(table.mean(name), float | None) for name in table.metrics)
    assert isinstance(table.resolution, str)


def _write_records(folder: Path) -> None:
    RunRecord("r", "rtgs run", "2026", {"scene": "s"}, {"render": "f" * 64}, ("/p",)).write(folder)
    MeshRecord(note="a", voxel=0.1, candidates={"hull": 0.5}).write(folder)
    MaskReport("given", (), (MaskRow("a.jpg", "given", 0.5, None),), "not compared").write(folder)
    change = WorldChange(2.0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 1.0, 2.0), "x")
    counts = (3, 3, (), (3,), 100, 0.5, 3.0, 40.0, 90.0, ("PINHOLE",), "all", 3, {"all": 1.0})
    SfmReport(*counts, change, observed={"a.jpg": 3}).write(folder)
    normal = NormalReport("omnidata", "f" * 64, 3, 0, None, "not checked")
    (folder / "normals.json").write_text(json.dumps(asdict(normal)))
    write_lenses({"a.jpg": Lens("OPENCV", 64, 48, (60.0, 58.0, 32.0, 24.0, 0.01, 0.0, 0.0, 0.0))}, folder)
    record = {"size": 3, "sha256": "f" * 64}
    whole = Manifest("render", 1, "f" * 64, {"maps": True}, {}, {}, {}, 1.0, "2026")
    (folder / "manifest.json").write_text(json.dumps(asdict(whole) | {"files": {"a": record}}))
    ExternalRecord(("2 pictures in it are of no test view",)).write(folder)
    (folder / "split.json").write_text('{"train": ["a.jpg"], "test": ["b.jpg"]}')


RECORDS: dict[str, Callable[[Path], object]] = {
    "run.json": RunRecord.read,
    "mesh.json": MeshRecord.read,
    "masks.json": MaskReport.read,
    "sfm.json": SfmReport.read,
    "normals.json": read_message,
    "external.json": ExternalRecord.read,
    "lenses.json": read_lenses,
    "split.json": lambda folder: read_split_file(folder / "split.json", ["a.jpg", "b.jpg", "c/b.jpg"]),
}


def _record(name: str) -> Callable[[Path], object]:
    return lambda folder: str(RECORDS[name](folder))


def _read_manifest(folder: Path) -> None:
    found = Manifest.read(folder)
    assert found is None or isinstance(found, Manifest)


def _write_truth(folder: Path) -> None:
    plane, light = torch.rand(6, 8), torch.rand(3, 6, 8)
    objects = torch.zeros(6, 8, dtype=torch.int16)
    normal = torch.nn.functional.normalize(torch.randn(3, 6, 8), dim=0)
    write_truth(folder, ViewTruth(plane, plane, normal, objects, plane > 0.5, light, light, light))


def _read_truth(folder: Path) -> None:
    truth = read_truth(folder)
    assert all(torch.isfinite(values.float()).all() for values in truth.tensors().values())
    assert truth.normal.shape == truth.diffuse.shape == (3, *truth.depth.shape)
    assert truth.objects.shape == truth.specular.shape == truth.second_depth.shape == truth.depth.shape


def _external_views() -> tuple[View, ...]:
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    image = torch.linspace(0, 1, 3 * 6 * 8).reshape(3, 6, 8)
    camera = Camera(eye, zero, 9.0, 9.0, 4.0, 3.0, 8, 6)
    return tuple(View(camera, image, None, None, name) for name in ("left/a.jpg", "b.jpg"))


def _write_external(folder: Path) -> None:
    views = _external_views()
    pixels = (views[0].image.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name in ("renders", "layers/reflection", "layers/depth", "layers/normal"):
        (folder / name / "left").mkdir(parents=True)
    Image.fromarray(pixels).save(folder / "renders" / "left" / "a.png", icc_profile=profile)
    Image.fromarray(pixels).save(folder / "renders" / "b.jpg", icc_profile=profile)
    for name in ("left/a", "b"):
        np.save(folder / "layers" / "reflection" / f"{name}.npy", views[0].image.numpy())
        np.save(folder / "layers" / "depth" / f"{name}.npy", np.ones((6, 8)))
        np.save(folder / "layers" / "normal" / f"{name}.npy", np.full((6, 8, 3), 0.6))


def _read_external(folder: Path) -> None:
    settings = ExternalSettings(str(folder / "renders"), layers=str(folder / "layers"))
    for tensors in read_external(settings, _external_views()).views.values():
        assert tensors["image"].shape == tensors["normal"].shape == (3, 6, 8)
        assert all(torch.isfinite(values).all() for values in tensors.values())


def _camera_path() -> Files:
    turn = [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 2, 0, 0, 0, 1]
    frames = [{"camera_to_world": turn, "fov": 50 + number, "aspect": 1.5} for number in range(3)]
    content = {"camera_type": "perspective", "render_width": 60, "render_height": 40, "camera_path": frames}
    return {"camera_path.json": json.dumps(content).encode()}


def _read_camera_path(folder: Path) -> None:
    for camera in read_camera_path(folder / "camera_path.json"):
        assert torch.isfinite(camera.camera_rays()).all()
        assert torch.isfinite(camera.center).all()


def _write_scene(folder: Path) -> None:
    with TemporaryDirectory() as place:
        _write_transforms(Path(place))
        save_scene(load_scene(SceneSettings(path=place)), folder)


def _read_scene(folder: Path) -> None:
    scene = read_scene(folder)
    for view in (*scene.train, *scene.test):
        assert torch.isfinite(view.camera.camera_rays()).all()
        assert view.image.shape == (3, view.camera.height, view.camera.width)
    assert scene.points.shape == scene.point_colors.shape
    assert 0 < scene.extent < float("inf")


def _write_checkpoint(folder: Path) -> None:
    record = CheckpointRecord(3, "a", "b", 1, "avx2", (("torch", "2"),), 1.0, 1.0, 0.5, None, 0, "{}")
    save_checkpoint(folder, Checkpoint(record, {"x": torch.ones(4, 3)}))


def _read_checkpoint(folder: Path) -> None:
    record = load_checkpoint(folder / "step_00000003").record
    assert type(record.step) is int
    assert type(record.threads) is int
    assert isinstance(record.settings, str)


def _write_weights(folder: Path) -> None:
    tensors = {"a.weight": torch.ones(4, 3), "a.bias": torch.zeros(4)}
    save_file(tensors, folder / "a.safetensors")
    torch.save(tensors, folder / "b.pth")


def _read_weights(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        assert all(isinstance(tensor, torch.Tensor) for tensor in read_tensors(path).values())


def _transform() -> Files:
    content = {"transform": [[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 2.0]], "scale": 0.3}
    return {"dataparser_transforms.json": json.dumps(content).encode()}


def _read_transform(folder: Path) -> None:
    found = read_transform(folder / "dataparser_transforms.json")
    assert found is not None
    assert torch.isfinite(found[0]).all()
    assert 0 < found[1] < float("inf")


def _described() -> Files:
    return {"scene.toml": (SCENES / "ball_statue.toml").read_bytes()}


def _obj() -> Files:
    return files_of(lambda folder: write_mesh_obj(folder / "a.obj", MESH))()


READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        Reader("colmap binary", _colmap(text=False), _parts(".bin"), _capture),
        Reader("colmap lens", _colmap(text=False, model="OPENCV"), _parts(".bin")[:1], _capture),
        Reader("colmap text", _colmap(text=True), _parts(".txt"), _capture),
        Reader("transforms", files_of(_write_transforms), ("transforms.json",) * 3 + ("points.ply",), _capture),
        Reader("blender", files_of(_write_blender), ("transforms_train.json",), _capture),
        Reader("capture photo", _colmap(text=False), ("images/photo_01.png",), _capture),
        *SPLATS,
        Reader("points", files_of(_write_transforms), ("points.ply",), lambda f: read_point_file(f / "points.ply")),
        Reader("mesh ply", files_of(lambda f: write_mesh_ply(f / "a.ply", MESH)), ("a.ply",),
               _mesh(read_mesh_ply, "a.ply")),
        Reader("mesh obj", _obj, ("a.obj",), _mesh(read_mesh_obj, "a.obj")),
        Reader("photos", files_of(_write_photos), ("a.jpg", "b.png", "c.png", "d.tif", "e.bmp", "f.webp"),
               _read_photos),
        Reader("normals", lambda: files_of(_write_normals)() | {"d.npy": files_of(_write_normals)()["a.npy"]},
               ("a.npy", "b.npy", "c.png"), _read_normals),
        Reader("marks", lambda: {"masks.yaml": MARKS}, ("masks.yaml",), _read_marks),
        Reader("marks json", lambda: {"a.json": b'{"cutouts": {"c.jpg": {"box": [1, 6, 42, 56]}}, "panes": {}}'},
               ("a.json",), _read_marks),
        Reader("metrics.json", files_of(_write_metrics), ("metrics.json",), _read_metrics),
        *(Reader(name, files_of(_write_records), (name,), _record(name)) for name in RECORDS),
        Reader("manifest.json", files_of(_write_records), ("manifest.json",), _read_manifest),
        Reader("external", files_of(_write_external), ("renders/left/a.png", "renders/b.jpg",
               "layers/reflection/b.npy", "layers/depth/b.npy", "layers/normal/b.npy"), _read_external),
        Reader("camera path", _camera_path, ("camera_path.json",), _read_camera_path),
        Reader("description", _described, ("scene.toml",), lambda f: read_description(f / "scene.toml")),
        Reader("scene.json", files_of(_write_scene), ("scene.json",) * 3 + ("points.safetensors",
               "views/00000.safetensors"), _read_scene),
        Reader("checkpoint", files_of(_write_checkpoint), ("step_00000003/record.json",) * 2
               + ("step_00000003/state.safetensors",), _read_checkpoint),
        Reader("weights", files_of(_write_weights), ("a.safetensors", "b.pth"), _read_weights),
        Reader("dataparser", _transform, ("dataparser_transforms.json",), _read_transform),
        Reader("truth", files_of(_write_truth), ("depth.png", "normal.png", "objects.png", "diffuse.png"),
               _read_truth),
    )
}  # fmt: skip
