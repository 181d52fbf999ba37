"""Mistakes on the command line, and what disk and memory refuse: one message that says what to do, no traceback."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import errno

import pytest
from safetensors import SafetensorError

from pipelines.cli.main import main, report_error
from pipelines.steps import import_scene
from pipelines.steps.import_scene import ImportParams
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow.step import StepFailed
from tests.pipelines.app_cases import NAMED, QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


@pytest.fixture(scope="module")
def words(capture) -> list[str]:
    return ["run", f"scene={capture}", "method=2dgs", *QUICK]


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("method.los.l1=1", ["Key 'los'", "Did you mean method.loss"]),
        ("scene.path=/no/such/folder", ["capture folder /no/such/folder does not exist"]),
        ("scene=/no/such/folder", ["capture folder /no/such/folder does not exist", "correct scene.path"]),
        ("threads=0", ["threads=0 must be at least 1"]),
        ("processes=0", ["processes=0 must be at least 1"]),
        ("method.name=3dgz", ["method.name is '3dgz'", "2dgs"]),
    ],
)
def test_mistakes_are_one_message_without_traceback(words, override, expected, capsys):
    assert main([*words, override]) == 1
    errors = capsys.readouterr().err
    for text in expected:
        assert text in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--multirun", "--cfg", "job"], "--multirun and --cfg exclude each other"),
        (["--resolve"], "--resolve goes with --cfg or --help only"),
        (["--config-dir", "/no/such/folder"], "--config-dir /no/such/folder is no folder"),
        (["--experimental-rerun", "job.pickle"], "--experimental-rerun is not offered"),
    ],
)
def test_options_that_make_no_sense_are_one_message(options, expected, capsys):
    assert main(["run", *options]) == 1
    assert expected in capsys.readouterr().err


def test_a_broken_file_of_ones_own_is_named(words, tmp_path, capsys):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.yaml").write_text("name: [\n")
    assert main(["run", "--config-dir", str(tmp_path), "scene=mine"]) == 1
    errors = capsys.readouterr().err
    assert "no valid YAML" in errors
    assert "mine.yaml" in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "store"), "free some space"),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "store"), "free some space"),
        (SafetensorError("Error while serializing: I/O error: File too large (os error 27)"), "free some space"),
        (SafetensorError("Error while serializing: I/O error: Input/output error (os error 5)"), "Input/output error"),
        (SafetensorError("Error while serializing: I/O error: Permission denied (os error 13)"), "make it writable"),
        (
            SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)"),
            "free some space",
        ),
        (OSError(errno.EROFS, "Read-only file system", "outputs"), "RTGS_ROOT"),
        (MemoryError(), "not enough memory: smaller views (scene.long_side=800)"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried"), "not enough memory"),
    ],
)
def test_what_disk_and_memory_refuse_is_told_with_advice(error, advice, capsys):
    assert report_error(StepFailed(import_scene.STEP.step(ImportParams(SceneSettings(), "0" * 64, "")), error)) == 1
    errors = capsys.readouterr().err
    assert advice in errors
    assert "Traceback" not in errors


def test_debug_shows_the_traceback(words, monkeypatch, capsys):
    monkeypatch.setenv("RTGS_DEBUG", "1")
    assert main([*words, "threads=0"]) == 1
    assert "Traceback" in capsys.readouterr().err
