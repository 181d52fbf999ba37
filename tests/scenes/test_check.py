"""``check_capture`` finds everything at once and does not cry wolf."""

from __future__ import annotations

import json
import re

import numpy as np

from rtgs.scenes.check import check_capture, seen_share
from rtgs.scenes.importers.colmap import read_colmap
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

from .captures import HEIGHT, WIDTH, ColmapCapture, edit_transforms, pinhole_picture, save_image, write_transforms


def messages(findings, severity=None):
    return "\n".join(f.message for f in findings if severity in (None, f.severity))


def test_a_sound_capture_has_no_errors_or_warnings(tmp_path):
    root = ColmapCapture(tmp_path, points=120).write()
    assert check_capture(SceneSettings(path=str(root))) == []


def test_all_problems_are_found_at_once(tmp_path):
    root = ColmapCapture(tmp_path, broken_pose=9, points=4).write()
    images = root / "images"
    (images / "photo_01.png").unlink()
    (images / "photo_02.png").write_bytes((images / "photo_02.png").read_bytes()[:300])
    (images / "photo_03.png").write_bytes(b"")
    save_image(images / "photo_04.png", pinhole_picture(width=40, height=40))
    save_image(images / "extra.png", pinhole_picture())
    save_image(root / "masks/photo_05.png", np.zeros((9, 9), dtype=np.uint8))
    save_image(root / "masks/nobody.png", np.zeros((HEIGHT, WIDTH), dtype=np.uint8))
    (root / "normals").mkdir()
    np.save(root / "normals/photo_06.npy", np.full((HEIGHT, WIDTH, 3), np.nan))
    findings = check_capture(SceneSettings(path=str(root)))

    errors = messages(findings, "error")
    for part in (
        "1 of 10 images do not exist",
        str(images / "photo_01.png"),
        "photo_02.png cannot be read",
        "photo_03.png is an empty file",
        "photo_04.png is 40x40 pixels",
        "hold NaN or inf: photo_09.png",
        "mask of 9x9 pixels for a photo of 64x48",
        "photo_06.npy holds NaN",
        "only 4 usable points of 4",
    ):
        assert part in errors, part
    others = messages(findings, "warning") + messages(findings, "info")
    for part in (
        "1 of 11 photos have no pose and are left out: extra.png",
        "1 of 2 mask files match no photo with a pose: nobody.png",
        "9 photos have no mask",
        "9 photos have no normal map",
    ):
        assert part in others, part
    order = [finding.severity for finding in findings]
    assert order == sorted(order, key=("error", "warning", "info").index)
    assert all(re.search("[:;] ", f.message) for f in findings if f.severity == "error")  # advice follows


def test_few_views_few_points_and_no_test_views(tmp_path):
    root = ColmapCapture(tmp_path, views=5, points=20).write()
    text = messages(check_capture(SceneSettings(path=str(root), split_every=0)), "warning")
    assert "only 5 photos with a pose" in text
    assert "only 20 usable points" in text
    assert "no test views" in text


def test_split_errors_are_among_the_findings(tmp_path):
    root = ColmapCapture(tmp_path, points=120).write()
    (root / "split.json").write_text(json.dumps({"test": ["ghost.png"]}))
    text = messages(check_capture(SceneSettings(path=str(root), split_file="split.json")), "error")
    assert "ghost.png" in text


def test_points_of_another_world_are_noticed(tmp_path):
    root = ColmapCapture(tmp_path, points=120).write()
    capture = read_colmap(SceneSettings(path=str(root)), root)
    assert capture.points is not None
    assert seen_share(capture.points.positions, list(capture.views)) == 1.0
    assert seen_share(capture.points.positions + np.array([0.0, 100.0, 0.0]), list(capture.views)) < 0.2
    (root / "sparse/0/points3D.bin").unlink()
    for part in ("cameras", "images"):
        (root / f"sparse/0/{part}.bin").unlink()
    moved = ColmapCapture(root, points=0, text=True).write()
    rows = [
        f"{i + 1} {x} 90 {z} 10 20 30 0.1" for i, (x, z) in enumerate(np.random.default_rng(0).normal(size=(120, 2)))
    ]
    (moved / "sparse/0/points3D.txt").write_text("\n".join(rows))
    text = messages(check_capture(SceneSettings(path=str(moved))), "warning")
    assert "only 0% of the points lie inside any photo" in text


def test_cameras_and_lenses_far_apart_in_scale(tmp_path):
    root = write_transforms(tmp_path)
    edit_transforms(root, lambda c: c["frames"][4]["transform_matrix"][0].__setitem__(3, 5000.0))
    edit_transforms(root, lambda c: c["frames"][5].update(fl_x=900.0))
    text = messages(check_capture(SceneSettings(path=str(root))), "warning")
    assert "1 cameras stand more than 50 times farther out than usual: images/photo_04.png" in text
    assert "focal lengths differ by a factor 15.0" in text
    assert "surfels start from random points" in text


def test_a_capture_far_from_the_origin_is_mentioned(tmp_path):
    """Such as one in map coordinates: float32 blurs it (docs/numerics.md)."""
    root = write_transforms(tmp_path)

    def moved(content: dict, by: float) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"][0][3] += by

    edit_transforms(root, lambda content: moved(content, 100.0))
    assert "from the origin" not in messages(check_capture(SceneSettings(path=str(root))))
    edit_transforms(root, lambda content: moved(content, 400_000.0))
    text = messages(check_capture(SceneSettings(path=str(root))), "warning")
    assert re.search(r"the cameras stand 4e\+05 from the origin, \d+ times their distance to each other", text)


def test_transparent_photos_and_mixed_sizes_are_mentioned(tmp_path):
    root = ColmapCapture(tmp_path, points=120).write()
    rgba = np.dstack([pinhole_picture(), np.ones((HEIGHT, WIDTH))])
    save_image(root / "images/photo_01.png", rgba)
    save_image(root / "images/photo_02.png", pinhole_picture(width=128, height=96))
    text = messages(check_capture(SceneSettings(path=str(root))), "info")
    assert "1 photos have an alpha channel" in text
    assert "photos of 2 sizes: 9 of 64x48, 1 of 128x96" in text


def test_a_mask_of_half_the_size_passes_the_check_and_is_enlarged(tmp_path):
    root = ColmapCapture(tmp_path, points=120).write()
    save_image(root / "masks/photo_01.png", np.ones((HEIGHT // 2, WIDTH // 2), dtype=np.uint8))
    assert messages(check_capture(SceneSettings(path=str(root))), "error") == ""
    scene = load_scene(SceneSettings(path=str(root)))
    assert scene.train[0].mask is not None
    assert bool(scene.train[0].mask.all())
