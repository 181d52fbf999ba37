"""What a path holds: poses, photos or a video; with the reason, and the digest of its content."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.settings import SfmSettings
from rtgs.prepare.source import find_source, source_digest
from rtgs.scenes.settings import CaptureError, SceneSettings
from tests.prepare.room import walk, write_photos
from tests.scenes.captures import ColmapCapture


def scene(path: Path, **changes) -> SceneSettings:
    return SceneSettings(path=str(path), **changes)


def test_the_source_is_seen_once_with_its_reason(tmp_path):
    colmap = ColmapCapture(tmp_path / "colmap", views=3).write()
    given = find_source(scene(colmap), SfmSettings())
    assert (given.kind, given.why) == ("poses", "poses are given (colmap)")
    assert find_source(scene(colmap), SfmSettings(use="always")).kind == "photos"
    assert find_source(SceneSettings(path="embedded:ball_statue"), SfmSettings()).has_poses
    write_photos(tmp_path / "plain", walk(2))
    assert find_source(scene(tmp_path / "plain"), SfmSettings()).kind == "photos"
    with pytest.raises(PrepareError, match=r"sfm.use=never forbids"):
        find_source(scene(tmp_path / "plain"), SfmSettings(use="never"))
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips/a.mp4").write_bytes(b"x")
    assert find_source(scene(tmp_path / "clips"), SfmSettings()).kind == "video"
    assert find_source(scene(tmp_path / "clips/a.mp4"), SfmSettings()).kind == "video"
    (tmp_path / "clips/b.mov").write_bytes(b"x")
    with pytest.raises(PrepareError, match=r"2 videos \(a.mp4, b.mov\): name one"):
        find_source(scene(tmp_path / "clips"), SfmSettings())


def test_a_path_that_is_nothing_is_a_message(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(PrepareError, match=r"is a file: scene.path names a folder"):
        find_source(scene(tmp_path / "notes.txt"), SfmSettings())
    with pytest.raises(CaptureError, match=r"is no capture"):
        find_source(scene(tmp_path), SfmSettings())
    write_photos(tmp_path / "deep/one", walk(1))
    with pytest.raises(PrepareError, match=r"but in one: name the folder with scene.images_dir"):
        find_source(scene(tmp_path / "deep"), SfmSettings())


def test_a_damaged_model_is_not_replaced_unasked(tmp_path):
    root = ColmapCapture(tmp_path / "colmap", views=3).write()
    (root / "sparse/0/points3D.bin").unlink()
    with pytest.raises(CaptureError, match=r"lacks points3D.bin"):
        find_source(scene(root), SfmSettings())
    assert find_source(scene(root), SfmSettings(use="always")).kind == "photos"


def test_the_digest_is_of_the_content(tmp_path):
    for name in ("one", "two"):
        write_photos(tmp_path / name, walk(2))
    options = SfmSettings()

    def digest(name: str) -> str:
        settings_ = scene(tmp_path / name)
        return source_digest(find_source(settings_, options), settings_, options)

    assert digest("one") == digest("two"), "the place does not count"
    (tmp_path / "two/ignore").mkdir()
    (tmp_path / "two/ignore/photo_00.png").write_bytes(b"mask")
    assert digest("one") != digest("two"), "masks count"
