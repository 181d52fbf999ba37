"""nerfstudio transforms.json and Blender captures."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.scenes.capture import CaptureError
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    edit_transforms,
    opengl_pose,
    pattern,
    ring_pose,
    save_image,
    write_ply,
    write_transforms,
)
from .test_undistort import FISHEYE, OPENCV, SIZE, pixel_centers, rays_fisheye, rays_opencv


def load(root, **settings):
    return load_scene(SceneSettings(path=str(root), **settings))


def test_opengl_poses_become_world_to_camera(tmp_path):
    scene = load(write_transforms(tmp_path))
    view = scene.train[0]
    rotation, translation = ring_pose(1, 10)
    assert view.name == "images/photo_01.png"
    np.testing.assert_allclose(view.camera.rotation.numpy(), rotation, atol=1e-12)
    np.testing.assert_allclose(view.camera.translation.numpy(), translation, atol=1e-12)
    assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == PINHOLE
    pixel, depth = view.camera.project(torch.zeros(3, dtype=torch.float64))
    assert depth > 0  # the ring looks at the origin
    np.testing.assert_allclose(pixel.numpy(), PINHOLE[2:], atol=1e-9)


def test_poses_of_three_digits_become_rotations_about_the_same_camera_centre(tmp_path):
    root = write_transforms(tmp_path)

    def rounded(content):
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, :3] = matrix[:3, :3].round(3)
            frame["transform_matrix"] = matrix.tolist()

    edit_transforms(root, rounded)
    content = json.loads((root / "transforms.json").read_text())
    centers = {frame["file_path"]: np.array(frame["transform_matrix"])[:3, 3] for frame in content["frames"]}
    for view in load(root).train:
        rotation = view.camera.rotation.numpy()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(view.camera.center.numpy(), centers[view.name], atol=1e-12)


def test_frames_override_and_missing_keys_have_defaults(tmp_path):
    root = write_transforms(tmp_path, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, camera_angle_x=1.0)
    edit_transforms(root, lambda content: content["frames"][1].update(fl_x=70.0, cy=20.0))
    first, second = load(root).train[0].camera, load(root).train[1].camera
    focal = 0.5 * WIDTH / math.tan(0.5)
    assert (second.fx, second.fy, second.cx, second.cy) == (focal, focal, WIDTH / 2, HEIGHT / 2)
    assert (first.fx, first.fy, first.cy) == (70.0, 70.0, 20.0)


def test_file_path_without_suffix_or_with_dot(tmp_path):
    root = write_transforms(tmp_path)
    edit_transforms(
        root, lambda c: [f.update(file_path="./" + f["file_path"].removesuffix(".png")) for f in c["frames"]]
    )
    assert load(root).train[0].name == "images/photo_01"


@pytest.mark.parametrize(
    ("model", "names", "params", "inverse"),
    [
        ("OPENCV", ("k1", "k2", "p1", "p2"), OPENCV, rays_opencv),
        ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4"), FISHEYE, rays_fisheye),
    ],
)
def test_distortion_is_undone(tmp_path, model, names, params, inverse):
    root = write_transforms(tmp_path, views=4, camera_model=model, w=SIZE[0], h=SIZE[1])
    edit_transforms(root, lambda c: c.update(zip(("fl_x", "fl_y", "cx", "cy", *names), params)))
    rays = inverse(pixel_centers(*SIZE))
    for path in (root / "images").iterdir():
        save_image(path, pattern(rays[..., 0], rays[..., 1]))
    view = load(root).train[0]
    rays = view.camera.camera_rays().numpy()
    error = np.abs(view.image.permute(1, 2, 0).numpy() - pattern(rays[..., 0], rays[..., 1]))
    assert error.mean() < 2e-3


def test_points_masks_and_normals_named_by_the_file(tmp_path):
    root = write_transforms(tmp_path, ply_file_path="sparse.ply", frame_keys={"mask_path": "m/all.png"})
    rng = np.random.default_rng(1)
    positions, colors = rng.uniform(-1, 1, (40, 3)), rng.integers(0, 256, (40, 3))
    write_ply(root / "sparse.ply", positions, colors)
    save_image(root / "m/all.png", np.full((HEIGHT, WIDTH), 255, dtype=np.uint8))
    scene = load(root)
    np.testing.assert_allclose(scene.points.numpy(), positions, atol=1e-6)
    np.testing.assert_allclose(scene.point_colors.numpy(), colors / 255, atol=1e-6)
    assert all(view.mask is not None and bool(view.mask.all()) for view in scene.train + scene.test)
    write_ply(root / "sparse.ply", positions)
    assert (load(root).point_colors == 0.5).all()


def test_without_points_random_ones_fill_the_place_the_cameras_look_at(tmp_path):
    root = write_transforms(tmp_path)
    scene = load(root, random_points=3000)
    assert scene.points.shape == (3000, 3)
    assert "random" in scene.source
    spread = scene.points.abs().amax(0)
    assert (spread > 3.5).all()
    assert (spread < 4.6).all()  # the ring's radius is about 4
    assert torch.equal(scene.points, load(root, random_points=3000).points)
    assert not torch.equal(scene.points, load(root, random_points=3000, seed=1).points)
    assert load(root, random_box=0.5).points.abs().max() < 0.6


def test_the_files_own_split(tmp_path):
    names = [f"images/photo_{index:02d}.png" for index in range(10)]
    root = write_transforms(tmp_path, train_filenames=names[:7], test_filenames=names[7:9])
    scene = load(root)
    assert [view.name for view in scene.train] == names[:7]
    assert [view.name for view in scene.test] == names[7:9]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.update(frames=[]), "holds no frames"),
        (lambda c: c["frames"][2].pop("transform_matrix"), r"frame 2 \(images/photo_02.png\) has no transform_matrix"),
        (lambda c: c["frames"][2].update(transform_matrix=[[1, 0], [0, 1]]), r"frame 2 .* has shape \(2, 2\)"),
        (lambda c: c["frames"][2].update(transform_matrix="no"), "frame 2 .* is no number"),
        (lambda c: c.update(fl_x="wide"), "fl_x='wide' is no number"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "no focal length"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "camera_model 'EQUIRECTANGULAR' is not supported"),
        (lambda c: c.update(ply_file_path="gone.ply"), "gone.ply .* does not exist"),
        (
            lambda c: c.update(train_filenames=["x.png"], test_filenames=["y.png"]),
            "names images without a frame: x.png",
        ),
        (lambda c: c["frames"][3].pop("file_path"), "frame 3 has no file_path"),
        (
            lambda c: c["frames"][3].update(transform_matrix=(2 * np.array(opengl_pose(3, 10))).tolist()),
            "no rotations .*photo_03.png",
        ),
    ],
)
def test_malformed_files_say_where_and_what(tmp_path, edit, message):
    root = write_transforms(tmp_path)
    edit_transforms(root, edit)
    with pytest.raises(CaptureError, match=message):
        load(root)


def test_broken_json_and_point_files(tmp_path):
    root = write_transforms(tmp_path, ply_file_path="sparse.ply")
    (root / "sparse.ply").write_text("this is no ply")
    with pytest.raises(CaptureError, match=r"sparse.ply is no PLY file"):
        load(root)
    (root / "transforms.json").write_text('{"frames": [')
    with pytest.raises(CaptureError, match="not valid JSON"):
        load(root)


def write_blender(root, train=6, test=2):
    color = np.zeros((20, 30, 4), dtype=np.uint8)
    color[:10] = (200, 100, 50, 255)
    color[10:15] = (200, 100, 50, 51)
    for part, count, offset in (("train", train, 0), ("test", test, train)):
        frames = []
        for index in range(count):
            (root / part).mkdir(parents=True, exist_ok=True)
            Image.fromarray(color).save(root / part / f"r_{index}.png")
            pose = opengl_pose(index + offset, train + test)
            frames.append({"file_path": f"./{part}/r_{index}", "transform_matrix": pose})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (root / f"transforms_{part}.json").write_text(json.dumps(content))
    return root


def test_blender_capture(tmp_path):
    scene = load(write_blender(tmp_path), background=(1.0, 0.0, 0.5))
    assert [view.name for view in scene.train] == [f"train/r_{index}" for index in range(6)]
    assert [view.name for view in scene.test] == ["test/r_0", "test/r_1"]
    view = scene.train[1]
    rotation, _ = ring_pose(1, 8)
    np.testing.assert_allclose(view.camera.rotation.numpy(), rotation, atol=1e-12)
    assert view.camera.fx == view.camera.fy == pytest.approx(15 / math.tan(0.35))
    assert (view.camera.cx, view.camera.cy) == (15.0, 10.0)
    opaque = torch.tensor([200, 100, 50]) / 255
    background = torch.tensor([1.0, 0.0, 0.5])
    torch.testing.assert_close(view.image[:, 0, 0], opaque)
    torch.testing.assert_close(view.image[:, 12, 0], 0.2 * opaque + 0.8 * background)
    torch.testing.assert_close(view.image[:, 19, 0], background)
    assert len(scene.points) > 19_000
    assert 1.25 < scene.points.abs().max() <= 1.3


def test_blender_without_test_part_splits_by_settings(tmp_path):
    root = write_blender(tmp_path, train=9, test=1)
    (root / "transforms_test.json").unlink()
    scene = load(root)
    assert [view.name for view in scene.test] == ["train/r_0", "train/r_8"]


def test_blender_angle_of_view_is_checked(tmp_path):
    root = write_blender(tmp_path)
    edit_transforms(root, lambda c: c.update(camera_angle_x=50), "transforms_train.json")
    with pytest.raises(CaptureError, match="camera_angle_x=50 must be an angle of view in radians"):
        load(root)
