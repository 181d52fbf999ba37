"""The training loop: it learns, tells, records, and stops at the first non-finite number."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule, small_trainer

from rtgs.native.threads import borrow, threads
from rtgs.train import trainer as trainer_module
from rtgs.train.checkpoint import load_newest, scene_digest
from rtgs.train.guard import TrainingDiverged
from rtgs.train.progress import LineProgress, StepReport
from rtgs.train.settings import LossSettings
from rtgs.train.trainer import Trainer


class Memory:
    """A recorder and a progress that remember."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, dict[str, float]]] = []
        self.notes: list[str] = []
        self.reports: list[StepReport] = []
        self.closed = 0

    def metrics(self, values: Mapping[str, float], step: int) -> None:
        self.rows.append((step, dict(values)))

    def start(self, title: str, done: int, total: int) -> None:
        self.notes.append(f"{title} {done} {total}")

    def advance(self, report: StepReport) -> None:
        self.reports.append(report)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def close(self) -> None:
        self.closed += 1


def test_training_learns_and_tells():
    memory = Memory()
    schedule = small_schedule(300, evaluate_every=150, opacity_reset_every=0)
    trainer = small_trainer(schedule=schedule, progress=memory, recorder=memory)
    before = trainer.evaluate()
    summary = trainer.run()
    assert summary.steps == 300
    assert summary.psnr_test is not None
    assert summary.psnr_test > before + 2
    assert summary.psnr_train > 13
    assert summary.surfels == len(trainer.method.sets[0]) > 300
    assert summary.resumed_from is None
    assert summary.seconds >= summary.seconds_per_step > 0
    assert summary.cpu_seconds > 0
    assert memory.closed == 1
    assert memory.notes[0] == "diffuse 0 300"
    assert any("no distortion loss: its weight is 0" in note for note in memory.notes)
    assert sum("cloned" in note for note in memory.notes) == 2  # steps 20 and 40
    assert memory.reports[-1].step == 300
    steps = [step for step, _ in memory.rows]
    assert steps == [50, 100, 150, 150, 200, 250, 300, 300]  # batches every 50, evaluations every 150
    first = memory.rows[0][1]
    assert first["train/loss"] > memory.rows[-2][1]["train/loss"]
    assert {"train/l1", "train/dssim", "train/psnr", "surfels/base"} <= first.keys()
    assert "train/normal" in memory.rows[-2][1]
    assert "test/psnr" in memory.rows[3][1]


@pytest.mark.parametrize("small", [True, False])
def test_torch_is_serial_while_it_trains_on_small_pictures_alone(small: bool, monkeypatch: pytest.MonkeyPatch):
    found: list[tuple[int, int]] = []

    class Counts:
        def look(self, method: object, step: int) -> None:
            found.append((threads(), torch.get_num_threads()))

    monkeypatch.setattr(trainer_module, "SERIAL_PIXELS", 10**6 if small else 1)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        trainer = small_trainer(schedule=small_schedule(2), observer=Counts())
        trainer.run()
        Counts().look(None, 2)
    finally:
        torch.set_num_threads(before)
    assert found == [*[(3, 1 if small else 3)] * 2, (3, 3)]


def test_a_checkpoint_tells_threads_of_its_own_not_those_lent(tmp_path: Path):
    """Which change no bit: who resumes with the others gone is told nothing."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with borrow(lambda: 5):
            small_trainer(schedule=small_schedule(2), checkpoint_dir=tmp_path).run()
    finally:
        torch.set_num_threads(before)
    newest = load_newest(tmp_path, warn=pytest.fail)
    assert newest is not None
    assert newest.record.threads == 2


def test_equal_seeds_give_equal_surfels_and_others_do_not():
    def means(seed: int) -> torch.Tensor:
        trainer = small_trainer(schedule=small_schedule(25), seed=seed)
        trainer.run()
        return trainer.method.sets[0].gaussians.means.detach()

    assert torch.equal(means(1), means(1))
    assert not torch.equal(means(1)[:100], means(2)[:100])


def test_lines_are_written_where_there_is_no_terminal():
    stream = io.StringIO()
    small_trainer(schedule=small_schedule(20), progress=LineProgress(stream, seconds=0)).run()
    lines = stream.getvalue().splitlines()
    assert any(line.startswith("diffuse: step 10/20  loss ") and "Gaussians" in line for line in lines)
    assert any(line.startswith("diffuse: step 20/20") and line.endswith("0:00 left") for line in lines)


def test_a_nan_pixel_stops_training_names_the_term_and_leaves_the_checkpoint(tmp_path: Path):
    scene = small_scene()
    trainer = small_trainer(scene, schedule=small_schedule(checkpoint_every=10), checkpoint_dir=tmp_path)

    original = trainer.method.losses

    def poisoned(rendered, view, step):
        image = view.image.clone()
        if step == 13:
            image[1, 4, 5] = math.nan
        return original(rendered, replace(view, image=image), step)

    trainer.method.losses = poisoned  # type: ignore[method-assign]
    with pytest.raises(TrainingDiverged, match="training diverged at step 13") as caught:
        trainer.run()
    assert "loss terms that are not finite: l1, dssim" in str(caught.value)
    assert "The last checkpoint is intact" in str(caught.value)
    newest = load_newest(tmp_path, warn=pytest.fail)
    assert newest is not None
    assert newest.record.step == 10
    assert all(bool(torch.isfinite(t).all()) for t in newest.tensors.values() if t.is_floating_point())


def test_a_nan_gradient_stops_training_and_names_parameter_and_gaussians():
    trainer = small_trainer(schedule=small_schedule())
    surfels = trainer.method.sets[0].gaussians

    def poison(gradient: torch.Tensor) -> torch.Tensor:
        gradient = gradient.clone()
        gradient[[3, 8]] = math.inf
        return gradient

    surfels.log_scales.register_hook(poison)
    with pytest.raises(TrainingDiverged) as caught:
        trainer.run()
    (bad,) = caught.value.divergence.gaussians
    assert (bad.set_name, bad.tensor, bad.count, bad.ids) == ("base", "gradient of log_scales", 2, (3, 8))
    assert "step 0, view 'view_" in str(caught.value)
    assert "Gaussian 3: inf, inf" in str(caught.value)


def test_a_nan_densification_signal_stops_training_too():
    trainer = small_trainer(schedule=small_schedule())
    base = trainer.method.sets[0]
    observe = base.density.observe

    def poisoned(signal: torch.Tensor, weight_sum: torch.Tensor) -> None:
        observe(signal, torch.where(torch.arange(len(weight_sum)) == 5, math.nan, weight_sum))

    base.density.observe = poisoned  # type: ignore[method-assign]
    with pytest.raises(TrainingDiverged, match=r"densification signal or weight sum of 1 Gaussians .* \[5\]"):
        trainer.run()


def test_a_trainer_without_test_views_has_no_test_psnr():
    scene = replace(small_scene(), test=())
    assert small_trainer(scene, schedule=small_schedule(3)).run().psnr_test is None


def test_metrics_are_flushed_when_training_breaks():
    memory = Memory()
    settings = replace(small_method(), loss=LossSettings(normal=0.0))
    trainer = small_trainer(settings=settings, schedule=small_schedule(40), recorder=memory, progress=memory)
    after_step = trainer.method.after_step

    def failing(step: int, observations):
        if step == 30:
            raise KeyboardInterrupt
        return after_step(step, observations)

    trainer.method.after_step = failing  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert [step for step, _ in memory.rows] == [30]
    assert memory.closed == 1


def test_scene_digest_tells_images_normals_cameras_and_points():
    scene = small_scene()
    view = scene.train[0]
    facing = torch.tensor([0.0, 0.0, -1.0]).reshape(3, 1, 1).expand_as(view.image)
    brighter = replace(view, image=view.image * 0.9)
    moved = replace(view, camera=replace(view.camera, translation=view.camera.translation + 0.1))
    digests = {
        scene_digest(scene),
        scene_digest(replace(scene, train=(brighter, *scene.train[1:]))),
        scene_digest(replace(scene, train=(moved, *scene.train[1:]))),
        scene_digest(replace(scene, points=scene.points + 0.1)),
        scene_digest(replace(scene, train=(replace(view, normal=facing), *scene.train[1:]))),
        scene_digest(replace(scene, train=(replace(view, normal=-facing), *scene.train[1:]))),
    }
    assert len(digests) == 6
    assert scene_digest(scene) == scene_digest(small_scene())


def test_a_stage_that_follows_another_says_nothing_of_being_resumed(tmp_path):
    """Its start is the checkpoint of the stage before; one further on is another matter."""
    from rtgs.train.method import Stage
    from rtgs.train.progress import SilentProgress

    class Notes(SilentProgress):
        def __init__(self) -> None:
            self.lines: list[str] = []

        def note(self, text: str) -> None:
            self.lines.append(text)

    def notes_of(*stretch: int) -> list[str]:
        notes = Notes()
        trainer = small_trainer(schedule=small_schedule(40), checkpoint_dir=tmp_path, progress=notes)
        Trainer(
            trainer.method,
            trainer.scene,
            seed=3,
            stage=Stage("diffuse", *stretch),
            progress=notes,
            checkpoint_dir=tmp_path,
        ).run()
        return [line for line in notes.lines if "resumed" in line]

    assert notes_of(0, 20) == []
    assert notes_of(20, 40) == []
    assert notes_of(0, 40) == ["resumed from the checkpoint of step 40"]
