"""Camera paths of nerfstudio: what is read of them, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.render.camera_path import from_model_frame, read_camera_path

POSE = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]]
FLAT = [number for row in POSE for number in row]


def written(folder: Path, **changed: Any) -> Path:
    frame = {"camera_to_world": FLAT, "fov": 60, "aspect": 1.5} | changed.pop("frame", {})
    content = {"camera_type": "perspective", "render_width": 90, "render_height": 60, "camera_path": [frame]} | changed
    path = folder / "camera_path.json"
    path.write_text(json.dumps(content))
    return path


def test_a_frame_is_a_camera(tmp_path):
    (camera,) = read_camera_path(written(tmp_path))
    assert (camera.width, camera.height) == (90, 60)
    assert camera.fy == camera.fx == pytest.approx(30 / math.tan(math.radians(30)))
    ahead = torch.tensor([[1.0, 2.5, 0.0]], dtype=torch.float64)  # it looks along -z, with +y up
    pixel, depth = camera.project(ahead)
    assert float(depth) == pytest.approx(5)
    assert pixel[0].tolist() == pytest.approx([45, 30 - camera.fy * 0.1])
    (rows,) = read_camera_path(written(tmp_path, frame={"camera_to_world": POSE}), (30, 20))
    torch.testing.assert_close(rows.center, camera.center)
    assert (rows.width, rows.height, rows.fy) == (30, 20, pytest.approx(camera.fy / 3))


def test_a_camera_of_the_models_frame_sees_the_same(tmp_path):
    (camera,) = read_camera_path(written(tmp_path))
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    shift, scale = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64), 0.5
    point = torch.tensor([2.0, 3.0, -1.0], dtype=torch.float64)  # of the capture
    moved = from_model_frame(camera, torch.cat((turn, shift[:, None]), 1), scale)
    of_model = scale * (turn @ point + shift)
    torch.testing.assert_close(moved.project(point)[0], camera.project(of_model)[0])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"camera_path": []}, "camera_path has 0 cameras"),
        ({"camera_path": {}}, "it has no list camera_path"),
        ({"camera_type": "equirectangular"}, "only perspective cameras"),
        ({"render_width": 1e9}, "render_width"),
        ({"render_height": True}, "render_height is True"),
        ({"camera_path": [7]}, "camera_path.0: camera_to_world"),
        ({"frame": {"camera_to_world": [1, 2, 3]}}, "camera_path.0: camera_to_world is to be 16 numbers"),
        ({"frame": {"camera_to_world": [1e300] * 16}}, "16 numbers up to 1e[+]09"),
        ({"frame": {"camera_to_world": [2, *FLAT[1:]]}}, "no rotation"),
        ({"frame": {"camera_to_world": [-1, *FLAT[1:]]}}, "no rotation"),
        ({"frame": {"fov": 180}}, "fov is 180"),
        ({"frame": {"fov": "wide"}}, "fov is 'wide'"),
    ],
)
def test_what_is_refused(tmp_path, changed, message):
    path = written(tmp_path, **changed)
    with pytest.raises(RtgsError, match=message) as raised:
        read_camera_path(path)
    assert str(path) in str(raised.value)
