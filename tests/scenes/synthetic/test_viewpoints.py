"""Where the cameras stand, and what the wide lens changes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rtgs.scenes.importers.colmap import read_colmap
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.synthetic.colmap_text import write_colmap_text
from rtgs.scenes.synthetic.description import Viewpoints, list_scenes, named_scene
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.scenes.synthetic.viewpoints import cameras

PLAIN = Viewpoints(count=24, target=(0.1, 0.2, 0.3), radius=(2.0, 2.2), elevation=(10.0, 50.0))
WIDE = replace(PLAIN, wide_every=4, wide_elevation=(5.0, 25.0), wide_field_of_view=80.0)


def elevation(camera, target) -> float:
    up = camera.center.numpy() - np.asarray(target)
    return float(np.degrees(np.arcsin(up[2] / np.linalg.norm(up))))


def angle_of_view(camera) -> float:
    return float(2 * np.degrees(np.arctan(0.5 * camera.width / camera.fx)))


def test_the_wide_lens_moves_some_views_and_no_other():
    chosen = [index for index in range(WIDE.count) if WIDE.is_wide(index)]
    assert chosen == [2, 6, 10, 14, 18, 22]
    for index, (plain, wide) in enumerate(zip(cameras(PLAIN, 64, 48, 3), cameras(WIDE, 64, 48, 3))):
        assert plain.name == wide.name
        if index in chosen:
            assert angle_of_view(wide) == pytest.approx(80.0)
            assert elevation(wide, WIDE.target) == pytest.approx((5.0, 15.0, 25.0)[index // 8])
            one, other = ((camera.center.numpy() - np.asarray(WIDE.target))[:2] for camera in (plain, wide))
            assert one @ other == pytest.approx(np.linalg.norm(one) * np.linalg.norm(other))  # the same azimuth
        else:
            assert angle_of_view(wide) == pytest.approx(50.0)
            assert torch.equal(plain.rotation, wide.rotation)
            assert torch.equal(plain.translation, wide.translation)


@pytest.mark.parametrize("scene", list_scenes())
def test_no_test_view_of_a_shipped_scene_is_wide(scene):
    views, settings = replace(named_scene(scene).viewpoints, wide_every=4), CaptureSettings()
    wide = [views.is_wide(index) for index in range(views.count)]
    assert sum(wide) == 12
    assert not any(wide[index] for index in range(views.count) if settings.is_test(index))


def test_two_lenses_are_two_cameras_of_the_model(tmp_path: Path):
    views = [(camera, f"{camera.name}.png") for camera in cameras(WIDE, 64, 48)]
    write_colmap_text(tmp_path / "sparse" / "0", views, np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    assert (tmp_path / "sparse" / "0" / "cameras.txt").read_text().count("PINHOLE 64 48") == 2
    (tmp_path / "images").mkdir()
    for _, name in views:
        (tmp_path / "images" / name).touch()
    capture = read_colmap(SceneSettings(path=str(tmp_path)), tmp_path)
    expected = {name: camera for camera, name in views}
    assert len(capture.views) == len(expected)
    for view in capture.views:
        assert view.lens is not None
        assert view.lens.pinhole().params[0] == pytest.approx(expected[view.name].fx, rel=1e-12)
