"""A stage that is gone on with on more views: those that were held out until then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule

from rtgs.methods import create_method
from rtgs.scenes.scene import Scene
from rtgs.train.checkpoint import CheckpointError, adopt_checkpoint
from rtgs.train.method import Stage
from rtgs.train.progress import SilentProgress
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer

TOTAL, AT = 60, 30


def scene_with_held() -> Scene:
    """Five training views, of which two are held out."""
    scene = small_scene()
    return replace(scene, train=scene.train[:3], held=scene.train[3:])


class Seen(SilentProgress):
    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def trainer(folder: Path, stage: Stage, visited: list[str], progress: Seen | None = None) -> Trainer:
    """It writes down which views its steps are trained on."""
    scene, schedule = scene_with_held(), small_schedule(TOTAL)
    method = create_method(small_method(), scene, schedule, generator_for(3, "initialise"))
    losses = method.losses

    def observed(rendered, view, step):
        visited.append(view.name)
        return losses(rendered, view, step)

    method.losses = observed  # type: ignore[method-assign]
    return Trainer(method, scene, seed=3, stage=stage, checkpoint_dir=folder, progress=progress)


FIRST, REST = Stage("diffuse", 0, AT), Stage("diffuse", 0, TOTAL, AT)


@pytest.fixture
def judged(tmp_path: Path) -> Path:
    """The folder of checkpoints of a stage that was trained until the views join."""
    visited: list[str] = []
    trainer(tmp_path / "first", FIRST, visited).run()
    assert {*visited} == {"view_0", "view_1", "view_2"}
    return tmp_path / "first"


def rest_of(judged: Path, folder: Path) -> Path:
    """Where the rest of it begins, as a step of its own."""
    adopt_checkpoint(max(judged.glob("step_*")), folder)
    return folder


def test_every_epoch_after_it_visits_the_held_out_views_too(judged, tmp_path):
    visited: list[str] = []
    seen = Seen()
    summary = trainer(rest_of(judged, tmp_path / "rest"), REST, visited, seen).run()
    assert summary.steps == TOTAL
    assert len(visited) == TOTAL - AT
    for epoch in range(0, TOTAL - AT, 5):
        assert sorted(visited[epoch : epoch + 5]) == [f"view_{index}" for index in range(5)]
    assert not [line for line in seen.notes if "resumed" in line]


def test_killed_in_the_rest_it_goes_on_bit_for_bit(judged, tmp_path):
    whole = trainer(rest_of(judged, tmp_path / "whole"), REST, [])
    whole.run()
    cut, seen = rest_of(judged, tmp_path / "cut"), Seen()
    killed = trainer(cut, REST, [])
    step = killed.method.after_step

    def failing(at: int, observations):
        if at == 50:  # the checkpoint before is that of step 45
            raise KeyboardInterrupt
        return step(at, observations)

    killed.method.after_step = failing  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        killed.run()
    again = trainer(cut, REST, [], seen)
    again.run()
    assert "resumed from the checkpoint of step 45" in seen.notes
    wanted, found = whole.method.state(), again.method.state()
    assert wanted.keys() == found.keys()
    assert all(torch.equal(wanted[name], found[name]) for name in wanted)


def test_it_cannot_begin_without_what_was_trained(tmp_path):
    with pytest.raises(CheckpointError, match="go on from step 30, and there is no checkpoint"):
        trainer(tmp_path, REST, []).run()
    assert not list(tmp_path.iterdir())
