"""A password in ``tracking.uri`` is in no file of a finished run, and in nothing that is printed."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipelines.cli.main import main, report_error
from rtgs.core.errors import RtgsError
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

SECRET = "hunter2"
URI = f"http://me:{SECRET}@127.0.0.1:9"
QUOTED = f"http://me:it's {SECRET}@127.0.0.1:9"


@pytest.fixture(autouse=True)
def _environment(monkeypatch):
    monkeypatch.setenv("RTGS_TRACKING_URI", "")  # put back afterwards


@pytest.fixture
def words(capture) -> list[str]:
    return ["run", f"scene={capture}", "method=2dgs", *QUICK, "tracking=jsonl"]


def _holding(folder: Path, text: str) -> list[str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) > 20
    return [str(path.relative_to(folder)) for path in files if text.encode() in path.read_bytes()]


def test_given_as_a_word(root, words, capsys):
    assert main([*words, f"tracking.uri={URI}"]) == 0
    assert os.environ["RTGS_TRACKING_URI"] == URI
    written = {path.name for path in root.rglob("*.yaml")}
    assert {"config.yaml", "hydra.yaml", "overrides.yaml"} <= written  # .hydra/, the run folder, the tracked copy
    assert _holding(root, SECRET) == []
    assert SECRET not in "".join(capsys.readouterr())


def test_given_in_a_file_of_the_user(root, words, tmp_path):
    own = tmp_path / "conf" / "tracking"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text(f"kind: jsonl\nuri: {QUOTED}\n")
    assert main([*words[:-1], f"--config-dir={own.parent}", "tracking=mine", "name=from_file"]) == 0
    assert (root / "runs" / "from_file" / "config.yaml").is_file()
    assert _holding(root, SECRET) == []


def test_given_to_a_sweep(root, words, capsys):
    sweep = [*words, f"tracking.uri={QUOTED}", "--multirun", "seed=0,1", "scene.long_side=-1"]  # and both jobs fail
    assert main(sweep) == 1
    assert SECRET not in "".join(capsys.readouterr())
    assert any(path.name == "multirun.yaml" for path in root.rglob("*.yaml"))
    assert _holding(root, SECRET) == []


@pytest.mark.parametrize(
    "folders",
    [
        ("hydra.run.dir=.", "hydra.output_subdir=null"),
        ("hydra.sweep.dir=.",),
        ("hydra.run.dir=.", "hydra.output_subdir=.hydra"),
        ("--multirun", "hydra.sweep.dir=.", "hydra.output_subdir=null", "seed=0,1"),
    ],
)
def test_files_of_the_user_are_left_alone(folders: tuple[str, ...], root, capture, tmp_path, monkeypatch):
    """Also where the logs of a run go among them."""
    monkeypatch.chdir(tmp_path)
    names = ["recipe.yaml", "config.yaml", "hydra.yaml", *(() if "--multirun" in folders else ("multirun.yaml",))]
    for name in names:
        (tmp_path / name).write_text(f"uri: {URI}\n", encoding="utf-8")
    assert main(["run", f"scene={capture}", "method=2dgs", *QUICK, "scene.long_side=-1", *folders]) == 1
    assert [(tmp_path / name).read_text(encoding="utf-8") for name in names] == [f"uri: {URI}\n"] * len(names)


def test_where_a_run_is_tracked_is_no_part_of_its_report(root, words, capsys):
    """The report has the key of the run without tracking: it is found, not made again."""
    assert main([*words, "name=untracked"]) == 0
    reports = sorted((root / "store" / "report").rglob("report.html"))
    assert main([*words, "name=untracked", f"tracking.uri={URI}", "tracking.experiment=other"]) == 0
    assert sorted((root / "store" / "report").rglob("report.html")) == reports
    page = (root / "runs" / "untracked" / "report.html").read_text()
    assert "tracking." not in page
    assert "127.0.0.1:9" not in page


@pytest.mark.parametrize("debug", ["", "1"])
def test_errors_are_printed_without_it(debug: str, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_DEBUG", debug)
    assert report_error(RtgsError(f"no answer from {URI}/api")) == 1
    said = capsys.readouterr().err
    assert "no answer from http://***@127.0.0.1:9/api" in said
    assert SECRET not in said
