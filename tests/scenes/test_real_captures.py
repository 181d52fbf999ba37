"""The real captures of the shared folder, where it is present (RTGS_SHARED, default ../shared)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rtgs.scenes.check import check_capture
from rtgs.scenes.importers.colmap import read_colmap
from rtgs.scenes.importers.transforms import read_transforms
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.splits import choose_split

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("RTGS_SHARED", REPOSITORY.parent / "shared")) / "data"

# name: images, width, height, points, mean reprojection error in pixels (the folder's own notes)
CAPTURES = {
    "glass_clock": (37, 600, 800, 1637, 0.47),
    "facade_a": (23, 800, 440, 1149, 0.55),
    "gold_cape": (60, 800, 800, 21078, 0.43),
    "desk_kettle": (29, 800, 449, 7562, 0.45),
    "bonsai": (51, 799, 532, 8909, 0.53),
    "fox": (50, 449, 800, 12799, 0.44),
}


def folder(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"capture {name} is not there: set RTGS_SHARED to the folder that holds data/{name}")
    return DATA / name


@pytest.mark.parametrize("name", CAPTURES)
def test_it_loads_with_its_documented_counts(name):
    root = folder(name)
    images, width, height, points, _ = CAPTURES[name]
    scene = load_scene(SceneSettings(name=name, path=str(root), long_side=100))
    assert len(scene.train) + len(scene.test) == images
    assert len(scene.test) == -(-images // 8)
    assert 0.9 * points < len(scene.points) <= points
    camera = scene.train[0].camera
    assert (camera.width, camera.height) == (
        round(100 * width / max(width, height)),
        round(100 * height / max(width, height)),
    )
    assert 0.1 < float(scene.train[0].image.mean()) < 0.9
    by_file = SceneSettings(path=str(root), split_file="split.json")
    split = choose_split(read_colmap(by_file, root), sorted(v.name for v in scene.train + scene.test), by_file)
    assert split.test == tuple(view.name for view in scene.test)
    assert split.train == tuple(view.name for view in scene.train)


@pytest.mark.parametrize("name", CAPTURES)
def test_colmap_and_transforms_agree_on_every_camera(name):
    root = folder(name)
    settings = SceneSettings(path=str(root))
    colmap = {view.name: view for view in read_colmap(settings, root).views}
    transforms = {view.name.removeprefix("images/"): view for view in read_transforms(settings, root).views}
    assert colmap.keys() == transforms.keys()
    for key, ours in colmap.items():
        theirs = transforms[key]
        np.testing.assert_allclose(theirs.rotation, ours.rotation, atol=1e-4)
        np.testing.assert_allclose(theirs.translation, ours.translation, atol=1e-4)
        assert ours.lens is not None
        assert theirs.lens is not None
        np.testing.assert_allclose(theirs.lens.pinhole().params, ours.lens.pinhole().params, rtol=1e-4)
        assert (theirs.lens.width, theirs.lens.height) == (ours.lens.width, ours.lens.height)


@pytest.mark.parametrize("name", CAPTURES)
def test_points_project_onto_their_observations(name):
    """The mean signed error is far below half a pixel in each axis: pixel centres are where we say they are."""
    import pycolmap

    root = folder(name)
    scene = load_scene(SceneSettings(path=str(root), split_every=0, max_views=6))
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    views = {view.name: view for view in scene.train}
    errors = []
    for image in model.images.values():
        if image.name not in views:
            continue
        observed = [(point.xy, model.points3D[point.point3D_id].xyz) for point in image.points2D if point.has_point3D()]
        pixels, positions = (np.array(column) for column in zip(*observed))
        camera = views[image.name].camera
        local = positions @ camera.rotation.numpy().T + camera.translation.numpy()
        assert (local[:, 2] > 0).all()
        projected = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        errors.append(projected - pixels)
    error = np.concatenate(errors)
    assert np.abs(error.mean(0)).max() < 0.1
    assert np.median(np.linalg.norm(error, axis=1)) < 1.0


@pytest.mark.parametrize("name", CAPTURES)
def test_the_check_finds_no_error(name):
    findings = check_capture(SceneSettings(path=str(folder(name))))
    assert [finding.message for finding in findings if finding.severity == "error"] == []
