"""From photos to poses, on ray-cast photos of a room whose poses are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses import sfm
from rtgs.prepare.poses.compare import compare_poses
from rtgs.prepare.poses.find import Request, find_poses
from rtgs.prepare.poses.photos import lay_out, read_photo_set
from rtgs.prepare.poses.quality import SfmReport
from rtgs.prepare.settings import FeatureSettings, MappingSettings, MatchingSettings, SfmSettings
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.undistort import Lens
from tests.prepare.room import FOCAL, HEIGHT, WIDTH, Pose, walk, write_photos

QUICK = SfmSettings(features=FeatureSettings(max_features=600))
COUNT = 8
HIDDEN = (slice(60, 200), slice(100, 260))  # rows and columns of the region that one photo's mask marks


def given_views(poses: list[Pose]) -> list[CaptureView]:
    lens = Lens("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    return [
        CaptureView(f"photo_{index:02d}.jpg", Path(), pose.rotation, pose.translation, lens)
        for index, pose in enumerate(poses)
    ]


def run(
    source: Path, place: Path, settings: SfmSettings = QUICK, threads: int = 1
) -> tuple[Path, SfmReport, list[str]]:
    said: list[str] = []
    out, work = place / "out", place / "work"
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    request = Request.of(SceneSettings(), source)
    return out, find_poses(request, settings, work, out, threads, said.append), said


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Eight photos, a mask over the middle of one of them, and a copy of another."""
    folder = tmp_path_factory.mktemp("room")
    paths = write_photos(folder / "images", walk(COUNT))
    (folder / "images" / "photo_03 copy.jpg").write_bytes(paths[3].read_bytes())
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[HIDDEN] = 255
    (folder / "masks").mkdir()
    Image.fromarray(mask).save(folder / "masks" / "photo_02.png")
    normals = np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32)
    normals[..., 2] = -1
    (folder / "normals").mkdir()
    np.save(folder / "normals" / "photo_02.npy", normals)
    return folder


@pytest.fixture(scope="module")
def found(room, tmp_path_factory):
    return run(room, tmp_path_factory.mktemp("found"))


def test_poses_agree_with_the_truth(found):
    out, report, _ = found
    assert (report.registered, report.photos, report.missing) == (COUNT, COUNT, ())
    capture = read_capture(SceneSettings(path=str(out)))
    errors = compare_poses(capture.views, given_views(walk(COUNT)))
    assert errors.found == 1
    assert errors.rotation.max() < 0.3, "degrees"
    assert errors.translation.max() < 0.01, "of the extent"
    assert abs(errors.focal) < 0.03
    assert report.reprojection_error < 1
    assert report.track_length > 3


def test_the_world_is_upright_centred_and_in_the_agreed_unit(found):
    out, report, _ = found
    capture = read_capture(SceneSettings(path=str(out)))
    errors = compare_poses(capture.views, given_views(walk(COUNT)))
    up = np.asarray(errors.change.rotation)[2]
    assert up[2] > np.cos(np.radians(1)), "the room's z is the found z"
    assert capture.points is not None
    assert np.abs(np.median(capture.points.positions, axis=0)).max() < 0.2
    depths = [(capture.points.positions @ view.rotation.T + view.translation)[:, 2] for view in capture.views]
    assert 3 < np.median(np.concatenate(depths)) < 5
    there = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(report.world.inverse.apply(report.world.apply(there)), there, atol=1e-12)
    assert "up" in report.world.why


def test_the_result_is_a_capture_that_loads(found):
    out, report, _ = found
    scene = load_scene(SceneSettings(path=str(out), split_every=4))
    assert len(scene.train) + len(scene.test) == COUNT
    masked = [view for view in scene.train + scene.test if view.mask is not None]
    assert [view.name for view in masked] == ["photo_02.jpg"]
    share = float(masked[0].mask.float().mean())
    assert abs(share - 140 * 160 / (WIDTH * HEIGHT)) < 0.03
    assert masked[0].normal is not None
    assert float(masked[0].normal[2].mean()) < -0.99
    assert all(len({view.camera.fx, view.camera.fy}) == 2 or view.camera.fx == view.camera.fy for view in scene.train)
    assert SfmReport.read(out) == report
    assert (out / "coverage.png").read_bytes().startswith(b"\x89PNG")


def test_masked_regions_give_no_features(found):
    import pycolmap

    out, _, said = found
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    points = {image.name: np.array([p.xy for p in image.points2D]) for image in model.images.values()}
    rows, columns = HIDDEN
    hidden = points["photo_02.jpg"]
    margin = 3
    inside = (
        (hidden[:, 0] > columns.start + margin)
        & (hidden[:, 0] < columns.stop - margin)
        & (hidden[:, 1] > rows.start + margin)
        & (hidden[:, 1] < rows.stop - margin)
    )
    assert not inside.any()
    other = points["photo_03.jpg"]
    assert ((other[:, 0] > columns.start) & (other[:, 0] < columns.stop)).any()
    assert any("masked regions of 1 photos" in line for line in said)


def test_copies_are_left_out_and_named(found):
    _, report, said = found
    assert any("1 photos are copies" in line and "photo_03.jpg" in line for line in said)
    assert any("copies" in note for note in report.notes)


def test_thread_count_and_repetition_do_not_change_the_result(room, found, tmp_path):
    out, _, _ = found
    again, _, _ = run(room, tmp_path, threads=2)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (out / "sparse/0" / name).read_bytes() == (again / "sparse/0" / name).read_bytes(), name


def test_two_scenes_in_one_folder_are_told_apart(tmp_path):
    source = tmp_path / "source"
    write_photos(source, walk(5), seed=0, name="hall_{}.jpg")
    write_photos(source, walk(5), seed=1, name="kitchen_{}.jpg")
    _, report, _ = run(source, tmp_path)
    assert report.registered == 5
    assert report.models == (5, 5)
    assert "2 groups that share no view" in report.advice[0]
    assert "hall_0.jpg" in report.advice[0]
    assert "kitchen_0.jpg" in report.advice[0]


def test_too_few_poses_stop_with_advice(tmp_path):
    source = tmp_path / "source"
    rng = np.random.default_rng(0)
    source.mkdir()
    for index in range(4):
        noise = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(noise).save(source / f"noise_{index}.jpg")
    with pytest.raises(PrepareError, match=r"none of 4 photos .* found a pose:\n  - 4 photos match no other \(noise_0"):
        run(source, tmp_path)


def test_what_is_finished_is_not_done_again(room, tmp_path, monkeypatch):
    """A killed search goes on from its database, and ends like an uninterrupted one."""

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sfm, "_map", killed)
        with pytest.raises(KeyboardInterrupt):
            run(room, tmp_path)
    before = (tmp_path / "work" / "database.db").stat().st_ino
    registered = []
    original = sfm._register
    monkeypatch.setattr(sfm, "_register", lambda *a: (original(*a), registered.append(a[1].database.stat().st_ino)))
    _, report, _ = run(room, tmp_path)
    assert registered == [before], "the database was kept"
    assert report.registered == COUNT
    assert report.seconds["features"] < 0.5


def test_other_ways_to_pair_and_to_map_find_the_same(room, tmp_path):
    settings = replace(
        QUICK,
        matching=MatchingSettings(pairs="retrieval", neighbours=4, words=8),
        mapping=MappingSettings(mapper="global"),
    )
    out, report, _ = run(room, tmp_path, settings)
    assert report.strategy.startswith("retrieval")
    assert report.pairs < COUNT * (COUNT - 1) // 2
    errors = compare_poses(read_capture(SceneSettings(path=str(out))).views, given_views(walk(COUNT)))
    assert errors.found == 1
    assert np.median(errors.rotation) < 0.5


def test_exif_gives_the_focal_length_to_start_from(tmp_path):
    """28 mm on film of 35 mm; a photo without EXIF starts from 1.2 of its long side."""
    import pycolmap

    first, second = write_photos(tmp_path / "photos", walk(2))
    picture = Image.open(second)
    exif = picture.getexif()
    exif.get_ifd(0x8769)[0xA405] = 28
    picture.save(second, exif=exif)
    place = sfm.Workplace(tmp_path / "work")
    place.photos.mkdir(parents=True)
    photos = read_photo_set(tmp_path / "photos")
    lay_out(photos, place.photos, (0.0, 0.0, 0.0), lambda _: None)
    sfm._register(photos, place, QUICK)
    with pycolmap.Database.open(str(place.database)) as database:
        images = {image.name: database.read_camera(image.camera_id) for image in database.read_all_images()}
    with_exif, without = images[second.name], images[first.name]
    assert with_exif.has_prior_focal_length
    assert with_exif.params[0] == pytest.approx(28 / 36 * WIDTH, rel=0.05)
    assert not without.has_prior_focal_length
    assert without.params[0] == pytest.approx(1.2 * WIDTH)


def test_a_feature_without_its_model_says_so(room, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    settings = replace(QUICK, features=FeatureSettings(kind="aliked_n16rot"))
    import pycolmap

    def refuse(*_, **__):
        raise RuntimeError("could not load model")

    monkeypatch.setattr(pycolmap, "extract_features", refuse)
    with pytest.raises(PrepareError, match=r"features aliked_n16rot failed .*could not load model.* or use sift"):
        run(room, tmp_path, settings)


def test_the_report_reads_back(tmp_path, found):
    _, report, _ = found
    report.write(tmp_path)
    assert json.loads((tmp_path / "sfm.json").read_text())["registered"] == COUNT
    assert SfmReport.read(tmp_path) == report
    assert f"{COUNT} of {COUNT} photos registered" in str(report)
