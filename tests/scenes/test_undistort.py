"""Lenses: a known pattern of the viewing ray is photographed through each model and must come back straight.

The formulas of OPENCV and OPENCV_FISHEYE are written out here, independent of pycolmap; the other models take
pycolmap's inverse as oracle.
"""

from __future__ import annotations

import numpy as np
import pytest

from rtgs.scenes.capture import CaptureError
from rtgs.scenes.images import read_normals
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.undistort import Lens, check_lens, project, undistorted_lens, undistortion_map

from .captures import ColmapCapture, pattern, pixel_centers, save_image

SIZE = (160, 120)
OPENCV = (150.0, 146.0, 83.0, 58.0, -0.18, 0.05, 0.004, -0.003)
FISHEYE = (80.0, 82.0, 78.0, 61.0, 0.03, -0.01, 0.002, -0.001)
OTHERS = {
    "SIMPLE_RADIAL": (150.0, 80.0, 60.0, -0.15),
    "RADIAL": (150.0, 80.0, 60.0, 0.1, 0.02),
    "FULL_OPENCV": (150.0, 146.0, 80.0, 60.0, -0.2, 0.05, 0.001, -0.001, 0.01, 0.0, 0.0, 0.0),
    "FOV": (150.0, 148.0, 80.0, 60.0, 0.6),
    "SIMPLE_RADIAL_FISHEYE": (80.0, 80.0, 60.0, 0.02),
    "RADIAL_FISHEYE": (80.0, 80.0, 60.0, 0.02, 0.001),
    "THIN_PRISM_FISHEYE": (80.0, 80.0, 80.0, 60.0, 0.02, 0.001, 0.001, 0.001, 0.0, 0.0, 0.001, 0.001),
}


def rays_opencv(pixels: np.ndarray) -> np.ndarray:
    """Invert OpenCV's polynomial and tangential model by fixed-point iteration."""
    fx, fy, cx, cy, k1, k2, p1, p2 = OPENCV
    xd, yd = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    x, y = xd.copy(), yd.copy()
    for _ in range(100):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        x, y = (
            (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    return np.stack([x, y], axis=-1)


def rays_fisheye(pixels: np.ndarray) -> np.ndarray:
    """Invert OpenCV's equidistant fisheye by Newton's method on the angle."""
    fx, fy, cx, cy, *k = FISHEYE
    xd, yd = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    rd = np.hypot(xd, yd)
    theta = rd.copy()
    for _ in range(30):
        powers = [theta ** (2 * i + 2) for i in range(4)]
        value = theta * (1 + sum(c * p for c, p in zip(k, powers))) - rd
        slope = 1 + sum((2 * i + 3) * c * p for i, (c, p) in enumerate(zip(k, powers)))
        theta = theta - value / slope
    scale = np.tan(theta) / np.maximum(rd, 1e-12)
    return np.stack([xd * scale, yd * scale], axis=-1)


def rays_pycolmap(model: str, params: tuple[float, ...], pixels: np.ndarray) -> np.ndarray:
    """The inverse of any model as COLMAP computes it."""
    import pycolmap

    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=list(params))
    return np.asarray(camera.cam_from_img(pixels.reshape(-1, 2))).reshape(pixels.shape)


def oracle(model: str, params: tuple[float, ...], pixels: np.ndarray) -> np.ndarray:
    """Viewing rays (..., 2) of distorted pixels."""
    if model == "OPENCV":
        return rays_opencv(pixels)
    if model == "OPENCV_FISHEYE":
        return rays_fisheye(pixels)
    return rays_pycolmap(model, params, pixels)


def write(root, model, params, views=4):
    rays = oracle(model, params, pixel_centers(*SIZE))
    picture = pattern(rays[..., 0], rays[..., 1])
    return ColmapCapture(root, views=views, model=model, params=params, size=SIZE, picture=lambda _: picture).write()


@pytest.mark.parametrize(("model", "params"), [("OPENCV", OPENCV), ("OPENCV_FISHEYE", FISHEYE), *OTHERS.items()])
def test_undistorted_photos_show_the_pattern_of_their_rays(tmp_path, model, params):
    view = load_scene(SceneSettings(path=str(write(tmp_path, model, params)))).train[0]
    rays = view.camera.camera_rays().numpy()
    image = view.image.permute(1, 2, 0).numpy()
    error = np.abs(image - pattern(rays[..., 0], rays[..., 1]))
    shifted = np.abs(image - pattern(rays[..., 0] + 0.5 / view.camera.fx, rays[..., 1]))
    assert error.mean() < 2e-3
    assert error.max() < 0.04
    assert shifted.mean() > 4 * error.mean()  # half a pixel would have been noticed
    assert view.camera.width * view.camera.height > 0.6 * SIZE[0] * SIZE[1]  # COLMAP keeps most of the photo


def test_distortion_of_zero_is_a_pinhole_and_not_resampled(tmp_path):
    params = (150.0, 146.0, 83.0, 58.0, 0.0, 0.0, 0.0, 0.0)
    view = load_scene(SceneSettings(path=str(write(tmp_path, "FULL_OPENCV", params + (0.0,) * 4)))).train[0]
    assert (view.camera.width, view.camera.height) == SIZE
    assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == params[:4]


def test_shrunk_distorted_photos_are_undistorted_at_their_own_size(tmp_path):
    root = write(tmp_path, "OPENCV", OPENCV)
    rays = rays_opencv(2 * pixel_centers(SIZE[0] // 2, SIZE[1] // 2))
    for path in (root / "images").iterdir():
        save_image(path, pattern(rays[..., 0], rays[..., 1]))
    view = load_scene(SceneSettings(path=str(root))).train[0]
    rays = view.camera.camera_rays().numpy()
    error = np.abs(view.image.permute(1, 2, 0).numpy() - pattern(rays[..., 0], rays[..., 1]))
    assert view.camera.width < 100
    assert error.mean() < 5e-3


def test_masks_and_normals_are_undistorted_too(tmp_path):
    root = write(tmp_path, "OPENCV", OPENCV)
    rays = rays_opencv(pixel_centers(*SIZE))
    save_image(root / "masks/photo_01.png", (rays[..., 0] > 0.1).astype(np.uint8) * 255)
    normal = np.stack([0.5 * rays[..., 0], 0.5 * rays[..., 1], -np.ones(rays.shape[:2])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    save_image(root / "normals/photo_01.png", (normal + 1) / 2)
    view = load_scene(SceneSettings(path=str(root))).train[0]
    assert view.mask is not None
    assert view.normal is not None
    x, y = np.moveaxis(view.camera.camera_rays().numpy()[..., :2], -1, 0)
    wrong = view.mask.numpy() != (x > 0.1)
    assert wrong.mean() < 0.01
    assert (np.abs(x[wrong] - 0.1) < 1.0 / view.camera.fx).all()  # only the pixels on the edge
    expected = np.stack([0.5 * x, 0.5 * y, -np.ones_like(x)])
    expected /= np.linalg.norm(expected, axis=0)
    np.testing.assert_allclose(view.normal.numpy(), expected, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(view.normal.numpy(), axis=0), 1, atol=1e-5)
    assert read_normals(root / "normals/photo_01.png").shape == (SIZE[1], SIZE[0], 3)


def test_the_map_is_exact_where_the_formula_is_known():
    lens = Lens("OPENCV", *SIZE, OPENCV)
    target = lens.pinhole()
    column, row = undistortion_map(lens)[:, 40, 100]
    fx, fy, cx, cy = target.params
    expected = np.array([(100.5 - cx) / fx, (40.5 - cy) / fy])
    np.testing.assert_allclose(rays_opencv(np.array([column + 0.5, row + 0.5])), expected, atol=1e-6)


def test_projection_follows_the_distortion():
    lens = Lens("OPENCV", 120, 90, (80.0, 82.0, 61.0, 44.0, 0.05, -0.02, 0.001, 0.002))
    grid, target = undistortion_map(lens), lens.pinhole()
    fx, fy, cx, cy = target.params
    rays = np.array([[(30.5 - cx) / fx, (20.5 - cy) / fy, 1.0]]) * 3
    np.testing.assert_allclose(project(lens, rays)[0], grid[:, 20, 30] + 0.5, atol=1e-3)
    plain = Lens("PINHOLE", 120, 90, (80.0, 82.0, 61.0, 44.0))
    np.testing.assert_allclose(project(plain, np.array([[1.0, 2.0, 4.0]])), [[81.0, 85.0]])


def test_spherical_and_implausible_lenses_are_refused_with_advice():
    with pytest.raises(CaptureError, match=r"EQUIRECTANGULAR sees all around.*cut the panoramas"):
        undistorted_lens(Lens("EQUIRECTANGULAR", 64, 32, (64.0, 32.0)))
    assert "NaN" in str(check_lens(Lens("PINHOLE", 8, 8, (float("nan"), 1.0, 1.0, 1.0)), "a.png"))
    assert "not positive" in str(check_lens(Lens("PINHOLE", 8, 8, (-1.0, 1.0, 4.0, 4.0)), "a.png"))
    assert "must be positive" in str(check_lens(Lens("PINHOLE", 8, 8, (1.0, -1.0, 4.0, 4.0)), "a.png"))
    assert "image size 0x8" in str(check_lens(Lens("PINHOLE", 0, 8, (1.0, 1.0, 4.0, 4.0)), "a.png"))
    assert check_lens(Lens("OPENCV", *SIZE, OPENCV), "a.png") is None
    outside = Lens("OPENCV", *SIZE, (60.0, 60.0, 80.0, 60.0, -0.5, 0.0, 0.0, 0.0))
    folded = Lens("OPENCV", *SIZE, (100.0, 100.0, 80.0, 60.0, -0.4, 0.0, 0.0, 0.0))
    for lens in (outside, folded):
        with pytest.raises(CaptureError, match="the parameters are not plausible, calibrate again"):
            undistortion_map(lens)
        assert "not plausible" in str(check_lens(lens, "a.png"))
    with pytest.raises(CaptureError, match="takes fx, fy, cx, cy"):
        Lens("OPENCV", 8, 8, (1.0, 2.0, 0.1, 0.1, 0.1)).pinhole()
    with pytest.raises(CaptureError, match="BOGUS"):
        Lens("BOGUS", 8, 8, (1.0,)).pinhole()
