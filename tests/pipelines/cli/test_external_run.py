"""Pictures of another program as a row: those of one of our own methods score the same to the digit."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.torch import load_file

from pipelines.cli.main import main
from rtgs.evaluate.records import EvaluationTable, read_json
from tests.pipelines.app_cases import NAMED, QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

FLOATS = ("psnr", "ssim", "flip", "psnr_8bit", "ssim_8bit")


def scores(root: Path, run: str) -> EvaluationTable:
    return read_json(root / "runs" / run / "metrics.json")


def test_pictures_of_our_own_score_the_same_to_the_digit(capture: Path, root: Path, capsys):
    words = [f"scene={capture}", *QUICK]
    assert main(["run", *words, "method=2dgs"]) == 0
    ours = scores(root, f"tiny_room-2dgs-smoke{NAMED}")
    outside = root / "outside"
    shutil.copytree(root / "runs" / f"tiny_room-2dgs-smoke{NAMED}" / "renders", outside / "png")
    (outside / "npy").mkdir()
    (views,) = root.glob("store/render/*/*/views")
    for path in views.glob("*.safetensors"):
        np.save(outside / "npy" / f"{path.stem}.npy", load_file(path)["image"].numpy())
    external = [*words, "method=external", "external.colors=srgb"]
    assert main(["run", *external, f"external.renders={outside / 'npy'}", "external.name=Some Tool 2"]) == 0
    told = capsys.readouterr().out
    assert "Some Tool 2" in told
    floats = scores(root, f"tiny_room-external_Some_Tool_2-smoke{NAMED}")
    assert floats.facts.method == "Some Tool 2"
    assert floats.facts.train_seconds is None
    for metric in FLOATS:
        mine, theirs = ([row.values[metric] for row in table.rows] for table in (ours, floats))
        assert mine == theirs
        assert None not in mine
    (root / "conf" / "method").mkdir(parents=True)  # several programs: a file for each
    of_mine = {"method": {"name": "external"}, "external": {"name": "Mine", "renders": str(outside / "png")}}
    (root / "conf" / "method" / "mine.yaml").write_text(f"# @package _global_\n{yaml.safe_dump(of_mine)}")
    assert main(["run", "--config-dir", str(root / "conf"), *words, "method=mine"]) == 0
    stored = scores(root, f"tiny_room-external_Mine-smoke{NAMED}")
    assert [row.values["psnr_8bit"] for row in stored.rows] == [row.values["psnr_8bit"] for row in ours.rows]
    assert [row.values["ssim_8bit"] for row in stored.rows] == [row.values["ssim_8bit"] for row in ours.rows]
    page = (root / "runs" / f"tiny_room-external_Mine-smoke{NAMED}" / "report.html").read_text()
    assert "pictures of another program" in page
    assert not list((root / "runs" / f"tiny_room-external_Mine-smoke{NAMED}").glob("*.ply"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "external.renders is empty"),
        (["external.renders=/no/where"], "is no folder"),
        (["external.renders=.", "judge=photos"], "judge.plain=3dgs with method=external"),
        (["external.renders=.", "mesh.extract=true"], "mesh.extract=true with method=external"),
        (["external.renders=.", "evaluation.supersample=4"], "evaluation.supersample=4 with method=external"),
        (["external.renders=.", "evaluation.refined_poses=always"], "refined_poses=always with method=external"),
        (["external.renders=.", "watch.steps=[5]"], "watch.steps with method=external"),
        (["external.renders=.", "watch.cpu_seconds=[5]"], "watch.cpu_seconds with method=external"),
        (["external.renders=.", "ablation=no_densify"], "ablation=no_densify takes nothing away from method external"),
    ],
)
def test_what_only_a_training_has_is_refused(words, message, capture: Path, capsys):
    assert main(["run", f"scene={capture}", *QUICK, "method=external", *words]) == 1
    assert message in capsys.readouterr().err
