"""What a scene says of the noise of its test photos, and where it does not know."""

from dataclasses import replace

import numpy as np
import pytest

from rtgs.scenes.canonical import read_scene, save_scene
from rtgs.scenes.importers.embedded import embedded_capture
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.synthetic.noise import ROUNDING
from rtgs.scenes.synthetic.record import CaptureRecord


@pytest.fixture(scope="module")
def record() -> CaptureRecord:
    found = CaptureRecord.read(embedded_capture("matte_room"))
    assert found is not None
    return found


def settings(**words) -> SceneSettings:
    return SceneSettings(name="matte_room", path="embedded:matte_room", **words)


def test_a_path_traced_scene_knows_it_and_stores_it(record, tmp_path):
    scene = load_scene(settings())
    assert scene.noise_psnr == record.noise_psnr
    save_scene(scene, tmp_path / "known")
    assert read_scene(tmp_path / "known").noise_psnr == record.noise_psnr
    save_scene(replace(scene, noise_psnr=None), tmp_path / "unknown")
    assert "noise_psnr" not in (tmp_path / "unknown" / "scene.json").read_text()
    assert read_scene(tmp_path / "unknown").noise_psnr is None


def test_shrunk_photos_and_other_test_views_have_another_one():
    assert load_scene(settings(long_side=64)).noise_psnr is None
    assert load_scene(settings(split_every=6)).noise_psnr is None  # some of these are photos for training
    assert load_scene(settings(split_every=0)).noise_psnr is None


def test_photos_of_fewer_samples_are_noisier_in_proportion(record):
    same = replace(record, samples=64, test_samples=64)
    assert same.photo_noise_psnr == pytest.approx(same.noise_psnr)
    quarter = replace(record, samples=16, test_samples=64, noise_psnr=40.0)
    expected = 4 * (1e-4 - ROUNDING) + ROUNDING
    assert quarter.photo_noise_psnr == pytest.approx(-10 * np.log10(expected))
