"""The tool that compares environment maps with the true one: its pictures, its directions, its score."""

import math

import numpy as np
import pytest
import torch

from benchmarks.quality.environment import (
    HEIGHT,
    face_axes,
    largest_mirror,
    looked_up,
    mirrored,
    psnr,
    shipped,
    solid_angles,
    with_gain,
)
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.light.pictures import panorama_directions
from rtgs.optics.light import decoded, encoded
from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape, Viewpoints, named_scene


def test_faces_are_looked_up_where_they_lie():
    """Colours that are directions come back as the directions, up to half a texel."""
    frame = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rays = panorama_directions(HEIGHT, frame)
    axes = face_axes()
    places = (2 * np.arange(HEIGHT) + 1) / HEIGHT - 1
    local = np.stack(np.broadcast_arrays(places[None], places[:, None], 1.0), -1)
    faces = np.einsum("rcj,fjk->frck", local / np.linalg.norm(local, axis=-1, keepdims=True), axes)
    assert np.abs(looked_up(faces, rays) - rays).max() < 1.5 / HEIGHT
    np.testing.assert_allclose(np.einsum("fij,fkj->fik", axes, axes), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)
    assert np.allclose(np.linalg.det(axes), 1)


def test_a_gain_is_taken_out_in_linear_light_where_it_counts():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.2, 0.9, (HEIGHT, 2 * HEIGHT, 3)).astype(np.float32)
    weight = solid_angles() * (rng.random((HEIGHT, 2 * HEIGHT)) < 0.5)
    darker = decoded(torch.from_numpy(truth), "linear") * torch.tensor([0.5, 0.7, 0.9])
    found = encoded(darker, "linear").numpy()
    found[weight == 0] = 1.0
    assert psnr(found, truth, weight) < 20
    assert psnr(with_gain(found, truth, weight), truth, weight) > 60
    assert psnr(truth + 0.1, truth, np.ones_like(weight)) == pytest.approx(20, abs=0.3)
    assert float(solid_angles().sum() * 2 * HEIGHT) == pytest.approx(2 * HEIGHT * 2 * HEIGHT / math.pi, rel=1e-3)


def ball_scene(**material) -> SceneDescription:
    ball = Shape("ball", "sphere", Material("mirror", **material), size=(0.5, 0.5, 0.5))
    return SceneDescription("one", "one", (ball,), Viewpoints())


def test_the_largest_sharp_mirror_is_taken():
    spheres = named_scene("spheres")
    assert spheres.shapes[largest_mirror(spheres)].name == "silver"
    with pytest.raises(RtgsError, match="no mirror ball"):
        largest_mirror(ball_scene(roughness=0.2))


def test_a_run_of_a_table_has_its_scene_by_a_label():
    assert shipped("spheres (stand-in)") == shipped("spheres") == named_scene("spheres")
    with pytest.raises(ValueError, match="no synthetic scene 'far_balls'"):
        shipped("far_balls")


def test_a_ball_mirrors_what_is_behind_the_camera_in_its_middle():
    pytest.importorskip("mitsuba")
    forward = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    rotation = torch.stack((torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, -1.0]), forward.float())).double()
    camera = Camera(rotation, -rotation @ (-3 * forward), 40.0, 40.0, 4.5, 4.5, 9, 9, "one")
    frame = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # ahead is +y, so behind the camera is the seam
    counts = mirrored(ball_scene(roughness=0.0), 0, [camera], frame, 0)
    assert counts.sum() > 20
    assert counts[HEIGHT // 2 - 1 : HEIGHT // 2 + 1, [0, -1]].sum() >= 1
    assert counts[HEIGHT // 2 - 1 : HEIGHT // 2 + 1, HEIGHT - 1 : HEIGHT + 1].sum() == 0
