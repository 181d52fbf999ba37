"""A capture is looked at once, and what planning asks of the inspection is what the importers would say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.planning import inspection as module
from pipelines.planning.graph import build_graph
from pipelines.planning.inspection import Inspections, inspect
from pipelines.planning.plan import Job, merge_jobs
from pipelines.steps.normals import photo_settings
from rtgs.config import compose
from rtgs.prepare.settings import SfmSettings
from rtgs.scenes.digest import capture_digest
from rtgs.scenes.settings import CaptureError, SceneSettings
from tests.scenes.captures import ColmapCapture


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Five photos with poses; three have a mask, one a normal map."""
    root = ColmapCapture(tmp_path, views=5).write()
    photos = sorted(path for path in (root / "images").iterdir())
    size = Image.open(photos[0]).size
    for index, photo in enumerate(photos):
        if index < 3:
            (root / "masks").mkdir(exist_ok=True)
            Image.fromarray(np.full(size[::-1], 255, np.uint8)).save(root / "masks" / f"{photo.stem}.png")
        if index == 4:
            (root / "normals").mkdir()
            Image.fromarray(np.full((*size[::-1], 3), 128, np.uint8)).save(root / "normals" / f"{photo.stem}.png")
    return root


def test_digests_are_those_of_captures_read_for_themselves(capture: Path) -> None:
    for scene in (SceneSettings(path=str(capture)), SceneSettings(path=str(capture), max_views=3, masks_dir="")):
        found = inspect(scene, SfmSettings())
        assert found.digest == capture_digest(scene)
        photos = replace(photo_settings(scene), path=scene.path)
        assert found.photo_digest == capture_digest(photos)
        assert found.photo_digest != found.digest
    with (capture / "images" / "photo_00.png").open("ab") as photo:
        photo.write(b"more")
    assert inspect(scene, SfmSettings()).photo_digest == capture_digest(photos) != found.photo_digest


def test_what_the_capture_brings_is_told_in_words(capture: Path) -> None:
    found = inspect(SceneSettings(path=str(capture)), SfmSettings())
    assert found.given_masks == "masks are given (3 of 5 photos)"
    assert found.given_normals == "normal maps are given (1 of 5 photos)"
    assert [path.name for path in found.mask_files] == [f"photo_0{index}.png" for index in range(3)]
    without = inspect(SceneSettings(path=str(capture), masks_dir="", normals_dir=""), SfmSettings())
    assert (without.given_masks, without.given_normals, without.mask_files) == ("", "", ())


def test_photos_without_poses_have_no_capture_but_side_folders(capture: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    (capture / "images").rename(plain)
    (capture / "masks").rename(plain / "masks")
    found = inspect(SceneSettings(path=str(plain)), SfmSettings())
    assert found.capture is None
    assert found.given_masks == "masks are given (masks/)"
    assert found.given_normals == ""
    assert len(found.mask_files) == 3
    with pytest.raises(CaptureError):
        inspect(SceneSettings(path=str(tmp_path / "nothing")), SfmSettings())


def test_the_jobs_of_a_plan_share_what_they_share_and_plans_share_nothing(capture: Path, monkeypatch) -> None:
    read: list[SceneSettings] = []
    whole = module.read_capture
    monkeypatch.setattr(module, "read_capture", lambda scene: read.append(scene) or whole(scene))
    monkeypatch.setattr("rtgs.scenes.digest.read_capture", lambda scene: pytest.fail("a digest reads it again"))
    words = [f"scene.path={capture}", "preset=smoke", "tracking=off"]
    jobs = [Job(*compose([*words, *more])) for more in (["method=2dgs"], ["method=rtgs"], ["scene.long_side=32"])]
    merged = merge_jobs(jobs)
    assert not merged.problems
    assert len(read) == 2  # the third job has another size, so other settings of the scene
    build_graph(jobs[0].config, jobs[0].choices)
    assert len(read) == 3
    inspections = Inspections()
    graphs = [build_graph(job.config, job.choices, inspections) for job in jobs[:2]]
    assert len(read) == 4
    assert len({graph.scene.fingerprint for graph in graphs}) == 1
