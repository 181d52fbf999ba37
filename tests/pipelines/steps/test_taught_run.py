"""A run that is taught, through the command line: what the teachers show is what it learns from, and what it cost."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pipelines.cli.main import main
from pipelines.steps.training import _of_all, read_summary
from rtgs.evaluate.images import to_bytes
from rtgs.runs.mixture import evaluated
from rtgs.runs.pseudo import read_pseudo
from rtgs.runs.training import CHECKPOINT_FOLDER, PSEUDO_VIEWS, load_method, stage_params
from rtgs.scenes.around import cameras_around
from rtgs.scenes.canonical import read_scene
from rtgs.train.checkpoint import load_checkpoint
from rtgs.train.seeds import generator_for
from rtgs.workflow.manifest import Manifest
from tests.pipelines.app_cases import QUICK, _in_root, capture, finished, folders, root  # noqa: F401  (fixtures)

TAUGHT = ("method=2dgs", "distill.teachers=2", "distill.views=2", "distill.most=5", *QUICK)


@pytest.fixture(scope="module")
def taught(capture, root, tmp_path_factory) -> Path:
    """The folder of a finished run."""
    return finished(root, capture, TAUGHT, "taught")


def test_a_pseudo_view_is_the_mean_of_what_the_teachers_show(taught):
    made = folders(taught)
    scene = read_scene(made["import_scene"])
    pseudo = read_pseudo(made["pseudo_views"])
    teachers = [load_method(made[name], scene) for name in ("teacher_1", "teacher_2")]
    assert len(pseudo.views) == 2 * len(scene.train)
    assert len({view.name for view in pseudo.views}) == 5
    for view in pseudo.views[:5]:
        first, second = (evaluated(method, stage.until, view.camera).clamp(0, 1) for method, stage in teachers)
        assert not torch.equal(first, second)
        shown = torch.from_numpy(to_bytes(view.image)).int()
        assert int((shown - torch.from_numpy(to_bytes((first + second) / 2)).int()).abs().max()) == 0


def test_cameras_are_those_of_the_seed(taught):
    made = folders(taught)
    scene = read_scene(made["import_scene"])
    photos = [view.camera for view in scene.train]
    for seed in (0, 1):
        given = cameras_around(photos, scene.extent, 5, generator_for(seed, PSEUDO_VIEWS))
        found = [view.camera for view in read_pseudo(made["pseudo_views"]).views[:5]]
        assert (seed == 0) == all(torch.equal(a.center, b.center) for a, b in zip(given, found, strict=True))


def test_no_more_pictures_are_made_than_are_visited(taught, root, capture):
    words = [word for word in TAUGHT if not word.startswith("distill.most")]
    assert main(["run", f"scene.path={capture}", *words, "name=all"]) == 0
    made = folders(root / "runs" / "all")
    pictures = len(list((made["pseudo_views"] / "images").iterdir()))
    assert pictures == len(read_pseudo(made["pseudo_views"]).views) == 2 * len(read_scene(made["import_scene"]).train)


def test_the_run_visits_them_beside_the_photos(taught):
    made = folders(taught)
    scene = read_scene(made["import_scene"])
    orders = {
        name: len(load_checkpoint(made[name] / CHECKPOINT_FOLDER).tensors["views.permutation"])
        for name in ("teacher_1", "train_diffuse")
    }
    assert orders == {"teacher_1": len(scene.train), "train_diffuse": 3 * len(scene.train)}


def test_what_the_teachers_cost_is_in_the_run_and_in_its_table(taught):
    made = folders(taught)
    teachers = [read_summary(made[name]) for name in ("teacher_1", "teacher_2")]
    student, pseudo = read_summary(made["train_diffuse"]), read_pseudo(made["pseudo_views"])
    for key in ("seconds", "cpu_seconds"):
        paid = sum(getattr(each, key) for each in teachers)
        assert getattr(student, key) > paid > 0
    assert pseudo.spent.cpu > sum(each.cpu_seconds for each in teachers)
    assert student.cpu_seconds > pseudo.spent.cpu
    assert student.peak_memory_mb >= pseudo.peak_memory_mb == max(each.peak_memory_mb for each in teachers)
    facts = json.loads((taught / "metrics.json").read_text())["facts"]
    assert facts["train_cpu_seconds"] == student.cpu_seconds
    assert facts["steps"] == student.steps == 12


def test_the_peak_is_that_of_the_training_that_took_most(taught):
    made = folders(taught)
    student, pseudo = read_summary(made["train_diffuse"]), read_pseudo(made["pseudo_views"])
    for peak in (student.peak_memory_mb - 100, student.peak_memory_mb + 100):
        found = _of_all(student, replace(pseudo, peak_memory_mb=peak))
        assert found == replace(student, peak_memory_mb=max(peak, student.peak_memory_mb))


def test_the_report_names_the_steps_and_the_words(taught):
    page = (taught / "report.html").read_text(encoding="utf-8")
    for name in ("teacher_1", "teacher_2", "pseudo_views", "distill.teachers"):
        assert name in page


def test_a_second_run_finds_all_of_it_in_the_store(taught, root, capture):
    dates = {name: Manifest.read(folder) for name, folder in folders(taught).items()}
    assert main(["run", f"scene.path={capture}", *TAUGHT, "name=again"]) == 0
    assert {name: Manifest.read(folder) for name, folder in folders(root / "runs" / "again").items()} == dates


def test_a_teacher_is_the_run_of_its_seed(taught, root, capture):
    """The same training by itself, bit for bit."""
    words = [word for word in TAUGHT if not word.startswith("distill")]
    assert main(["run", f"scene.path={capture}", *words, "seed=1000", "name=alone"]) == 0
    alone, teacher = folders(root / "runs" / "alone")["train_diffuse"], folders(taught)["teacher_1"]
    assert stage_params(alone) == stage_params(teacher)
    found, expected = (load_checkpoint(each / CHECKPOINT_FOLDER).tensors for each in (alone, teacher))
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in found)
