"""The generator against what must be true of any capture: pictures, geometry and poses agree to a pixel."""

import numpy as np
import pytest
import torch
from PIL import Image

mitsuba = pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.scenes.images import read_normals  # noqa: E402
from rtgs.scenes.synthetic.capture import to_srgb, write_capture  # noqa: E402
from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape, Viewpoints  # noqa: E402
from rtgs.scenes.synthetic.render import PathTracer  # noqa: E402
from rtgs.scenes.synthetic.settings import CaptureSettings, FeatureSettings  # noqa: E402
from rtgs.scenes.synthetic.viewpoints import cameras  # noqa: E402
from rtgs.scenes.truth import read_truth  # noqa: E402

GLASS = Material(kind="thin_glass")


def description(*shapes, count=6):
    return SceneDescription(
        "test", "Test", shapes, Viewpoints(count=count, radius=(2.0, 2.2), rings=2), (0.0, 0.0, 0.0)
    )


def test_a_lamp_appears_where_the_camera_projects_it():
    center = torch.tensor([0.25, -0.2, 0.3], dtype=torch.float64)
    lamp = Shape("lamp", "sphere", position=tuple(center.tolist()), size=(0.05, 0, 0), emission=(1.0, 1.0, 1.0))
    described = description(lamp)
    tracer = PathTracer(described)
    for camera in cameras(described.viewpoints, 96, 64)[::2]:
        light = tracer.image(camera, samples=64).sum(-1)
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        centroid = np.array([(x * light).sum(), (y * light).sum()]) / light.sum()
        expected, depth = camera.project(center)
        np.testing.assert_allclose(centroid, expected.numpy(), atol=0.15)
        geometry = tracer.geometry(camera)
        seen = geometry.shape == 0
        assert geometry.depth[seen].min() == pytest.approx(float(depth) - 0.05, abs=0.01)
        assert np.abs(geometry.normal[seen][:, 2]).max() <= 1 + 1e-5
        assert (geometry.normal[seen][:, 2] < 0.3).all()  # facing the camera, which looks along +z


def test_thin_glass_is_in_the_mask_and_looked_through_without_it():
    ball = Shape("ball", "sphere", material=GLASS, size=(0.5, 0, 0))
    core = Shape("core", "sphere", size=(0.1, 0, 0))
    described = description(ball, core)
    tracer = PathTracer(described)
    camera = cameras(described.viewpoints, 64, 64)[0]
    first, behind = tracer.geometry(camera), tracer.geometry(camera, without_glass=True)
    assert set(np.unique(first.shape)) == {-1, 0}
    assert set(np.unique(behind.shape)) == {-1, 1}
    middle = (32, 32)
    assert behind.depth[middle] - first.depth[middle] == pytest.approx(0.4, abs=0.03)


def test_capture_on_disk_is_a_colmap_capture_with_masks_normals_and_truth(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    room = Shape("room", "box", size=(3, 3, 3), inward=True, material=Material(texture="posters"), emission=None)
    lamp = Shape("lamp", "plane", position=(0, 0, 2.9), size=(1.5, 1.5, 0), tilt=180, emission=(3.0, 3.0, 3.0))
    ball = Shape("ball", "sphere", material=GLASS, size=(0.4, 0, 0))
    core = Shape("core", "box", size=(0.15, 0.15, 0.15), material=Material(texture="checker"))
    features = FeatureSettings(points=500)
    settings = CaptureSettings(width=48, height=36, samples=4, test_samples=8, features=features)
    described = description(room, lamp, ball, core)
    capture = tmp_path / "capture"
    write_capture(described, capture, tmp_path / "work", settings)

    model = pycolmap.Reconstruction()
    model.read_text(str(capture / "sparse" / "0"))
    assert model.num_images() == 6
    assert model.num_points3D() > 50
    expected = cameras(described.viewpoints, 48, 36)
    for image in model.images.values():
        camera = next(c for c in expected if c.name == image.name.partition(".")[0])
        pose = np.asarray(image.cam_from_world().matrix())
        np.testing.assert_allclose(pose[:, :3], camera.rotation.numpy(), atol=1e-9)
        np.testing.assert_allclose(pose[:, 3], camera.translation.numpy(), atol=1e-9)
        mask = np.asarray(Image.open(capture / "masks" / f"{camera.name}.png")) > 0
        truth = read_truth(capture / "truth" / camera.name)
        np.testing.assert_array_equal(mask, truth.objects.numpy() == 2)
        np.testing.assert_array_equal(mask, truth.specular.numpy())
        assert 0.01 < mask.mean() < 0.6
        estimated = read_normals(capture / "normals" / f"{camera.name}.png")
        assert estimated.shape == (18, 24, 3)  # half size
        cosine = (estimated * truth.normal[:, 1::2, 1::2].numpy().transpose(1, 2, 0)).sum(-1)
        assert np.median(cosine) > np.cos(np.radians(15))
        assert np.median(cosine) < 1 - 1e-5  # perturbed, as an estimator's are
        behind = truth.second_depth.numpy()
        assert (behind[mask] > truth.depth.numpy()[mask]).all()  # the core or the far side of the ball
    # no point sits on the glass: they are on the core, the walls or the lamp's room
    points = np.stack([p.xyz for p in model.points3D.values()])
    on_glass = np.abs(np.linalg.norm(points, axis=1) - 0.4) < 0.02
    assert on_glass.mean() < 0.02


def test_srgb_encoding_is_the_standard_curve():
    linear = np.array([0.0, 0.002, 0.2158605, 1.0, 4.0], np.float32)
    np.testing.assert_array_equal(to_srgb(linear), np.array([0, 7, 128, 255, 255], np.uint8))
