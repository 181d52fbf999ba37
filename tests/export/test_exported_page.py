"""The page of a run: what is in it, and, where a browser is there, what it shows."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.export.environment import Environment, as_bytes, bake_environment
from rtgs.export.glass import GlassObject
from rtgs.export.page import GlassScene, write_page
from rtgs.export.spz import read_spz
from rtgs.gaussians.surfels import Surfels
from rtgs.light.pictures import panorama_directions, upright
from rtgs.render.orbit import Orbit, Picture, orbit_cameras
from rtgs.render.splats import render_splats
from rtgs.train.held_out import psnr_of
from tests.export.test_bake import some
from tests.view import chromium

DOWN = np.array([0.0, -1.0, 0.0])  # up in a capture whose y points down
FRAME = upright(DOWN, np.array([0.0, 0.0, 1.0]))
CAMERAS = [
    replace(camera, name=str(k))
    for k, camera in enumerate(
        orbit_cameras(Orbit(torch.zeros(3, dtype=torch.float64), 4.0, torch.from_numpy(DOWN)), Picture(96, 96, 40.0), 4)
    )
]


def square(size: float) -> GlassObject:
    """A pane that the first camera looks at squarely."""
    right, down, forward = CAMERAS[0].rotation.numpy()
    corners = np.stack([size * (x * right + y * down) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    normals = np.repeat(-forward[None], 4, 0)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    return GlassObject(corners.astype(np.float32), normals.astype(np.float32), faces, 1.5, (1.0, 1.0, 1.0), 0.0)


def light(directions: np.ndarray) -> np.ndarray:
    """Blue from above, green from below, red from the right of ahead."""
    up, right = directions @ FRAME[1], directions @ FRAME[0]
    return np.stack((right.clip(0, 1), (-up).clip(0, 1), up.clip(0, 1)), -1).astype(np.float32)


def written(path: Path, splats: Surfels, glass: GlassObject | None = None, inside: torch.Tensor | None = None) -> Path:
    scene = None
    if glass is not None:
        environment = Environment(light(panorama_directions(64, FRAME)), 0.0)
        inside = torch.zeros(len(splats), dtype=torch.bool) if inside is None else inside
        scene = GlassScene(glass, environment, inside, np.zeros(3), True)
    write_page(path, "a <b> & c", splats, CAMERAS, np.zeros(3), FRAME, 4.0, glass=scene)
    return path


def parts(path: Path) -> dict[str, bytes]:
    text = path.read_text(encoding="utf-8")
    found = re.findall(r'<script type="text/plain" id="(\w+)">([^<]*)</script>', text)
    return {name: base64.b64decode(data) for name, data in found}


def model(path: Path) -> dict:
    found = re.search(r'<script type="application/json" id="model">(.*)</script>', path.read_text(encoding="utf-8"))
    assert found is not None
    return json.loads(found[1])


def test_everything_is_in_the_file(tmp_path):
    splats = some(Surfels, 20, 1)
    inside = torch.arange(20) < 7
    page = written(tmp_path / "a.html", splats, square(1.0), inside)
    text = page.read_text(encoding="utf-8")
    assert "a &lt;b&gt; &amp; c" in text
    assert "<b> & c" not in text
    assert not re.search(r"(src|href)=[\"']?(https?:|//|[\w./]+\.js)", text)
    assert text.count("The MIT License") + text.count("MIT License") >= 3
    found = parts(page)
    assert set(found) == {"vendor", "outside", "inside", "glass", "environment"}
    assert b"SplatMesh" in gzip.decompress(found["vendor"])
    for name, count in (("inside", 7), ("outside", 13)):
        (tmp_path / "part.spz").write_bytes(found[name])
        assert len(read_spz(tmp_path / "part.spz")) == count
    mesh = gzip.decompress(found["glass"])
    glass = model(page)["glass"]
    assert len(mesh) == 4 * (6 * glass["vertices"] + 3 * glass["faces"])
    assert np.frombuffer(mesh, "<u4")[-6:].max() == 3
    assert page.stat().st_size < 1_500_000


def test_without_glass_there_are_only_splats(tmp_path):
    page = written(tmp_path / "a.html", some(Surfels, 20))
    assert set(parts(page)) == {"vendor", "outside"}
    assert "glass" not in model(page)


def test_the_page_is_upright(tmp_path):
    """Up of the capture is +y of the page, for its frame, its cameras and the picture of the environment."""
    page = written(tmp_path / "a.html", some(Surfels, 20), square(1.0))
    found = model(page)
    turn = np.array(found["turn"]).reshape(4, 4)
    np.testing.assert_allclose(turn[:3, :3] @ DOWN, [0, 1, 0], atol=1e-9)
    place = np.array(found["views"][0]["center"])
    assert place[1] > 0.5  # orbits look down from 15 degrees above
    picture = np.asarray(Image.open(io.BytesIO(parts(page)["environment"])))
    assert picture.shape == (64, 128, 3)
    assert picture[0].argmax(-1).tolist() == [2] * 128  # blue from above in the first row
    assert picture[-1].argmax(-1).tolist() == [1] * 128
    assert picture[32, 96, 0] > 200  # red right of the middle
    assert picture[32, 32, 0] < 10


def test_bright_light_is_scaled_into_eight_bits():
    environment = Environment(np.full((4, 8, 3), 2.5, np.float32), 0.0)
    assert environment.scale == 2.5
    assert (as_bytes(environment) == 255).all()
    assert Environment(np.full((4, 8, 3), 0.5, np.float32), 0.0).scale == 1


class _Lit:
    """A model with light from far away and no set of reflections."""

    parts: dict[str, object] = {}  # noqa: RUF012

    @staticmethod
    def light(directions, roughness=None):
        return torch.from_numpy(light(directions.numpy()))


def test_light_from_far_away_is_baked_as_it_is():
    found = bake_environment(_Lit(), 0, np.zeros(3), 0.1, FRAME, 8)  # type: ignore[arg-type]
    assert found is not None
    assert found.distance == 0
    np.testing.assert_allclose(found.panorama, light(panorama_directions(8, FRAME)), atol=1e-6)


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api")
    binary = chromium.browser()
    if binary is None:
        pytest.skip("no Chromium here")
    software = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=binary, args=software)
        yield opened
        opened.close()


def shown(browser, page: Path, view: int, click: str = "") -> torch.Tensor:
    """(3, 96, 96) of the canvas, in [0, 1]."""
    tab = browser.new_page(viewport={"width": 96, "height": 96})
    tab.goto(f"{page.as_uri()}#view={view}")
    tab.wait_for_selector("body[data-state=shown], body[data-state=failed]", timeout=180_000)
    assert tab.evaluate("document.body.dataset.state") == "shown"
    if click:
        tab.evaluate(f"document.getElementById('{click}').click()")
    tab.evaluate("document.querySelector('header').remove()")
    tab.wait_for_timeout(1500)
    pixels = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    tab.close()
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1) / 255


@pytest.mark.slow
def test_a_browser_shows_the_splats_as_they_are_rendered_here(browser, tmp_path):
    splats = some(Surfels, 60, 1)
    splats.sh_dc = splats.sh_dc.clamp(-1.4, 1.4)
    page = written(tmp_path / "a.html", splats)
    for view in (0, 2):
        assert psnr_of(shown(browser, page, view), render_splats(splats, CAMERAS[view]).clamp(0, 1)) > 25


@pytest.mark.slow
def test_a_browser_shows_what_glass_reflects(browser, tmp_path):
    """From below, a pane that faces the first camera mirrors what is above, and nothing where the glass is off."""
    far = some(Surfels, 10)
    far.means = far.means * 0.01 + torch.tensor([50.0, 0, 0])
    tilted = square(1.0)
    forward, up = CAMERAS[0].rotation[2].numpy(), -CAMERAS[0].rotation[1].numpy()
    for name, toward, channel in (("above", up, 2), ("below", -up, 1)):
        normal = (toward - forward) / np.linalg.norm(toward - forward)  # halfway between the camera and there
        right = CAMERAS[0].rotation[0].numpy()
        along = np.cross(normal, right)
        corners = np.stack([2 * (x * right + y * along) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        normals = np.repeat(normal[None], 4, 0).astype(np.float32)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        pane = replace(tilted, vertices=corners.astype(np.float32), normals=normals, faces=faces)
        page = written(tmp_path / f"{name}.html", far, pane)
        middle = shown(browser, page, 0)[:, 44:52, 44:52].mean((1, 2))
        assert int(middle.argmax()) == channel
        assert middle.max() > 0.2
        off = shown(browser, page, 0, click="mirrors")[:, 44:52, 44:52]
        assert float(off.max()) < 0.05
