"""Captures that name files outside of themselves: refused by every reader, and nothing is written there."""

from __future__ import annotations

import pytest

from rtgs.core.errors import RtgsError
from rtgs.prepare.masks.make import mask_path
from rtgs.scenes.capture import CaptureError, existing_side_file
from rtgs.scenes.check import check_capture
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.truth_files import existing_truth

from .captures import ColmapCapture, edit_transforms, write_transforms

OUTSIDE = ["../../xx.png", "/tmp/xxx.png", "..\\../x.png", "C:/xxxxx.png"]  # as long as photo_03.png


def refused(root, message: str) -> None:
    settings = SceneSettings(path=str(root))
    with pytest.raises(CaptureError, match=message):
        load_scene(settings)
    assert any(finding.severity == "error" for finding in check_capture(settings))


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("text", [False, True])
def test_colmap_model(tmp_path, name, text):
    root = ColmapCapture(tmp_path, text=text).write()
    path = root / "sparse/0" / ("images.txt" if text else "images.bin")
    path.write_bytes(path.read_bytes().replace(b"photo_03.png", name.encode()))
    refused(root, "the name .* (leaves its folder|is absolute)")


@pytest.mark.parametrize("name", [*OUTSIDE, "", "a\0b.png", "x" * 300])
@pytest.mark.parametrize("key", ["file_path", "mask_path", "normal_file_path"])
def test_transforms(tmp_path, name, key):
    if not name and key != "file_path":
        pytest.skip("no name: the folder of masks is looked into")
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda content: content["frames"][3].__setitem__(key, name))
    refused(root, "frame 3.*the name .* (leaves its folder|is absolute|names no file|holds NUL|is too long)")


def test_transforms_point_file(tmp_path):
    root = write_transforms(tmp_path / "inner", ply_file_path="../points.ply")
    (tmp_path / "points.ply").write_bytes(b"ply\n")
    refused(root, "ply_file_path.*leaves its folder")


@pytest.mark.parametrize("value", [3, ["a.png"], {"a": 1}, True])
def test_file_names_of_another_type(tmp_path, value):
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda content: content["frames"][3].__setitem__("mask_path", value))
    refused(root, "frame 3.*mask_path=.* is no file name")


def test_blender(tmp_path):
    root = write_transforms(tmp_path, camera_angle_x=0.8)
    (root / "transforms.json").rename(root / "transforms_train.json")
    edit_transforms(root, lambda c: c["frames"][0].__setitem__("file_path", "../x.png"), "transforms_train.json")
    refused(root, "transforms_train.json frame 0.*leaves its folder")


@pytest.mark.parametrize("name", OUTSIDE)
def test_nothing_is_written_or_looked_for_outside(tmp_path, name):
    with pytest.raises(RtgsError, match="the name"):
        mask_path(tmp_path, name)
    with pytest.raises(RtgsError, match="the name"):
        existing_side_file(tmp_path / "masks", name, (".png",))
    with pytest.raises(RtgsError, match="the name"):
        existing_truth(tmp_path, name)
