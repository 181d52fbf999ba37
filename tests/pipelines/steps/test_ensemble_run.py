"""A run of several models, through the command line: its pictures are the mean of theirs, its cost is that of all."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from pipelines.cli.main import main
from pipelines.publishing.exported_run import export_run, has_glass
from pipelines.publishing.results import result_table
from pipelines.steps.evaluate import _of_all
from pipelines.steps.training import read_summary
from rtgs.evaluate.records import read_json
from rtgs.export.bake import BakeSettings
from rtgs.gaussians.ply import read_gaussians
from rtgs.runs.mixture import Ensemble, Judged, evaluated
from rtgs.runs.shown import load
from rtgs.runs.training import CHECKPOINT_FOLDER, load_method
from rtgs.runs.views import read_render
from rtgs.scenes.canonical import read_scene
from rtgs.train.checkpoint import load_checkpoint
from rtgs.workflow import beside
from rtgs.workflow.manifest import Manifest
from tests.pipelines.app_cases import QUICK, _in_root, capture, finished, folders, root  # noqa: F401  (fixtures)

THREE = ("method=2dgs", "ensemble.members=3", "evaluation.refined_poses=always", "evaluation.refine_steps=2", *QUICK)


@pytest.fixture(scope="module")
def together(capture, root) -> Path:
    """The folder of a finished run of three models."""
    return finished(root, capture, THREE, "together")


def test_a_picture_is_the_mean_of_what_the_models_show(together):
    made = folders(together)
    scene = read_scene(made["import_scene"])
    models = [load_method(made[name], scene) for name in ("train_diffuse", "member_1", "member_2")]
    for view in scene.test:
        tensors = read_render(made["render"], view.name)
        each = [evaluated(method, stage.until, view.camera) for method, stage in models]
        assert not torch.equal(each[0], each[1])
        assert not torch.equal(each[1], each[2])
        torch.testing.assert_close(tensors["image"], torch.stack(each).clamp(0, 1).mean(0), rtol=0, atol=1e-6)
        assert torch.equal(tensors["image_full"], each[0])
        assert not torch.equal(tensors["image_refined_pose"], tensors["image"])
        found = load(together).render(view.camera)
        assert torch.equal(found.image, tensors["image"])
        assert torch.equal(found.depth, tensors["depth"])


def test_models_trained_side_by_side_are_the_same(together, capture, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(beside, "machine_cores", lambda: 2)
    monkeypatch.setattr(beside, "machine_memory", lambda: 8e9)
    words = [word for word in THREE if word != "threads=1"]
    at_once = folders(finished(tmp_path, capture, (*words, "threads=2"), "together"))
    lines = capfd.readouterr().err.splitlines()
    (first, *_) = (line for line in lines if line.endswith("in a process beside this one"))
    assert "member_1" in first
    assert any(line.startswith("member_1: diffuse: step 12/12") for line in lines)
    one_by_one = folders(together)
    assert at_once.keys() == one_by_one.keys()
    for name in ("train_diffuse", "member_1", "member_2"):
        models = (load_checkpoint(made[name] / CHECKPOINT_FOLDER).tensors for made in (at_once, one_by_one))
        same, own = (dict(tensors) for tensors in models)
        assert same.keys() == own.keys()
        assert all(torch.equal(same[key], own[key]) for key in own)
    first, second = (sorted(made["render"].glob("**/*.safetensors")) for made in (at_once, one_by_one))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    assert first


def test_processes_can_be_forbidden(capture, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(beside, "machine_cores", lambda: 2)
    monkeypatch.setattr(beside, "machine_memory", lambda: 8e9)
    words = [word for word in THREE if word != "threads=1"]
    finished(tmp_path, capture, (*words, "threads=2", "processes=1"), "alone")
    lines = capfd.readouterr().err
    assert "member_1" in lines
    assert "side by side" not in lines
    assert "beside" not in lines


def test_its_squared_error_is_below_the_mean_of_theirs(together):
    """By what the pictures differ: the mean of the squared distances to their mean."""
    made = folders(together)
    scene = read_scene(made["import_scene"])
    models = [load_method(made[name], scene) for name in ("train_diffuse", "member_1", "member_2")]
    for view in scene.test:
        image = read_render(made["render"], view.name)["image"].double()
        each = torch.stack([evaluated(method, stage.until, view.camera).clamp(0, 1) for method, stage in models])
        apart = (each.double() - image).square().mean()
        error, theirs = ((shown - view.image.double()).square().mean() for shown in (image, each.double()))
        assert float(error) == pytest.approx(float(theirs - apart), abs=1e-7)
        assert apart > 1e-6


def test_what_all_models_cost_is_in_the_table(together):
    made = folders(together)
    each = [read_summary(made[name]) for name in ("train_diffuse", "member_1", "member_2")]
    facts = json.loads((together / "metrics.json").read_text())["facts"]
    assert (facts["method"], facts["models"]) == ("2dgs", 3)
    assert facts["train_seconds"] == pytest.approx(sum(one.seconds for one in each))
    assert facts["train_cpu_seconds"] == pytest.approx(sum(one.cpu_seconds for one in each))
    assert facts["peak_memory_mb"] == max(one.peak_memory_mb for one in each)
    assert facts["surfels"] == sum(one.surfels for one in each)
    assert facts["steps"] == each[0].steps == 12


def test_the_mesh_that_a_further_model_waits_for_is_paid(together):
    made = folders(together)
    own = read_summary(made["train_diffuse"])
    inputs = {"member_1": made["member_1"], "member_1_extract_mesh": made["import_scene"]}
    mesh = Manifest.read(made["import_scene"])
    assert mesh is not None
    with_mesh, without = _of_all(own, inputs), _of_all(own, {"member_1": made["member_1"]})
    assert with_mesh.seconds - without.seconds == pytest.approx(mesh.duration)
    assert _of_all(own, {}) == own
    assert replace(without, seconds=0, cpu_seconds=0, peak_memory_mb=0, surfels=0) == replace(
        own, seconds=0, cpu_seconds=0, peak_memory_mb=0, surfels=0
    )


def test_a_member_is_the_run_of_its_seed(together, root, capture):
    """The same training by itself, bit for bit."""
    words = [word for word in THREE if not word.startswith("ensemble")]
    assert main(["run", f"scene.path={capture}", *words, "seed=1000", "name=alone"]) == 0
    alone, member = folders(root / "runs" / "alone")["train_diffuse"], folders(together)["member_1"]
    found, expected = (load_checkpoint(each / CHECKPOINT_FOLDER).tensors for each in (alone, member))
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in found)


def test_one_more_model_is_the_only_one_that_is_trained(together, root, capture):
    before = folders(together)
    words = ["ensemble.members=4" if word.startswith("ensemble") else word for word in THREE]
    assert main(["run", f"scene.path={capture}", *words, "name=four"]) == 0
    after = folders(root / "runs" / "four")
    assert {name for name in after if after[name] != before.get(name)} == {"member_3", "render", "evaluate", "report"}


def test_one_set_is_fitted_to_the_mean_and_the_file_of_the_run_is_its_own(together, tmp_path):
    run = load(together)
    exported = export_run(run, BakeSettings(steps=3), tmp_path)
    for camera, layered in zip(exported.cameras, exported.layered, strict=True):
        assert torch.equal(layered, run.maps(camera)["image"].clamp(0, 1))
        assert not torch.equal(layered, evaluated(run.method, run.step, camera).clamp(0, 1))
    assert exported.record.psnr is not None
    own = read_gaussians(together / "point_cloud.ply", channels=())
    assert len(own) == len(run.method.sets[0].gaussians)


def test_a_file_keeps_the_glass_of_an_ensemble_but_not_where_a_judge_may_have_replaced_it(monkeypatch):
    """Then walls of glass are no part of the set, but a mesh of their own (docs/export.md)."""
    monkeypatch.setattr("rtgs.export.glass.glass_part", lambda model: model)
    replaced = Judged(regions=None, replaced=(0,), plain=None, step=0)
    for mixture, expected in ((None, True), (Ensemble(()), True), (replaced, False)):
        assert has_glass(SimpleNamespace(method="with glass", mixture=mixture)) is expected
    assert not has_glass(SimpleNamespace(method=None, mixture=None))


def test_the_table_of_a_command_says_how_many(together):
    table = read_json(together / "metrics.json")
    assert "2dgs, mean of 3" in result_table([table])
    assert (together / "metrics.csv").read_text().count('"2dgs, mean of 3"') == len(table.rows) + 2  # mean and std
    assert "mean" not in result_table([replace(table, facts=replace(table.facts, models=1))])


def test_a_mask_is_for_all_models(together):
    """With it a run renders a test view to the bit as it was rendered."""
    seen = []

    class Mixture:
        def of(self, camera, image, mask=None, options=None):
            seen.append(mask)
            return image + 1

    run = replace(load(together), mixture=Mixture())
    camera = run.scene.test[0].camera
    mask = torch.ones(camera.height, camera.width, dtype=torch.bool)
    alone = replace(run, mixture=None).maps(camera, mask)["image"]
    assert torch.equal(run.maps(camera, mask)["image"], alone + 1)
    assert len(seen) == 1
    assert seen[0] is mask


def test_a_gone_model_is_told(together, root, capture):
    made = folders(together)
    aside = made["member_2"].with_name("aside")
    made["member_2"].rename(aside)
    try:
        with pytest.raises(Exception, match=r"together: member_2 is not in .* `rtgs run .*` makes it again"):
            load(together)
    finally:
        aside.rename(made["member_2"])


def test_the_report_names_the_steps_and_the_words(together):
    page = (together / "report.html").read_text(encoding="utf-8")
    for name in ("member_1", "member_2", "ensemble.members", "3 models"):
        assert name in page
