"""Pictures of a light: the right way up, not mirrored, and back again."""

import cv2
import numpy as np
import torch

from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import texel_directions
from rtgs.light.pictures import (
    face_directions,
    light_picture,
    mean_frame,
    panorama_directions,
    save_environment,
    upright,
)
from rtgs.light.settings import CubemapSettings

UP, AHEAD = np.array([0.2, -1.0, 0.1]), np.array([0.3, 0.1, 1.0])


def coloured(side: int = 32) -> CubemapLight:
    """Red is 1 straight up, green 1 to the right of ahead, blue 1 ahead; each falls with the cosine to 0 behind."""
    right, up, back = upright(UP, AHEAD)
    axes = np.stack((up, right, -back))
    values = 0.5 + 0.5 * texel_directions(side) @ axes.T
    settings = CubemapSettings(side=side, activation="identity")
    return CubemapLight(torch.from_numpy(values).float().reshape(6, side, side, 3), settings)


def test_up_is_up_right_is_right_and_ahead_is_in_the_middle():
    picture = light_picture(coloured(), panorama_directions(64, upright(UP, AHEAD)))
    assert picture.shape == (64, 128, 3)
    assert picture[0, :, 0].min() > 0.99
    assert picture[-1, :, 0].max() < 0.01
    assert np.unravel_index(picture[..., 2].argmax(), (64, 128))[1] in (63, 64)
    assert np.unravel_index(picture[..., 1].argmax(), (64, 128))[1] in (95, 96)
    row, column = np.unravel_index(picture[..., 1].argmin(), (64, 128))
    assert column in (31, 32)
    assert row in (31, 32)


def test_faces_are_those_of_opengl():
    """Middle of +x right, +y up, -z ahead; on +x columns run to -z, rows down (OpenGL 4.6, table 8.19)."""
    picture = light_picture(coloured(), face_directions(32, upright(UP, AHEAD)))
    middle = picture[:, 15:17, 15:17].mean((1, 2))
    np.testing.assert_allclose(middle[:, 1], [1, 0, 0.5, 0.5, 0.5, 0.5], atol=0.02)
    np.testing.assert_allclose(middle[:, 0], [0.5, 0.5, 1, 0, 0.5, 0.5], atol=0.02)
    np.testing.assert_allclose(middle[:, 2], [0.5, 0.5, 0.5, 0.5, 0, 1], atol=0.02)
    assert picture[0, 16, -1, 2] > 0.8 > 0.2 > picture[0, 16, 0, 2]
    assert picture[0, 0, 16, 0] > 0.8 > 0.2 > picture[0, -1, 16, 0]


def test_files_hold_the_light_encoded_and_linear(tmp_path):
    frame = upright(UP, AHEAD)
    png, hdr, cube = save_environment(tmp_path / "environment", coloured(), frame, 16)
    expected = light_picture(coloured(), panorama_directions(32, frame))
    seen = cv2.imread(str(png))[..., ::-1] / 255
    np.testing.assert_allclose(seen, expected, atol=0.51 / 255)
    linear = cv2.imread(str(hdr), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_allclose(linear, ((expected.clip(0.0405) + 0.055) / 1.055) ** 2.4, atol=0.01)
    np.testing.assert_allclose(np.load(cube), light_picture(coloured(), face_directions(16, frame)))


def test_the_frame_of_cameras_is_their_mean_up_and_where_the_first_looks():
    first = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])  # x right, y down, z forward
    second = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    right, up, back = mean_frame(torch.from_numpy(np.stack((first, second))))
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(back, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    opposed = mean_frame(torch.from_numpy(np.stack((first, np.diag([1.0, -1, -1])))))
    np.testing.assert_allclose(opposed[1], [0, -1, 0], atol=1e-12)
    along = upright(np.array([0, 0, 2.0]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(along @ along.T, np.eye(3), atol=1e-12)
