"""Pictures of fixed views during training: sliders in the tracker, and no trace in the result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from pipelines.cli.main import main
from pipelines.steps import pictures
from pipelines.steps.pictures import fixed_views, training_pictures
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import Store
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

SECOND = ("method.reflection.cells=3", "method.reflection.matte.probation=0", "method.loss.perceptual=0")


def tracked_images(folder: Path) -> dict[str, list[int]]:
    """Steps of every slider of the run of the variant."""
    found: dict[str, list[int]] = {}
    for path in (folder / "tracking" / "rtgs-runs").rglob("events.jsonl"):
        for line in path.read_text().splitlines():
            event = json.loads(line)
            if event["kind"] == "image" and event["step"] is not None:
                found.setdefault(event["name"], []).append(event["step"])
    return found


@pytest.fixture(scope="module")
def trained(tmp_path_factory, capture) -> tuple[Path, Path]:  # noqa: F811
    """The same run twice: looked at every four steps, and not at all."""
    words = ["run", f"scene={capture}", "method=rtgs", *QUICK, *SECOND, "tracking=jsonl"]
    folders = []
    for name, steps in (("watched", 4), ("alone", 500)):
        folder = tmp_path_factory.mktemp(name)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("RTGS_ROOT", str(folder))
            patch.chdir(folder)
            patch.setattr(pictures, "LEAST_STEPS", steps)
            assert main(words) == 0
        folders.append(folder)
    return folders[0], folders[1]


def test_sliders_show_fixed_views_and_layers_over_both_stages(trained):
    watched, alone = trained
    sliders = tracked_images(watched)
    assert {key.split("/")[0] for key in sliders} == {"images_000", "images_008"}
    assert {key.split("/")[1] for key in sliders} == {"image", "normal", "reflection", "specular"}
    assert sliders["images_000/image"] == [4, 8, 12]
    assert sliders["images_008/reflection"] == [8, 12]  # there is none in the first stage
    assert {tuple(steps) for steps in tracked_images(alone).values()} == {(12,)}


def test_looking_changes_nothing(trained):
    first, second = (next(iter(Store(folder / "store").artifacts("train_reflection"))).manifest for folder in trained)
    assert first.fingerprint == second.fingerprint
    for name in ("base.ply", "reflection.ply"):
        assert first.files[name] == second.files[name]


def test_ellipsoids_show_their_normals(capture, tmp_path: Path, monkeypatch):  # noqa: F811
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pictures, "LEAST_STEPS", 4)
    assert main(["run", f"scene={capture}", "method=3dgs", *QUICK, "tracking=jsonl", "name=round"]) == 0
    assert tracked_images(tmp_path)["images_000/normal"] == [4, 8, 12]
    (rendered,) = Store(tmp_path / "store").artifacts("render")
    maps = load_file(next((rendered.folder / "views").iterdir()))
    assert set(maps) == {"image", "depth", "normal", "alpha"}
    assert bool((maps["normal"].norm(dim=0) <= maps["alpha"] + 1e-5).all())
    assert bool(maps["normal"].any())
    page = (tmp_path / "runs" / "round" / "report.html").read_text()
    assert "<b>Normal</b>" in page
    assert "<b>Coverage</b>" in page
    found = json.loads((tmp_path / "runs" / "round" / "metrics.json").read_text())["mean"]
    assert 0 <= found["framed_share"] <= 1


def test_a_run_that_finds_its_training_cached_has_the_sliders_too(trained, capture, monkeypatch):  # noqa: F811
    monkeypatch.setenv("RTGS_ROOT", str(trained[0]))
    words = ["run", f"scene={capture}", "method=rtgs", *QUICK, *SECOND, "tracking=jsonl"]
    assert main([*words, "tracking.experiment=again", "evaluation.eight_bit=false"]) == 0
    (path,) = (trained[0] / "tracking" / "again").rglob("events.jsonl")
    events = [json.loads(line) for line in path.read_text().splitlines()]
    steps = [event["step"] for event in events if event["kind"] == "image" and event["name"] == "images_000/image"]
    assert steps == [4, 8, 12]


def test_pictures_are_small_and_come_in_the_order_of_their_steps(trained, monkeypatch):
    (artifact,) = Store(trained[0] / "store").artifacts("train_reflection")
    found = list(training_pictures(artifact.folder))
    assert [picture.step for picture in found] == sorted(picture.step for picture in found)
    assert all(picture.pixels.dtype == np.uint8 for picture in found)
    monkeypatch.setattr(pictures, "LONG_SIDE", 16)
    assert pictures._small(np.zeros((24, 32, 3), dtype=np.uint8)).shape == (12, 16, 3)
    assert pictures._small(np.zeros((10, 4), dtype=np.uint8)).shape == (10, 4)


def test_without_test_views_training_views_are_watched(capture):  # noqa: F811
    settings = SceneSettings(path=str(capture), points="random", random_points=50, long_side=16)
    assert [view.name for view in fixed_views(load_scene(settings))] == ["images/000.png", "images/008.png"]
    alone = load_scene(replace(settings, split_every=0))
    assert [view.name for view in fixed_views(alone)] == ["images/000.png", "images/005.png"]
