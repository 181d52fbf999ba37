"""From photos alone to a table, through the command line; and what the plan says before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli.main import main
from tests.prepare.room import HEIGHT, WIDTH, walk, write_photos

QUICK = (
    "preset=smoke",
    "scene.long_side=64",
    "sfm.features.max_features=600",
    "schedule.total=12",
    "schedule.checkpoint_every=6",
    "schedule.densify_every=5",
    "tracking=off",
    "threads=1",
)


@pytest.fixture
def photos(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "my room"
    write_photos(folder, walk(6))
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[80:160, 120:200] = 255
    (folder / "masks").mkdir()
    Image.fromarray(mask).save(folder / "masks" / "photo_02.png")
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    return folder


def plan(capsys, *words: str) -> list[list[str]]:
    assert main(["plan", *words]) == 0
    return [line.split(maxsplit=3) for line in capsys.readouterr().out.splitlines()]


def test_photos_become_a_table(photos, tmp_path, capsys):
    words = [f"scene={photos}", *QUICK, "ablation=two_stages"]  # one mask bounds no object
    rows = [row[0] for row in plan(capsys, *words)[1:6]]
    assert rows == ["masks", "normals", "train_transmittance", "sfm", "import_scene"]
    assert main(["run", *words]) == 0
    shown = capsys.readouterr().out
    assert "PSNR" in shown
    (run,) = (path for path in (tmp_path / "root/runs").iterdir() if path.is_dir())
    assert {"report.html", "sfm.json", "coverage.png", "metrics.json"} <= {path.name for path in run.iterdir()}
    assert "6 of 6 photos registered" in (run / "report.html").read_text()
    assert "7 from the cache, nothing to do" in " ".join(plan(capsys, *words)[-1])
    other = {row[0]: row for row in plan(capsys, *words, "sfm=fast") if len(row) > 3}
    assert "settings.features.max_side: 1600 -> 1000" in other["sfm"][3]
    assert "upstream sfm changed" in other["import_scene"][3]
    split = {row[0]: row for row in plan(capsys, *words, "scene.split_every=3") if len(row) > 2}
    assert split["sfm"][2] == "cached", "how a scene is split does not concern its poses"
    assert "split_every: 8 -> 3" in " ".join(split["import_scene"])


def test_given_poses_are_kept_and_the_plan_says_so(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    rows = plan(capsys, "scene=demo", "tracking=off")
    assert " ".join(rows[1]).startswith("sfm skipped embedded:ball_statue brings its poses")


def test_check_speaks_of_photos_without_poses(photos, capsys):
    (photos / "broken.jpg").write_bytes(b"x")
    assert main(["check", str(photos)]) == 0
    shown = capsys.readouterr().out
    assert "1 of 7 photos cannot be read" in shown
    assert "`rtgs run` looks for them first" in shown
    for path in sorted(photos.glob("photo_0[1-5].jpg")):
        path.unlink()
    assert main(["check", str(photos)]) == 1
    assert "error: 1 usable photos" in capsys.readouterr().out


def test_a_failed_search_is_one_message_with_advice(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path / "root"))
    rng = np.random.default_rng(0)
    (tmp_path / "noise").mkdir()
    for index in range(3):
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "noise" / f"{index}.jpg")
    assert main(["run", f"scene={tmp_path / 'noise'}", *QUICK]) == 1
    error = capsys.readouterr().err
    assert "none of 3 photos" in error
    assert "  - 3 photos match no other" in error
    assert "Traceback" not in error
