"""Runs never overwrite each other silently."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import shutil
from pathlib import Path

from pipelines.cli.main import main
from pipelines.publishing.results import replaced
from pipelines.publishing.run_names import with_own_name
from rtgs.config import Choices, RunConfig, compose
from rtgs.runs.record import RunRecord
from tests.pipelines.app_cases import NAMED, QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


def composed(place: Path, tmp_path: Path, *words: str) -> tuple[RunConfig, Choices]:
    place.mkdir(parents=True, exist_ok=True)
    return compose(["scene=capture", f"scene.path={place}", f"paths.root={tmp_path}", "method=2dgs", *words])


def test_another_capture_of_the_same_folder_name_gets_another_name(tmp_path):
    one, other = (composed(tmp_path / place / "kitchen", tmp_path, "seed=1") for place in ("one", "other"))
    assert one[0].name == other[0].name == "kitchen-2dgs-quick-seed1"
    for _ in range(2):  # repeated runs find their names again
        assert with_own_name(*one, claim=True).name == "kitchen-2dgs-quick-seed1"
        named = str(with_own_name(*other, claim=True).name)
        assert named.startswith("kitchen_")
        assert named.endswith("-2dgs-quick-seed1")
    assert with_own_name(*other).name == named
    assert not (tmp_path / "runs" / f".{named}.capture").exists()


def test_a_name_that_was_given_stays_and_so_does_that_of_a_capture_that_moved(tmp_path):
    one, other = (composed(tmp_path / place / "kitchen", tmp_path) for place in ("one", "other"))
    with_own_name(*one, claim=True)
    given = composed(tmp_path / "other" / "kitchen", tmp_path, "name=kitchen-2dgs-quick", "seed=2")
    assert with_own_name(*given, claim=True).name == "kitchen-2dgs-quick"
    shutil.rmtree(tmp_path / "one")
    assert with_own_name(*other, claim=True).name == "kitchen-2dgs-quick"


def test_a_run_of_an_older_version_keeps_its_folder(tmp_path):
    one, other = (composed(tmp_path / place / "kitchen", tmp_path) for place in ("one", "other"))
    folder = tmp_path / "runs" / "kitchen-2dgs-quick"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(f"scene:\n  path: {tmp_path / 'one' / 'kitchen'}\n")
    assert with_own_name(*other).name != "kitchen-2dgs-quick"
    assert with_own_name(*one).name == "kitchen-2dgs-quick"


def test_films_and_exports_of_the_model_before_are_put_aside(root, capture, capsys):
    words = ["run", f"scene={capture}", "method=2dgs", *QUICK, "name=twice"]
    assert main([*words, "seed=1"]) == 0
    folder = root / "runs" / "twice"
    for place in ("exports/twice.ply", "shown/orbit-final/film.mp4"):
        (folder / place).parent.mkdir(parents=True)
        (folder / place).write_text("first")
    assert main([*words, "seed=1"]) == 0
    assert (folder / "exports" / "twice.ply").is_file(), "the same model"
    capsys.readouterr()
    assert main([*words, "seed=2"]) == 0
    left = (path for path in folder.rglob("*") if path.suffix in (".ply", ".mp4"))
    assert sorted(path.relative_to(folder).as_posix() for path in left) == [
        *("before/exports/twice.ply", "before/shown/orbit-final/film.mp4", "point_cloud.ply"),
    ]
    assert "exports are of the model before: now in" in capsys.readouterr().err
    assert "twice.ply" not in (folder / "report.html").read_text(encoding="utf-8")


def test_what_is_replaced_is_told():
    before = RunRecord("a", "rtgs run seed=1", "2026", {}, {})
    assert "showed another run" in replaced(Path("runs/a"), before, "rtgs run seed=2")
    assert "`rtgs run seed=1` brings the other back" in replaced(Path("runs/a"), before, "rtgs run seed=2")
    assert "results of 2026 are replaced" in replaced(Path("runs/a"), before, "rtgs run seed=1")


def test_a_sweep_over_a_key_prints_a_report_for_each_job(root, capture, capsys):
    words = [f"scene={capture}", "method=2dgs", *QUICK, "schedule.total=6"]
    assert main(["run", "--multirun", *words, "seed=3", "method.loss.dssim=0.1,0.3"]) == 0
    told = capsys.readouterr()
    reports = [line for line in told.out.splitlines() if line.startswith("report: ")]
    assert len(set(reports)) == 2
    assert all((root / line.removeprefix("report: ")).is_file() for line in reports)
    assert "showed another run" not in told.err
    assert main(["run", *words, "name=same"]) == 0
    assert "showed another run" not in capsys.readouterr().err
    assert main(["run", *words, "seed=3", "method.loss.dssim=0.1", "name=same"]) == 0
    assert "same showed another run and now shows this one; name=... keeps both" in capsys.readouterr().err
