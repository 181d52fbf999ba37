"""Two training stages through the command line; what they share between ablations."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from pipelines.cli.main import main
from pipelines.planning.graph import build_graph
from rtgs.config import compose
from rtgs.config.names import overridden
from rtgs.gaussians.materials import has_materials
from rtgs.gaussians.ply import read_ply
from rtgs.runs.training import stage_params
from rtgs.scenes import canonical
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

SECOND = ("method.reflection.cells=3", "method.reflection.matte.probation=0", "method.loss.perceptual=0")


def training(capture: Path, *words: str) -> dict[str, object]:  # noqa: F811
    config, choices = compose(["scene=capture", f"scene.path={capture}", "preset=smoke", "scene.points=random", *words])
    return {step.name: step.params for step in build_graph(config, choices).training}


def test_ablations_of_the_second_stage_share_the_first(capture: Path):  # noqa: F811
    plain = training(capture, "method=rtgs")
    assert list(plain) == ["train_diffuse", "train_reflection"]
    for words in (
        ("ablation=split_sum",),
        ("method.materials.specular=0.3", "method.optimizer.f0_logits=0.5"),
        ("method.reflection.cells=7", "method.loss.perceptual=0.5"),
    ):
        other = training(capture, "method=rtgs", *words)
        assert other["train_diffuse"] == plain["train_diffuse"], words
        assert other["train_reflection"] != plain["train_reflection"], words
    longer = training(capture, "method=rtgs", "method.reflection.start=0.5")
    assert longer["train_diffuse"] != plain["train_diffuse"]


@pytest.mark.parametrize("name", ["rtgs", "envgs"])
def test_both_stages_run_and_leave_two_sets_and_layers(root: Path, capture: Path, name: str, capsys, monkeypatch):  # noqa: F811
    read: list[Path] = []
    whole = canonical.read_scene
    monkeypatch.setattr(canonical, "read_scene", lambda folder: read.append(folder) or whole(folder))
    words = ["run", f"scene={capture}", f"method={name}", *QUICK, *SECOND]
    assert main(words) == 0
    assert len(read) == 1  # training, rendering, evaluation, report and tracker share the scene
    capsys.readouterr()
    store = root / "store" / "train_reflection"
    made = [manifest.parent for manifest in store.glob("*/*/manifest.json")]
    found = [folder for folder in made if stage_params(folder).method.name == name]
    assert len(found) == 1
    base, reflection = read_ply(found[0] / "base.ply"), read_ply(found[0] / "reflection.ply")
    assert has_materials(base)
    assert not has_materials(reflection)
    assert len(reflection) > 0
    summary = json.loads((found[0] / "summary.json").read_text())
    assert summary["steps"] == 12
    run = root / "runs" / f"tiny_room-{name}-smoke-{overridden([*QUICK, *SECOND])}"
    page = (run / "report.html").read_text()
    layers = ("Diffuse", "Reflection", "Normal", "Specular", "Roughness", "f0", "Final")
    assert all(f"Enlarge {layer}, rendered" in page for layer in layers)
    assert {path.name for path in run.glob("*.ply")} == {"point_cloud.ply", "reflection.ply"}
    assert main(words) == 0
    assert "nothing to do" in capsys.readouterr().err


def test_the_split_sum_figure_shares_the_first_stage_and_shows_the_layers_of_both(root: Path, capture: Path):  # noqa: F811
    words = ["run", "experiment=fig_split_sum", "hydra/launcher=basic", f"scene={capture}", *QUICK, *SECOND]
    assert main(words) == 0
    made = {
        step: [stage_params(path.parent).method for path in (root / "store" / step).glob("*/*/manifest.json")]
        for step in ("train_diffuse", "train_reflection")
    }  # the store is shared with the tests above
    first, second = ([method for method in methods if method.name == "rtgs"] for methods in made.values())
    assert len(first) == 1
    weights = sorted((method.optics.weight, method.optics.max_gain) for method in second)
    assert weights == [("microfacet", 0.0), ("microfacet", 1.0), ("microfacet", 16.0), ("split_sum", 1.0)]
    pictures = []
    rows = ("gain_unbounded", "none", "gain_16", "split_sum")
    named = overridden([*QUICK, *SECOND])
    for run in (f"tiny_room-rtgs-smoke{'' if row == 'none' else f'-{row}'}-{named}" for row in rows):
        page = (root / "runs" / run / "report.html").read_text(encoding="utf-8")
        assert all(f"Enlarge {layer}, rendered" in page for layer in ("Diffuse", "Reflection", "Roughness"))
        pictures.append(json.loads((root / "runs" / run / "metrics.json").read_text())["mean"]["psnr"])
    assert len(set(pictures)) == len(rows)
    with (root / "tables" / "fig_split_sum-smoke" / "table.csv").open(encoding="utf-8") as stream:
        found = [row["method"] for row in csv.DictReader(stream)]
    assert found == ["rtgs" if row == "none" else f"rtgs, {row}" for row in rows]
