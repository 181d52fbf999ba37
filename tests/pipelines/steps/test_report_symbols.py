"""The captions of a report's layers are in the symbols of the run's weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.steps.report import _symbols
from rtgs.config import compose
from rtgs.methods import find_method
from rtgs.runs.training import StageParams
from rtgs.train.settings import WatchSettings
from rtgs.workflow import Step
from rtgs.workflow.manifest import describe


def unrun(params, context) -> None:
    raise AssertionError("nothing is run here")


def trained(folder: Path, *words: str) -> dict[str, Path]:
    """The inputs of a report, of a training that these words ask for."""
    config, _ = compose(["scene=demo", *words])
    method = replace(config.method, own={})
    params = StageParams(method, config.schedule, 0, "reflection", 0, 1, WatchSettings())
    describe(Step("train_reflection", 1, params, unrun, ()), folder, 1.0, "2026", 1.0).write(folder)
    return {"train_reflection": folder}


@pytest.mark.parametrize(
    ("words", "diffuse"),
    [
        (["method=envgs"], "(1 − k_s) C_d"),
        (["method=envgs", "method.optics.weight=blend"], "(1 − k_s) C_d"),
        (["method=envgs", "method.optics.weight=additive", "method.optics.blend=linear"], "C_d"),
        (["method=3dgs_dr"], "(1 − m) C_d"),
    ],
)
def test_the_base_set_is_whole_where_reflections_are_added(tmp_path: Path, words: list[str], diffuse: str):
    found = _symbols(trained(tmp_path, *words))
    assert found["diffuse"] == diffuse
    assert found["reflection"] == find_method(words[0].partition("=")[2]).layers["reflection"]


def test_of_another_programs_pictures_nothing_is_known(tmp_path: Path):
    assert _symbols({"render": tmp_path}) == {}
