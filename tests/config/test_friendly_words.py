"""Folders among the words of a run: alone, without a key, and in lists of scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtgs.config.sweep import compose_jobs
from rtgs.config.words import friendly_overrides


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "my photos").mkdir()
    return tmp_path / "my photos"


def test_a_folder_or_a_scene_needs_no_key(folder, monkeypatch):
    path = f"scene.path='{folder}'"
    assert friendly_overrides([str(folder), "method=2dgs"]) == ["scene=capture", path, "method=2dgs"]
    assert friendly_overrides(["-m", "toycar", "seed=0,1"]) == ["-m", "scene=toycar", "seed=0,1"]
    assert friendly_overrides(["--cfg", "job", "toycar"]) == ["--cfg", "job", "scene=toycar"]
    assert friendly_overrides(["--config-dir", str(folder), "seed=1"]) == ["--config-dir", str(folder), "seed=1"]
    assert friendly_overrides(["unheard"]) == ["unheard"]
    monkeypatch.chdir(folder.parent)
    assert friendly_overrides(["my photos"]) == ["scene=capture", "scene.path='my photos'"]


def test_a_folder_may_have_an_equals_sign_in_its_name(tmp_path, monkeypatch):
    (tmp_path / "seed=3").mkdir()
    path = f"scene.path='{tmp_path / 'seed=3'}'"
    assert friendly_overrides([str(tmp_path / "seed=3"), "seed=1"]) == ["scene=capture", path, "seed=1"]
    monkeypatch.chdir(tmp_path)
    assert friendly_overrides(["./seed=3"]) == ["scene=capture", "scene.path='./seed=3'"]
    assert friendly_overrides(["seed=3"]) == ["seed=3"]  # the key


def test_a_list_of_scenes_may_hold_folders(folder):
    words = friendly_overrides([f"scene=demo,{folder}", "method=2dgs,3dgs"])
    jobs, sweep = compose_jobs(words, multirun=True)
    assert sweep
    titles = ["ball_statue-2dgs-quick", "ball_statue-3dgs-quick", "my_photos-2dgs-quick", "my_photos-3dgs-quick"]
    assert [job.title for job in jobs] == titles
    config, choices = jobs[2].config, jobs[2].choices
    assert config is not None
    assert choices is not None
    assert config.scene.path == str(folder)
    assert (choices.scene_file, choices.scene) == ("capture", "my_photos")
    assert choices.overrides == (f"scene.path='{folder}'",)  # what repeats this one job


def test_folders_of_one_name_stay_apart(tmp_path):
    for place in ("one", "other"):
        (tmp_path / place / "room").mkdir(parents=True)
    words = friendly_overrides([f"scene={tmp_path / 'one' / 'room'},{tmp_path / 'other' / 'room'}"])
    jobs, _ = compose_jobs(words, multirun=True)
    assert [job.config and Path(job.config.scene.path).parent.name for job in jobs] == ["one", "other"]


def test_names_alone_stay_as_they_are():
    assert friendly_overrides(["scene=toycar,spheres"]) == ["scene=toycar,spheres"]
    assert friendly_overrides(["scene=nu_nerf/popcorncup,toycar"]) == ["scene=nu_nerf/popcorncup,toycar"]
