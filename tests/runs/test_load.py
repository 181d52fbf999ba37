"""``rtgs.load``: a finished run renders from Python what the pipeline rendered, to the bit."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

import rtgs
from pipelines.cli.main import main
from rtgs.runs.record import RunRecord
from rtgs.runs.views import read_render
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


@pytest.fixture(scope="module")
def run(root, capture) -> Path:
    """A run with reflections, from its first step on."""
    words = [f"scene={capture}", "method=envgs", "method.reflection.start=0.25", "name=mirror", *QUICK]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(["run", *words]) == 0
    return root / "runs" / "mirror"


@pytest.fixture
def loaded(run) -> rtgs.ShownRun:
    return rtgs.load(run)


def test_the_picture_is_the_one_of_the_pipeline_to_the_bit(run, loaded):
    record = RunRecord.read(run)
    assert record is not None
    key = record.steps["render"]
    stored = run.parent.parent / "store" / "render" / key[:2] / key
    assert loaded.scene.test
    for view in loaded.scene.test:
        kept = read_render(stored, view.name)
        seen = loaded.render(view.camera, view.mask)
        assert seen.image.equal(kept["image"])
        for name in ("depth", "normal", "alpha", "reflection", "diffuse"):
            assert seen[name].equal(kept[name]), name


def test_layers_add_up_to_the_image(loaded):
    seen = loaded.render(loaded.cameras[0])
    assert {"diffuse", "reflection", "reflection_weight", "specular"} <= set(seen.layers)
    whole = (1 - seen["specular"]) * seen["diffuse"] + seen["reflection"]
    assert torch.allclose(torch.where(seen["traced"] > 0.5, whole, seen.image), seen.image, atol=1e-5)
    assert not seen.image.requires_grad
    with pytest.raises(KeyError, match=r"no layer 'glass': it has image, depth, alpha, normal, .*reflection"):
        seen["glass"]


def test_what_a_run_has(run, loaded):
    assert loaded.name == "mirror"
    assert len(loaded.cameras) == 10
    assert set(loaded.sets) == {"base", "reflection"}
    assert len(loaded.sets["base"]) == len(rtgs.read_gaussians(run / "point_cloud.ply"))


def test_a_run_is_found_by_its_name_by_its_folder_and_as_the_newest(run, root, tmp_path, monkeypatch):
    assert rtgs.load("mirror").folder == run  # RTGS_ROOT
    assert rtgs.load().folder == run
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    assert rtgs.load("mirror", root=root).folder == run
    with pytest.raises(rtgs.RtgsError, match="no finished run 'mirror'"):
        rtgs.load("mirror")
    with pytest.raises(rtgs.RtgsError, match="start one with `rtgs run`"):
        rtgs.load()


def test_a_run_whose_store_is_gone_says_what_makes_it_again(run, tmp_path):
    copied = tmp_path / "runs" / "mirror"
    shutil.copytree(run, copied)
    with pytest.raises(rtgs.RtgsError, match=r"is not in .* any more; `rtgs run .*` makes it again"):
        rtgs.load(copied)
