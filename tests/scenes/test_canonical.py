"""The cached form of a scene and the digest of its capture."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from rtgs.scenes.canonical import read_scene, save_scene
from rtgs.scenes.capture import CaptureError
from rtgs.scenes.digest import capture_digest
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import HEIGHT, WIDTH, ColmapCapture, pinhole_picture, save_image


@pytest.fixture
def root(tmp_path):
    root = ColmapCapture(tmp_path / "capture").write()
    save_image(root / "masks/photo_01.png", np.eye(HEIGHT, WIDTH, dtype=np.uint8))
    save_image(root / "normals/photo_02.png", pinhole_picture())
    return root


def same(a: torch.Tensor | None, b: torch.Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.dtype == b.dtype and torch.equal(a, b)


def test_round_trip_is_exact(root, tmp_path):
    scene = load_scene(SceneSettings(name="ring", path=str(root), long_side=37))
    save_scene(scene, tmp_path / "artifact")
    back = read_scene(tmp_path / "artifact")
    assert (back.name, back.extent, back.source) == (scene.name, scene.extent, scene.source)
    assert same(back.points, scene.points)
    assert same(back.point_colors, scene.point_colors)
    assert (len(back.train), len(back.test)) == (8, 2)
    for ours, theirs in zip(scene.train + scene.test, back.train + back.test):
        assert ours.name == theirs.name
        assert all(same(getattr(ours, key), getattr(theirs, key)) for key in ("image", "mask", "normal"))
        for key in ("fx", "fy", "cx", "cy", "width", "height", "name"):
            assert getattr(ours.camera, key) == getattr(theirs.camera, key)
        assert same(ours.camera.rotation, theirs.camera.rotation)
        assert same(ours.camera.translation, theirs.camera.translation)
    assert str(back.summary()) == str(scene.summary())
    assert back.has_masks
    assert back.has_normals
    assert not back.random_points


def test_a_round_trip_keeps_that_points_are_random(root, tmp_path):
    scene = load_scene(SceneSettings(name="ring", path=str(root), points="random", random_points=500, long_side=37))
    save_scene(scene, tmp_path / "artifact")
    assert read_scene(tmp_path / "artifact").random_points


@pytest.mark.parametrize("error", [None, 0.0625])
def test_a_round_trip_keeps_how_unsure_the_poses_are(root, tmp_path, error):
    scene = replace(load_scene(SceneSettings(name="ring", path=str(root), long_side=37)), pose_error=error)
    save_scene(scene, tmp_path / "artifact")
    assert read_scene(tmp_path / "artifact").pose_error == error


def test_held_out_views_are_kept_and_change_nothing_else(root, tmp_path):
    """Points, extent and the other views are those of a scene that holds out nothing."""
    settings = SceneSettings(path=str(root), long_side=37)
    whole, scene = load_scene(settings), load_scene(replace(settings, hold_out=4))
    save_scene(whole, tmp_path / "whole")
    save_scene(scene, tmp_path / "artifact")
    back = read_scene(tmp_path / "artifact")
    assert [view.name for view in back.held] == [whole.train[index].name for index in (2, 6)]
    by_name = {view.name: view for view in whole.train}
    for view in (*back.held, *back.train):
        assert same(view.image, by_name.pop(view.name).image)
    assert by_name == {}
    assert (back.extent, [view.name for view in back.test]) == (whole.extent, [view.name for view in whole.test])
    assert same(back.points, whole.points)
    assert "6 training and 2 test views of 37x28, 2 more held out" in str(back.summary())
    assert "held" not in json.loads((tmp_path / "whole" / "scene.json").read_text())
    assert read_scene(tmp_path / "whole").held == ()


def test_damaged_artifacts_are_refused(root, tmp_path):
    folder = tmp_path / "artifact"
    with pytest.raises(CaptureError, match="cannot be read"):
        read_scene(folder)
    save_scene(load_scene(SceneSettings(path=str(root))), folder)
    view = folder / "views/00003.safetensors"
    content = view.read_bytes()
    view.write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError, match="import the capture again"):
        read_scene(folder)
    view.write_bytes(content)
    description = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps(description | {"version": 99}))
    with pytest.raises(CaptureError, match="format version 99"):
        read_scene(folder)


def test_digest_follows_content_not_place_or_time(root, tmp_path):
    def digest(folder=root, **keys):
        return capture_digest(SceneSettings(path=str(folder), **keys))

    first = digest()
    assert first == digest()
    moved = tmp_path / "elsewhere"
    shutil.copytree(root, moved)
    for path in moved.rglob("*.png"):
        os.utime(path, (1, 1))
    assert digest(moved) == first
    save_image(moved / "images/unused.png", pinhole_picture())  # has no pose
    assert digest(moved) == first
    assert digest(moved, masks_dir="") != first
    assert digest(moved, max_views=4) != first


@pytest.mark.parametrize("name", ["images/photo_04.png", "masks/photo_01.png", "normals/photo_02.png", "split.json"])
def test_digest_sees_every_file_that_is_used(root, name):
    (root / "split.json").write_text('{"test": ["photo_00.png"]}')
    settings = SceneSettings(path=str(root), split_file="split.json")
    first = capture_digest(settings)
    path = root / name
    if name.endswith(".png"):
        save_image(path, np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    else:
        path.write_text('{"test": ["photo_01.png"]}')
    assert capture_digest(settings) != first
    path.unlink()
    if name.startswith("images") or name.startswith("split"):
        with pytest.raises(CaptureError, match=path.name):
            capture_digest(settings)


def test_digest_sees_the_model(root):
    settings = SceneSettings(path=str(root))
    first = capture_digest(settings)
    ColmapCapture(root, points=61).write()
    assert capture_digest(settings) != first
