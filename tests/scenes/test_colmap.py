"""COLMAP models: folders, binary and text, image folders of other sizes, points, side files."""

from __future__ import annotations

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.scenes.capture import CaptureError
from rtgs.scenes.importers.colmap import find_images, read_colmap
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import HEIGHT, PINHOLE, WIDTH, ColmapCapture, pinhole_picture, ring_pose, save_image


def load(root, **settings):
    return load_scene(SceneSettings(path=str(root), **settings))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_model_is_found_and_read_exactly(tmp_path, text, folder):
    scene = load(ColmapCapture(tmp_path, text=text, folder=folder).write())

    assert [view.name for view in scene.test] == ["photo_00.png", "photo_08.png"]
    assert len(scene.train) == 8
    view = scene.train[0]
    rotation, translation = ring_pose(1, 10)
    np.testing.assert_allclose(view.camera.rotation.numpy(), rotation, atol=1e-12)
    np.testing.assert_allclose(view.camera.translation.numpy(), translation, atol=1e-12)
    assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == PINHOLE
    assert (view.camera.width, view.camera.height, view.camera.name) == (WIDTH, HEIGHT, "photo_01.png")
    assert view.image.shape == (3, HEIGHT, WIDTH)
    assert view.image.dtype == torch.float32
    np.testing.assert_allclose(view.image.permute(1, 2, 0).numpy(), pinhole_picture(), atol=0.6 / 255)
    assert scene.points.shape == scene.point_colors.shape == (60, 3)
    assert scene.points.dtype == scene.point_colors.dtype == torch.float32
    assert scene.point_colors.min() >= 0
    assert 0.5 < scene.point_colors.max() <= 1


def test_points_keep_their_colours_in_file_order(tmp_path):
    ColmapCapture(tmp_path).write()
    rng = np.random.default_rng(0)
    colors, positions = [], []
    for _ in range(60):
        colors.append(rng.integers(0, 256, 3))
        positions.append(rng.uniform(-1, 1, 3))
    scene = load(tmp_path)
    np.testing.assert_allclose(scene.points.numpy(), np.array(positions), atol=1e-6)
    np.testing.assert_allclose(scene.point_colors.numpy(), np.array(colors) / 255, atol=1e-6)


def test_extent_is_that_of_the_training_cameras(tmp_path):
    scene = load(ColmapCapture(tmp_path).write())
    centers = np.array([view.camera.center.numpy() for view in scene.train])
    expected = 1.1 * np.linalg.norm(centers - centers.mean(0), axis=1).max()
    assert scene.extent == pytest.approx(expected, rel=1e-12)


def test_simple_pinhole_has_one_focal_length(tmp_path):
    scene = load(ColmapCapture(tmp_path, model="SIMPLE_PINHOLE", params=(60.0, 32.0, 24.0)).write())
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 60.0, 32.0, 24.0)


def test_shrunk_photos_scale_the_intrinsics(tmp_path):
    root = ColmapCapture(tmp_path, size=(130, 98), images_dir="images_2").write()
    for path in (root / "images_2").iterdir():
        save_image(path, pinhole_picture(width=65, height=49))
    camera = load(root).train[0].camera
    fx, fy, cx, cy = PINHOLE
    assert (camera.width, camera.height) == (65, 49)
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [fx / 2, fy / 2, cx / 2, cy / 2])


def test_truncated_sizes_are_a_pixel_of_rounding_not_a_mismatch(tmp_path):
    root = ColmapCapture(tmp_path, size=(127, 99), images_dir="images_4").write()
    for path in (root / "images_4").iterdir():
        save_image(path, pinhole_picture(width=31, height=24))
    camera = load(root).train[0].camera
    assert camera.fx == pytest.approx(PINHOLE[0] * 31 / 127)
    assert camera.fy == pytest.approx(PINHOLE[1] * 24 / 99)


def test_cropped_photos_are_refused(tmp_path):
    root = ColmapCapture(tmp_path).write()
    save_image(root / "images/photo_03.png", pinhole_picture(width=64, height=40))
    with pytest.raises(CaptureError, match=r"photo_03.png is 64x40 pixels, its camera 64x48: the aspect ratios differ"):
        load(root)


def test_full_images_go_before_shrunk_ones_and_large_before_small(tmp_path):
    root = ColmapCapture(tmp_path).write()
    names = [f"photo_{index:02d}.png" for index in range(10)]
    shutil.copytree(root / "images", root / "images_2")
    shutil.copytree(root / "images", root / "images_480")
    assert find_images(root, None, names).name == "images"
    shutil.rmtree(root / "images")
    for path in (root / "images_2").iterdir():
        save_image(path, pinhole_picture(width=32, height=24))
    assert find_images(root, None, names).name == "images_480"
    assert find_images(root, "images_2", names).name == "images_2"
    with pytest.raises(CaptureError, match=r"images folder .*elsewhere does not exist"):
        find_images(root, "elsewhere", names)


def test_long_side_and_ratio_average_areas(tmp_path):
    root = ColmapCapture(tmp_path).write()
    full = load(root).train[0]
    half = load(root, long_side=32).train[0]
    quarter = load(root, resize_ratio=0.25).train[0]
    assert (half.camera.width, half.camera.height) == (32, 24)
    assert (quarter.camera.width, quarter.camera.height) == (16, 12)
    torch.testing.assert_close(half.image, torch.nn.functional.avg_pool2d(full.image, 2), atol=1e-6, rtol=0)
    torch.testing.assert_close(quarter.image, torch.nn.functional.avg_pool2d(full.image, 4), atol=1e-6, rtol=0)
    assert half.camera.cx == pytest.approx(PINHOLE[2] / 2)
    assert load(root, long_side=500).train[0].camera.width == WIDTH


@pytest.mark.parametrize("text", [False, True])
def test_how_unsure_poses_are_is_read_off_the_points(tmp_path, text):
    """Standard error: the root mean square of the errors over the root of their number, in pixels of training."""
    root = ColmapCapture(tmp_path, text=text, errors=(0.6, 0.8, 2.4)).write()
    expected = np.sqrt((0.6**2 + 0.8**2 + 2.4**2) / 3) / np.sqrt(3)
    assert load(root).pose_error == pytest.approx(expected)
    assert load(root, long_side=WIDTH // 2).pose_error == pytest.approx(expected / 2)
    assert load(root, long_side=2 * WIDTH).pose_error == pytest.approx(expected)


def test_photos_that_were_shrunk_have_smaller_errors(tmp_path):
    root = ColmapCapture(tmp_path, size=(128, 96), images_dir="images_2", errors=(1.0, 1.0)).write()
    for path in (root / "images_2").iterdir():
        save_image(path, pinhole_picture(width=64, height=48))
    assert load(root).pose_error == pytest.approx(0.5 / np.sqrt(2))


def test_points_without_an_error_tell_nothing(tmp_path):
    root = ColmapCapture(tmp_path / "some", errors=(-1.0, 0.9, -1.0)).write()
    assert load(root).pose_error == pytest.approx(0.9)
    assert load(ColmapCapture(tmp_path / "none", errors=(-1.0, 0.0)).write()).pose_error is None
    assert load(ColmapCapture(tmp_path / "unseen").write()).pose_error is None


@pytest.mark.parametrize(("unseen", "told"), [(4, True), (5, False)])  # with the two for test, photos 0 and 8, left out
def test_half_of_the_photos_must_tell(tmp_path, unseen, told):
    root = ColmapCapture(tmp_path, errors=(0.5,), unseen_by=unseen).write()
    assert load(root).pose_error == (pytest.approx(0.5) if told else None)


ITSELF = """
import sys
from pathlib import Path
from rtgs.scenes.importers.colmap import read_colmap
from rtgs.scenes.settings import CaptureError, SceneSettings
sys.executable = sys.argv[2]
try:
    print(len(read_colmap(SceneSettings(path=sys.argv[1]), Path(sys.argv[1])).views), "pycolmap" in sys.modules)
except CaptureError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="names of programs")
@pytest.mark.parametrize(
    ("interpreter", "said"), [("", "10 True"), ("/", "10 True"), (shutil.which("true"), "cannot be read: the process")]
)
def test_a_python_without_an_interpreter_to_start_reads_the_model_itself(tmp_path, interpreter, said):
    """In another program; one that is there but is no Python is told."""
    command = [sys.executable, "-c", ITSELF, str(ColmapCapture(tmp_path).write()), interpreter]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout


def test_track_length_filter_uses_the_model(tmp_path):
    root = ColmapCapture(tmp_path).write()
    capture = read_colmap(SceneSettings(path=str(root), min_track_length=1), root)
    assert capture.points is not None
    assert len(capture.points) == 0  # the test model has no tracks


def test_masks_and_normals_come_along(tmp_path):
    root = ColmapCapture(tmp_path).write()
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[10:20, 30:50] = 7
    save_image(root / "masks/photo_01.png", mask)
    save_image(root / "masks/photo_02.png.png", mask)
    normal = np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32)
    normal[..., 2] = -1
    (root / "normals").mkdir()
    np.save(root / "normals/photo_01.npy", normal)
    views = {view.name: view for view in load(root, long_side=32).train}
    view = views["photo_01.png"]
    assert view.mask is not None
    assert view.mask.dtype == torch.bool
    assert view.mask.sum() == 50
    assert view.mask[5:10, 15:25].all()
    assert views["photo_02.png"].mask is not None
    assert views["photo_03.png"].mask is None
    assert view.normal is not None
    torch.testing.assert_close(view.normal, torch.tensor([0.0, 0.0, -1.0])[:, None, None].expand(3, 24, 32))
    summary = load(root, masks_dir="", normals_dir="").summary()
    assert (summary.masks, summary.normals) == (0, 0)


def test_turned_photos_are_turned_only_where_the_camera_says_so(tmp_path):
    root = ColmapCapture(tmp_path).write()
    upright = (pinhole_picture() * 255).round().astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6  # shown turned by 90 degrees clockwise
    stored = np.ascontiguousarray(np.rot90(upright))
    Image.fromarray(stored).save(root / "images/photo_01.png", exif=exif)  # only the turned photo fits the camera
    Image.fromarray(upright).save(root / "images/photo_02.png", exif=exif)  # the stored pixels fit
    views = {view.name: view for view in load(root).train}
    for name in ("photo_01.png", "photo_02.png"):
        np.testing.assert_allclose(views[name].image.permute(1, 2, 0).numpy(), upright / 255, atol=1e-6)


def test_names_that_include_the_image_folder(tmp_path):
    names = [f"images/photo_{index:02d}.png" for index in range(10)]
    root = ColmapCapture(tmp_path, images_dir=".", names=names, points=120).write()
    save_image(root / "masks/photo_01.png", np.ones((HEIGHT, WIDTH), dtype=np.uint8))
    save_image(root / "masks/images/photo_02.png", np.ones((HEIGHT, WIDTH), dtype=np.uint8))
    scene = load(root)
    assert [view.name for view in scene.train if view.mask is not None] == names[1:3]
    assert read_colmap(SceneSettings(path=str(root)), root).findings == ()


def test_two_models_and_unregistered_photos_are_mentioned(tmp_path):
    root = ColmapCapture(tmp_path).write()
    shutil.copytree(root / "sparse/0", root / "sparse/1")
    for index in range(5):
        save_image(root / f"images/extra_{index}.png", pinhole_picture())
    findings = read_colmap(SceneSettings(path=str(root)), root).findings
    messages = "\n".join(finding.message for finding in findings)
    assert "5 of 15 photos have no pose" in messages
    assert "extra_0.png" in messages
    assert "2 models, only 0 is read" in messages
