"""Training photos made again: the test views stay byte for byte, and another scene's are refused."""

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mitsuba", reason="path tracing needs the extra 'synthetic'")

from rtgs.core.errors import RtgsError
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.synthetic.capture import copy_folder, description_digest, write_capture
from rtgs.scenes.synthetic.description import SceneDescription
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.synthetic.retake import retake
from rtgs.scenes.synthetic.settings import CaptureSettings, FeatureSettings
from rtgs.scenes.synthetic.variants import SCALAR_VARIANT
from tests.scenes.synthetic.test_glass_light import ball_in_a_room

SETTINGS = CaptureSettings(16, 12, samples=1, test_samples=8, truth="test", features=FeatureSettings(points=50))


def with_wide_lens(description: SceneDescription) -> SceneDescription:
    return replace(description, viewpoints=replace(description.viewpoints, wide_every=3))


@pytest.fixture(scope="module")
def earlier(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("earlier")
    write_capture(ball_in_a_room(), folder / "spheres", folder / "work", SETTINGS, variant=SCALAR_VARIANT)
    return folder / "spheres"


def describe(monkeypatch: pytest.MonkeyPatch, description: SceneDescription) -> None:
    monkeypatch.setattr("rtgs.scenes.synthetic.retake.named_scene", lambda name: description)


def test_test_views_stay_and_photos_are_new(earlier, tmp_path, monkeypatch):
    describe(monkeypatch, with_wide_lens(ball_in_a_room()))
    record, out = CaptureRecord.read(earlier), tmp_path / "spheres"
    made = retake(earlier, out, 4, variant=SCALAR_VARIANT)
    assert record is not None
    assert made == CaptureRecord.read(out)
    assert (made.samples, made.test_samples) == (4, record.test_samples)
    assert (made.noise_psnr, made.noise_psnr_worst) == (record.noise_psnr, record.noise_psnr_worst)
    assert made.description_sha256 == description_digest(with_wide_lens(ball_in_a_room()))
    files = [path.relative_to(earlier) for path in sorted(earlier.rglob("*.*")) if path.suffix in (".png", ".jpg")]
    assert files == [path.relative_to(out) for path in sorted(out.rglob("*.*")) if path.suffix in (".png", ".jpg")]
    same = [path for path in files if (earlier / path).read_bytes() == (out / path).read_bytes()]
    assert {path for path in files if "view_000" in str(path)} <= set(same)
    photos = {path for path in files if path.suffix == ".jpg"}
    assert len(photos) == 2
    assert not photos & set(same)
    assert (out / "sparse/0/cameras.txt").read_text().count("PINHOLE") == 2


def test_a_killed_retake_goes_on(earlier, tmp_path, monkeypatch):
    describe(monkeypatch, with_wide_lens(ball_in_a_room()))
    whole = tmp_path / "whole"
    retake(earlier, whole, 4, variant=SCALAR_VARIANT)
    halted = tmp_path / "halted"
    copy_folder(tmp_path / "whole.views" / "view_000", tmp_path / "halted.views" / "view_000")
    copy_folder(tmp_path / "whole.views" / "view_001", tmp_path / "halted.views" / "view_001")
    (tmp_path / "halted.views" / "view_002.tmp").mkdir()
    with pytest.raises(RtgsError, match="view_001 was rendered with 4 samples, not 9: remove"):
        retake(earlier, halted, 9, variant=SCALAR_VARIANT)
    retake(earlier, halted, 4, variant=SCALAR_VARIANT)
    for path in sorted(whole.rglob("*.*")):
        if path.name != "synthetic.json":  # which knows the seconds
            assert (halted / path.relative_to(whole)).read_bytes() == path.read_bytes(), path


def test_captures_with_other_test_views_are_refused(earlier, tmp_path, monkeypatch):
    plain = ball_in_a_room()
    with pytest.raises(RtgsError, match="is there already"):
        retake(earlier, earlier, 4)
    with pytest.raises(CaptureError, match="holds no record of a path-traced capture"):
        retake(tmp_path, tmp_path / "out", 4)
    describe(monkeypatch, replace(plain, exposure=2.0))
    with pytest.raises(CaptureError, match="spheres changed after it was rendered, by more than its wide lens"):
        retake(earlier, tmp_path / "out", 4)
    describe(monkeypatch, replace(plain, viewpoints=replace(plain.viewpoints, rings=3, wide_every=3)))
    with pytest.raises(CaptureError, match="by more than its wide lens"):
        retake(earlier, tmp_path / "out", 4)


@pytest.mark.parametrize("renderer", ["Mitsuba 3.9.0, scalar_rgb", "Mitsuba 3.9.1, llvm_ad_rgb", ""])
def test_test_views_of_another_renderer_are_refused(renderer: str, earlier, tmp_path, monkeypatch):
    record = CaptureRecord.read(earlier)
    assert record is not None
    copy_folder(earlier, tmp_path / "spheres")
    replace(record, renderer=renderer).write(tmp_path / "spheres")
    describe(monkeypatch, ball_in_a_room())
    with pytest.raises(CaptureError, match=f"was rendered by {renderer}, here it would be {record.renderer}; install"):
        retake(tmp_path / "spheres", tmp_path / "out", 4, variant=SCALAR_VARIANT)
    assert {path.name for path in tmp_path.iterdir()} == {"spheres"}


def test_a_wide_test_view_is_refused(earlier, tmp_path, monkeypatch):
    record = CaptureRecord.read(earlier)
    assert record is not None
    copy_folder(earlier, tmp_path / "spheres")
    replace(record, views=9).write(tmp_path / "spheres")
    many = ball_in_a_room()
    describe(monkeypatch, replace(many, viewpoints=replace(many.viewpoints, count=9, wide_every=16)))
    with pytest.raises(CaptureError, match="wide_every makes test views wide"):
        retake(tmp_path / "spheres", tmp_path / "out", 4)
