"""The picture of a finished run, from a run folder made by hand."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from benchmarks.quality import picture
from pipelines.publishing.results import RUN_FILE
from pipelines.steps.evaluate import TABLE_JSON
from rtgs.core.errors import RtgsError
from rtgs.core.names import unique_stems
from rtgs.evaluate.evaluate import TimedRender, evaluate_views
from rtgs.evaluate.records import RunFacts, write_json
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.scenes.canonical import save_scene
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings

STEPS = {"import_scene": "a" * 64, "render": "b" * 64}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A run folder beside its store, and the names of its test views; renders are darkened photos."""
    root = tmp_path_factory.mktemp("root")
    scene = load_scene(SceneSettings(name="demo", path="embedded:ball_statue", long_side=32, max_views=24))
    folders = {step: root / "store" / step / print_[:2] / print_ for step, print_ in STEPS.items()}
    (folders["render"] / "views").mkdir(parents=True)
    save_scene(scene, folders["import_scene"])
    stems = unique_stems(view.name for view in scene.test)
    for number, view in enumerate(scene.test):
        size = view.image.shape[1:]
        maps = {"image": view.image * (0.9 - 0.1 * number), "depth": torch.rand(size) + 1, "alpha": torch.ones(size)}
        maps["normal"] = torch.nn.functional.normalize(torch.rand(3, *size), dim=0)
        save_file(maps, folders["render"] / "views" / f"{stems[view.name]}.safetensors")
    renders = [TimedRender(view.image * (0.9 - 0.1 * number)) for number, view in enumerate(scene.test)]
    facts = RunFacts("demo", "rtgs", "smoke", steps=1, surfels=1234)
    table = evaluate_views(renders, scene.test, facts, EvaluationSettings(lpips=False))
    run = root / "runs" / "demo-rtgs-smoke"
    run.mkdir(parents=True)
    write_json(run / TABLE_JSON, table)
    record = {"name": run.name, "command": "rtgs run scene=demo", "finished": "", "choices": {}, "steps": STEPS}
    (run / RUN_FILE).write_text(json.dumps(record), encoding="utf-8")
    return run, [view.name for view in scene.test]


def test_median_and_best_view(finished, tmp_path, monkeypatch, capsys) -> None:
    run, names = finished
    output = tmp_path / "demo.jpg"
    monkeypatch.setattr(sys, "argv", ["picture", str(run), str(output)])
    picture.main()
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["views"] == names[:2], "of three views, each darker than the one before, the best and the median"
    assert output.stat().st_size == found["bytes"] <= picture.MAX_BYTES
    with Image.open(output) as sheet:
        assert sheet.format == "JPEG"
        assert list(sheet.size) == found["size"]
        assert sheet.width == picture.WIDTH


def test_no_run_is_said(tmp_path) -> None:
    with pytest.raises(RtgsError, match=r"is no finished run: it has no readable run\.json"):
        picture.artifact(tmp_path, "render")


def test_missing_artifact_is_said(finished) -> None:
    with pytest.raises(RtgsError, match="run `rtgs run scene=demo` again"):
        picture.artifact(finished[0], "train_diffuse")
