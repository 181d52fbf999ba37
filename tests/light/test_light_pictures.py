"""Pictures of a light: the right way up, not mirrored, and back again."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import texel_directions
from rtgs.light.pictures import (
    CUBE,
    FACES,
    PANORAMA,
    RADIANCE,
    face_directions,
    light_picture,
    mean_frame,
    panorama_directions,
    save_environment,
    save_radiance,
    upright,
)
from rtgs.light.settings import CubemapSettings
from rtgs.optics.light import decoded

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


def written(path: Path) -> np.ndarray:
    """(H, W, 3) float32 of an OpenEXR file as another program reads it: Mitsuba, which brings a library of its own."""
    bitmap = pytest.importorskip("mitsuba").Bitmap(str(path))
    assert str(bitmap.pixel_format()).endswith("RGB")
    return np.array(bitmap)


def test_files_hold_the_light_encoded_and_linear(tmp_path):
    frame = upright(UP, AHEAD)
    png, exr, cube = save_environment(tmp_path / "environment", coloured(), frame, 16)
    expected = light_picture(coloured(), panorama_directions(32, frame))
    seen = cv2.imread(str(png))[..., ::-1] / 255
    np.testing.assert_allclose(seen, expected, atol=0.51 / 255)
    linear = written(exr)
    assert linear.dtype == np.float32
    np.testing.assert_allclose(
        linear, np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4), rtol=1e-6
    )
    np.testing.assert_array_equal(linear, decoded(torch.from_numpy(expected), "linear").numpy())
    np.testing.assert_allclose(np.load(cube), light_picture(coloured(), face_directions(16, frame)))
    faces = {f"{name}.{kind}" for name in FACES for kind in ("png", "exr")}
    assert {path.name for path in (tmp_path / "environment").iterdir()} == {PANORAMA, RADIANCE, CUBE} | faces


def test_each_face_has_the_file_that_is_named_after_its_middle(tmp_path):
    """``px`` is right, ``py`` up, ``nz`` ahead; rows and columns are those of the faces that are tested above."""
    frame = upright(UP, AHEAD)
    save_environment(tmp_path, coloured(), frame, 16)
    faces = light_picture(coloured(), face_directions(16, frame))
    brightest = {"py": 0, "px": 1, "nz": 2}  # channel that is 1 in the middle
    for name, face in zip(("px", "nx", "py", "ny", "pz", "nz"), faces, strict=True):
        seen = cv2.imread(str(tmp_path / f"{name}.png"))[..., ::-1] / 255
        np.testing.assert_allclose(seen, face, atol=0.51 / 255)
        if name in brightest:
            assert seen[7:9, 7:9, brightest[name]].mean() > 0.95
        with OpenEXR.File(str(tmp_path / f"{name}.exr")) as file:
            assert "envmap" not in file.header()
        linear = decoded(torch.from_numpy(face), "linear").numpy()
        np.testing.assert_array_equal(written(tmp_path / f"{name}.exr"), linear)


@dataclass(frozen=True)
class Spot:
    """Orange of 40 within 6 degrees of a direction, 0 elsewhere: brighter than a picture of 8 bit can show."""

    middle: np.ndarray

    def __call__(self, directions: torch.Tensor, roughness: torch.Tensor | None = None) -> torch.Tensor:
        near = directions @ torch.from_numpy(self.middle).to(directions) > np.cos(np.radians(6))
        return near[:, None] * torch.tensor([40.0, 20.0, 0.0])

    def irradiance(self, normals: torch.Tensor) -> torch.Tensor:
        return self(normals)


@pytest.mark.parametrize(("row", "column"), [(20, 100), (50, 30), (8, 3)])
def test_a_spot_lies_where_the_layout_of_openexr_has_its_direction(tmp_path, row: int, column: int):
    """Latitude falls from pi / 2 with the rows, longitude from pi with the columns, the latter from ahead to the left
    (OpenEXR, ``ImfEnvmap.h``): with x left, y up, z ahead the direction is (sin o cos a, sin a, cos o cos a)."""
    height, frame = 64, upright(UP, AHEAD)
    latitude, longitude = np.pi * (0.5 - (row + 0.5) / height), np.pi * (1 - (column + 0.5) / height)
    right, up, back = frame
    flat = np.cos(latitude)
    middle = -np.sin(longitude) * flat * right + np.sin(latitude) * up - np.cos(longitude) * flat * back
    png, exr, _ = save_environment(tmp_path, Spot(middle), frame, height // 2)
    linear = written(exr)
    assert linear.shape == (height, 2 * height, 3)
    np.testing.assert_allclose(linear[row, column], [((v + 0.055) / 1.055) ** 2.4 for v in (40, 20)] + [0], rtol=1e-5)
    rows, columns = np.nonzero(linear[..., 0])
    assert abs(rows - row).max() <= 3
    around = (columns - column + height) % (2 * height) - height
    assert abs(around.mean()) < 1
    assert np.array_equal(linear[..., 0] > 0, cv2.imread(str(png))[..., 2] == 255)


def test_the_file_says_that_it_is_a_map_of_longitude_and_latitude(tmp_path):
    _, exr, _ = save_environment(tmp_path, coloured(), upright(UP, AHEAD), 4)
    with OpenEXR.File(str(exr)) as file:
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG
        assert sorted(channel.name for channel in file.header()["channels"]) == ["B", "G", "R"]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_light_that_is_not_finite_is_refused_and_nothing_is_written(tmp_path, bad: float):
    linear = np.zeros((4, 8, 3), np.float32)
    linear[1, 2, 0] = linear[3, 3, 2] = bad
    with pytest.raises(RtgsError, match=r"a\.exr: 2 pixels .* NaN or infinite"):
        save_radiance(tmp_path / "a.exr", linear)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_says_so_and_leaves_the_old_one(tmp_path):
    with pytest.raises(RtgsError, match=r"gone.*cannot be written"):
        save_radiance(tmp_path / "gone" / "a.exr", np.zeros((4, 8, 3), np.float32))
    (tmp_path / "a.exr").write_bytes(b"old")
    with pytest.raises(RtgsError, match="NaN"):
        save_radiance(tmp_path / "a.exr", np.full((4, 8, 3), np.nan, np.float32))
    assert (tmp_path / "a.exr").read_bytes() == b"old"


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
