"""A weight of a loss that the method does not read is told: in the plan, in the log, in the report."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.cli.main import main
from rtgs.config.names import overridden
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

TOLD = "method.loss.perceptual=0.02 has no effect: 2dgs has no such loss"


@pytest.fixture
def words(capture: Path) -> list[str]:
    return [f"scene={capture}", "method=2dgs", *QUICK]


def test_a_plan_tells(words: list[str], capsys: pytest.CaptureFixture[str]):
    assert main(["plan", *words, "method.loss.perceptual=0.02"]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [TOLD, "5 steps, 0 from the cache"]
    assert main(["plan", "--multirun", *words, "method.loss.perceptual=0.02,0.0"]) == 0
    named = overridden([*QUICK, "method.loss.perceptual=0.02"])
    assert f"\n{TOLD} (tiny_room-2dgs-smoke-{named})\n" in capsys.readouterr().out
    assert main(["plan", *words]) == 0
    assert "has no effect" not in capsys.readouterr().out


def test_log_and_report_tell_and_the_training_is_the_one_without(
    words: list[str], root: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["run", *words, "name=plain"]) == 0
    assert "has no effect" not in capsys.readouterr().err
    assert main(["run", *words, "method.loss.perceptual=0.02", "name=asked"]) == 0
    log = capsys.readouterr().err
    assert TOLD in log
    assert "5 steps, 4 from the cache" in log
    plain, asked = ((root / "runs" / name / "report.html").read_text() for name in ("plain", "asked"))
    assert "has no effect" not in plain
    for part in TOLD.split(": "):
        assert part in asked
