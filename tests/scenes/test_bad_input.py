"""Captures that cannot be trained on: each message says what, where, and what to do."""

from __future__ import annotations

import json
import re
import struct
import zlib

import numpy as np
import pytest

from rtgs.core.errors import RtgsError
from rtgs.scenes.capture import CaptureError
from rtgs.scenes.check import check_capture
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import ColmapCapture, edit_transforms, pinhole_picture, save_image, write_ply, write_transforms


def refused(root, *parts: str, **keys) -> str:
    """Both the import and the check refuse; every part is in both messages."""
    settings = SceneSettings(path=str(root), **keys)
    with pytest.raises(CaptureError) as error:
        load_scene(settings)
    errors = "\n".join(finding.message for finding in check_capture(settings) if finding.severity == "error")
    for text in (str(error.value), errors):
        for part in parts:
            assert re.search(part, text), f"{part!r} is missing in {text!r}"
    return str(error.value)


def test_missing_folder(tmp_path):
    refused(tmp_path / "nowhere", "capture folder .*nowhere does not exist", "correct scene.path", "rtgs get")


def test_path_that_is_empty_or_a_file(tmp_path):
    refused("", "scene.path is empty")
    (tmp_path / "photo.jpg").write_bytes(b"")
    refused(tmp_path / "photo.jpg", "photo.jpg is a file")


def test_folder_without_a_capture(tmp_path):
    save_image(tmp_path / "images/a.png", pinhole_picture())
    refused(tmp_path, "is no capture", "but images", "run COLMAP")


def test_named_format_without_its_files(tmp_path):
    save_image(tmp_path / "images/a.png", pinhole_picture())
    refused(tmp_path, "no COLMAP model .*sparse/0, sparse, colmap/sparse/0", "set scene.model_dir", format="colmap")
    refused(tmp_path, r"transforms.json does not exist", format="transforms")
    refused(tmp_path, r"transforms_train.json does not exist", format="blender")


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_empty_model(tmp_path, suffix):
    (tmp_path / "sparse/0").mkdir(parents=True)
    for part in ("cameras", "images", "points3D"):
        (tmp_path / f"sparse/0/{part}{suffix}").write_bytes(b"")
    refused(tmp_path, "sparse/0 holds no registered image", "run COLMAP's mapper again")


def test_damaged_model(tmp_path):
    root = ColmapCapture(tmp_path).write()
    path = root / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:200])
    refused(root, "sparse/0 cannot be read", "export the model again")


def test_images_that_do_not_match_are_listed_with_their_paths(tmp_path):
    root = ColmapCapture(tmp_path).write()
    for index in (2, 5, 7):
        (root / f"images/photo_{index:02d}.png").unlink()
    message = refused(root, "3 of 10 images do not exist", "set scene.images_dir")
    for index in (2, 5, 7):
        assert str(root / f"images/photo_{index:02d}.png") in message
    assert "photo_03" not in message


def test_images_of_another_suffix_are_hinted_at(tmp_path):
    root = ColmapCapture(tmp_path).write()
    (root / "images/photo_02.png").rename(root / "images/photo_02.JPG")
    refused(root, "holds photo_02.JPG instead of photo_02.png: rename")


def test_images_that_match_no_camera(tmp_path):
    root = ColmapCapture(tmp_path).write()
    save_image(root / "images/photo_04.png", pinhole_picture(width=48, height=64))
    refused(root, "photo_04.png is 48x64 pixels, its camera 64x48", "use the images the poses were computed from")


def test_truncated_png(tmp_path):
    root = ColmapCapture(tmp_path).write()
    path = root / "images/photo_06.png"
    path.write_bytes(path.read_bytes()[:300])
    refused(root, "photo_06.png cannot be read .*truncated", "copy it again or remove it")


def test_empty_file_and_no_image_at_all(tmp_path):
    root = ColmapCapture(tmp_path).write()
    (root / "images/photo_01.png").write_bytes(b"")
    refused(root, r"photo_01.png is an empty file \(0 bytes\)", "copy it again")
    (root / "images/photo_01.png").write_bytes(b"<html>not found</html>")
    refused(root, "photo_01.png cannot be read", "is no image")


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_zero_size_image(tmp_path):
    root = ColmapCapture(tmp_path).write()
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 0, 48, 8, 2, 0, 0, 0))
    body = png_chunk(b"IDAT", zlib.compress(b"")) + png_chunk(b"IEND", b"")
    (root / "images/photo_03.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    refused(root, "photo_03.png", "zero size", "remove it from the capture")


def test_nan_pose_in_a_binary_model(tmp_path):
    root = ColmapCapture(tmp_path, broken_pose=4).write()
    refused(
        root, "the poses of 1 images hold NaN or inf: photo_04.png", "images.bin|cameras.bin", "register them again"
    )


def test_nan_pose_in_a_text_model(tmp_path):
    root = ColmapCapture(tmp_path, broken_pose=4, text=True).write()
    refused(root, r"holds NaN or inf in images.txt line \d+ \(photo_04.png\)", "register them again")


def test_nan_pose_in_transforms(tmp_path):
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda c: c["frames"][3]["transform_matrix"][0].__setitem__(3, float("nan")))
    refused(root, "the poses of 1 images hold NaN or inf: images/photo_03.png", "transforms.json")


def test_one_single_view(tmp_path):
    root = ColmapCapture(tmp_path, views=1).write()
    refused(root, "1 photo with a pose: a scene cannot be learned from one single view", "take more photos, 20 or more")


def test_one_single_training_view(tmp_path):
    root = ColmapCapture(tmp_path, views=2).write()
    refused(root, r"1 training view\(s\): a scene needs at least two photos", "lower the share of test views")
    assert len(load_scene(SceneSettings(path=str(root), split_every=0)).train) == 2


def test_point_cloud_of_three_points(tmp_path):
    root = ColmapCapture(tmp_path, points=3).write()
    refused(root, "only 3 usable points of 3 in .*points3D.bin", "at least 10 are needed", "set scene.points=random")
    drawn = load_scene(SceneSettings(path=str(root), points="random", random_points=500))
    assert len(drawn.points) > 400
    assert drawn.random_points


def test_no_points_at_all(tmp_path):
    refused(ColmapCapture(tmp_path / "a", points=0).write(), "only 0 usable points of 0", "set scene.points=random")
    root = write_transforms(tmp_path / "b", ply_file_path="p.ply")
    write_ply(root / "p.ply", np.full((30, 3), np.nan))
    refused(root, "only 0 usable points of 30 in .*p.ply", "match more images")


def test_a_model_of_which_a_file_is_missing(tmp_path):
    root = ColmapCapture(tmp_path).write()
    (point_file,) = (root / "sparse" / "0").glob("points3D.*")
    point_file.unlink()
    refused(root, f"sparse/0 lacks {point_file.name}", "copy the whole folder")


def test_split_file_that_names_unknown_images(tmp_path):
    root = ColmapCapture(tmp_path).write()
    (root / "split.json").write_text(json.dumps({"train": ["photo_01.png"], "test": ["ghost_1.png", "ghost_2.png"]}))
    refused(root, "split.json names 2 images .*: ghost_1.png, ghost_2.png", "photo_00.png", split_file="split.json")


def test_masks_and_normals_that_do_not_fit(tmp_path):
    root = ColmapCapture(tmp_path).write()
    save_image(root / "masks/photo_01.png", np.zeros((40, 40), dtype=np.uint8))
    refused(root, "mask", "photo_01.png", "40x40", "64x48", "from this very photo")
    save_image(root / "normals/photo_02.png", pinhole_picture(width=30, height=60))
    refused(root, "normal map", "photo_02.png", "30x60", "64x48", masks_dir="")


def test_duplicate_names(tmp_path):
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda c: c["frames"].append(c["frames"][2]))
    refused(root, "1 image names occur more than once: images/photo_02.png", "keep one pose per photo")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"format": "colamp"}, r"scene\.format='colamp' is unknown: .*did you mean 'colmap'\?"),
        ({"points": "sfm"}, "points='sfm' is unknown: choose one of auto, random"),
        ({"normals_frame": "opengL"}, r"did you mean 'opengl'\?"),
        ({"long_side": 0}, "long_side=0 must be at least 1"),
        ({"split_every": -1}, "split_every=-1 must be at least 0"),
        ({"far_factor": float("nan")}, "far_factor=nan"),
        ({"resize_ratio": 2.0}, r"resize_ratio=2.0 must be in \(0, 1\]"),
        ({"background": (0.0, 2.0, 0.0)}, r"background=\(0.0, 2.0, 0.0\) must be three numbers between 0 and 1"),
    ],
)
def test_settings_out_of_range(keys, message):
    with pytest.raises(RtgsError, match=message):
        SceneSettings(**keys)


def test_unknown_embedded_capture():
    refused("embedded:atlantis", "no embedded capture 'atlantis': rtgs ships")


def test_a_described_scene_that_is_not_shipped_says_how_to_make_it(monkeypatch):
    monkeypatch.setattr("rtgs.scenes.importers.embedded.embedded_names", lambda: ("other",))
    refused("embedded:tall_bottle", "rtgs run synthesize scene=tall_bottle")
