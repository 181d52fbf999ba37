"""``rtgs show``: pictures of a file, figures against a capture, nerfstudio's frame, and what it refuses."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.cli.main import main
from pipelines.cli.show import _moved, read_transform
from rtgs.config import compose
from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.initialize import gaussians_from_points
from rtgs.gaussians.ply import write_ply
from rtgs.gaussians.settings import InitSettings
from rtgs.render.splats import render_splats
from rtgs.scenes.scene import load_scene


@pytest.fixture(scope="module")
def demo():
    config, _ = compose(["scene=demo", "scene.long_side=80"])
    return load_scene(config.scene)


@pytest.fixture
def splat(tmp_path, demo):
    """Ellipsoids at the demo's points, opaque."""
    settings = InitSettings(opacity=0.9, sh_degree=1, random_rotation=False)
    generator = torch.Generator().manual_seed(0)
    found = gaussians_from_points(Ellipsoids, demo.points, demo.point_colors, settings, generator).detached()
    write_ply(tmp_path / "model.ply", found)
    return tmp_path / "model.ply", found


def test_frames_and_a_page(splat, tmp_path, capsys):
    path, found = splat
    out = tmp_path / "out"
    assert main(["show", str(path), "--out", str(out), "--frames", "3", "--size", "48x32", "--up", "0,0,1"]) == 0
    text = capsys.readouterr().out
    assert f"{len(found):,} ellipsoids, SH degree 1" in text
    frames = sorted((out / "frames").glob("*.png"))
    assert [frame.name for frame in frames] == ["000.png", "001.png", "002.png"]
    pixels = [np.asarray(Image.open(frame)) for frame in frames]
    assert {picture.shape for picture in pixels} == {(32, 48, 3)}
    assert all(picture.any() for picture in pixels)
    assert (pixels[0] != pixels[1]).any()
    page = (out / "turntable.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 3
    assert "http" not in page
    assert "<title>model.ply</title>" in page


def test_a_file_without_gaussians_is_refused(splat, tmp_path, capsys):
    _, found = splat
    empty = tmp_path / "empty.ply"
    write_ply(empty, found.like({name: values[:0] for name, values in found.items()}))
    assert main(["show", str(empty)]) == 1
    assert "empty.ply holds 0 Gaussians" in capsys.readouterr().err


def test_a_capture_measures_it(splat, tmp_path, demo, capsys):
    path, found = splat
    out = tmp_path / "out"
    words = ["show", str(path), "--scene", "demo", "scene.long_side=80", "--out", str(out), "--frames", "0"]
    assert main(words) == 0
    assert "SSIM" in capsys.readouterr().out
    record = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert record["facts"]["surfels"] == len(found)
    assert len(record["views"]) == len(demo.test) == len(list((out / "renders").glob("*.png")))
    assert len(list((out / "errors").glob("*.png"))) == len(demo.test)
    assert not (out / "frames").exists()
    view = demo.test[0]
    image = render_splats(found, view.camera, near=min(0.2, 0.02 * demo.extent)).clamp(0, 1)
    mse = float((image - view.image).square().mean())
    assert record["views"][0]["values"]["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-3)


def test_a_model_in_nerfstudios_frame_is_seen_alike(tmp_path, splat, demo):
    _, found = splat
    angle = 0.7
    rotation = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]], dtype=torch.float64
    )
    offset, scale = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64), 0.25
    record = {"transform": torch.cat((rotation, offset[:, None]), 1).tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(record))
    moved = found.detached()
    moved.means = (scale * (found.means.double() @ rotation.T + offset)).float()
    moved.log_scales += math.log(scale)
    transform = read_transform(tmp_path / "dataparser_transforms.json")
    assert transform is not None
    camera = demo.test[0].camera
    expected = render_splats(found, camera, near=0.02)
    seen = render_splats(moved, _moved(camera, *transform), near=0.02 * scale)
    assert float((seen - expected).abs().mean()) < 1e-3
    (tmp_path / "other.json").write_text('{"transform": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]], "scale": 1}')
    with pytest.raises(ValueError, match="transform must be 3x4 with a rotation"):
        read_transform(tmp_path / "other.json")
    for scale in ("NaN", "1e999", "0"):
        eye = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]"
        (tmp_path / "other.json").write_text(f'{{"transform": {eye}, "scale": {scale}}}')
        with pytest.raises(ValueError, match="scale positive"):
            read_transform(tmp_path / "other.json")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent.ply"], "absent.ply: no such file"),
        (["{file}", "scene.long_side=80"], "scene.long_side=80: settings of a scene need --scene"),
        (["{file}", "--scene", "demo", "scene.long_side=80", "scene.split_every=0"], "demo|has no test views"),
    ],
)
def test_what_it_refuses(splat, capsys, words, message):
    path, _ = splat
    assert main(["show", *(word.format(file=path) for word in words)]) == 1
    errors = capsys.readouterr().err
    assert any(part in errors for part in message.split("|"))


def test_the_camera_keeps_its_pixels_when_it_is_moved():
    camera = Camera(torch.eye(3), torch.tensor([0.0, 0, 2]), 50, 50, 20, 15, 40, 30)
    matrix = torch.cat((torch.eye(3, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)), 1)
    moved = _moved(camera, matrix, 3.0)
    point = torch.tensor([[0.2, -0.1, 0.4]], dtype=torch.float64)
    torch.testing.assert_close(moved.project(3 * (point + 1))[0], camera.project(point)[0])
    torch.testing.assert_close(moved.project(3 * (point + 1))[1], 3 * camera.project(point)[1])
