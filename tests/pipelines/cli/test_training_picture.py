"""The picture of a training while it trains: when it is made, what it shows, and that no result depends on it."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from PIL import Image

from pipelines.cli import training_picture
from pipelines.cli.main import main
from pipelines.cli.training_picture import EVERY, MARKS, TrainingPicture
from rtgs.train.progress import SilentProgress
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


class Notes(SilentProgress):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)


def views_of(*values: float) -> Any:
    return tuple(SimpleNamespace(camera=None, mask=None, image=torch.full((3, 6, 8), each)) for each in values)


def scene_of(test: Any, train: Any) -> Any:
    return SimpleNamespace(test=test, train=train)


class Method:
    """Renders a grey that is a tenth of the step."""

    def render(self, camera, step, mode, mask):
        assert not torch.is_grad_enabled()
        return SimpleNamespace(image=torch.full((3, 6, 8), step / 10))


METHOD: Any = Method()


def test_pictures_come_after_their_marks_and_show_photo_and_model(tmp_path):
    now, notes, path = [0.0], Notes(), tmp_path / "a run" / "training.jpg"
    picture = TrainingPicture(path, lambda: now[0])
    picture.attend(scene_of(views_of(0.0, 0.2), views_of(0.9)), None, notes)
    made = []
    first, second, third = MARKS
    times = (first - 1, first, first + 1, second, third + EVERY, third + EVERY + 1, third + 2 * EVERY)
    for step, now[0] in enumerate(times):
        assert picture.look(METHOD, step) is False
        made.append(len(notes.lines))
    assert made == [0, 1, 1, 2, 3, 3, 4]
    assert notes.lines[1] == f"picture after step 3: {path} (photo, model; 20.0 dB)"
    pixels = np.asarray(Image.open(path)).astype(int)
    assert pixels.shape == (6, 16, 3)
    assert abs(pixels[:, :8] - 51).max() <= 3
    assert abs(pixels[:, 8:] - 153).max() <= 3
    assert [each.name for each in path.parent.iterdir()] == ["training.jpg"]


def test_without_test_views_a_training_view_is_shown_and_before_a_training_nothing(tmp_path):
    notes = Notes()
    picture = TrainingPicture(tmp_path / "training.jpg", iter([0.0, 50.0, 100.0, 2000.0]).__next__)
    assert picture.look(METHOD, 1) is False
    assert not picture.path.exists()
    picture.attend(scene_of((), views_of(0.3)), None, notes)
    picture.look(METHOD, 3)
    assert notes.lines == [f"picture after step 3: {picture.path} (photo, model; 100.0 dB)"]


def test_a_run_shows_it_while_it_trains_and_no_result_depends_on_it(root, capture, monkeypatch, capsys):  # noqa: F811
    seen, write = [], TrainingPicture._write

    def written(self, method, view, step):
        psnr = write(self, method, view, step)
        seen.append((step, self.path.relative_to(root).as_posix(), self.path.is_file()))
        return psnr

    monkeypatch.setattr(TrainingPicture, "_write", written)
    found = []
    for marks, times in (((0.0,), 1), ((1e9,), 0)):
        seen.clear()
        monkeypatch.setattr(training_picture, "MARKS", marks)
        assert main(["run", f"scene={capture}", "method=2dgs", *QUICK, "name=watched"]) == 0
        assert seen == [(1, "runs/watched/training.jpg", True)] * times
        assert capsys.readouterr().err.count("picture after step 1: ") == times
        assert not (root / "runs" / "watched" / "training.jpg").exists()
        found.append((root / "runs" / "watched" / "point_cloud.ply").read_bytes())
        shutil.rmtree(root / "store")
    assert found[0] == found[1]
