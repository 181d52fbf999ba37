"""Somebody looks at a training: it ends bit for bit as without, it can be paused, and stopped after a checkpoint."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from rtgs.methods.settings import MethodSettings
from rtgs.train import clock
from rtgs.train.checkpoint import checkpoint_path
from rtgs.train.onlooker import TrainingStopped
from rtgs.view import viewer as viewer_module
from rtgs.view.curves import Curves
from rtgs.view.mixing import Choice
from rtgs.view.seats import Gaze, Seen
from rtgs.view.viewer import Viewer
from tests.train.training_cases import small_method, small_schedule, small_trainer
from tests.view.test_picture_times import gaze

TOTAL = 40
WHOLE = Choice()


@dataclass
class Looker:
    """Turns its head with every picture."""

    pictures: list[np.ndarray] = field(default_factory=list)
    seen: Seen | None = None
    moved: float = 0.0
    fov: float = 0.8

    @property
    def gaze(self) -> Gaze:
        return gaze(48, 36, fov=self.fov)

    def show(self, pixels: np.ndarray, depth: np.ndarray | None, draft: bool) -> None:
        self.pictures.append(pixels)
        self.fov = 0.6 + 0.4 * (len(self.pictures) % 2)


@dataclass
class FakePage:
    seats: list[Looker] = field(default_factory=lambda: [Looker()])
    choice: Choice = WHOLE
    share: float = 1.0
    paused: bool = False
    stopped: bool = False
    woken: threading.Event = field(default_factory=threading.Event)
    told: list[str] = field(default_factory=list)
    kinds: tuple[str, ...] = ()

    def exhibit(self, scene, mesh) -> None: ...

    def offer(self, kinds, lights) -> None:
        self.kinds = tuple(kinds)

    def tell(self, text: str) -> None:
        self.told.append(text)

    def plot(self, curves: Curves) -> None: ...


def state(folder: Path, step: int = TOTAL) -> dict[str, torch.Tensor]:
    return load_file(checkpoint_path(folder, step) / "state.safetensors")


def train(folder: Path, settings: MethodSettings, page: FakePage | None) -> None:
    viewer = None if page is None else Viewer(page)
    listeners = {} if viewer is None else {"onlooker": viewer, "progress": viewer}
    trainer = small_trainer(None, settings, small_schedule(TOTAL), checkpoint_dir=folder, **listeners)
    if viewer is not None:
        viewer.attend(trainer.scene, None)
    trainer.run()


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("alone")
    train(folder, small_method(), None)
    return folder


def same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> bool:
    assert found.keys() == expected.keys()
    return all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("shown", ["final", "normal", "depth"])
def test_a_training_that_is_looked_at_after_every_step_ends_bit_for_bit_as_without(alone, tmp_path, shown):
    page = FakePage(choice=Choice(shown, depth=True))
    train(tmp_path, small_method(), page)
    assert len(page.seats[0].pictures) >= TOTAL - 1
    assert (page.seats[0].pictures[-1] != page.seats[0].pictures[-3]).any()
    assert same(state(tmp_path), state(alone))
    assert page.kinds == ("final", "normal", "depth")


def test_nobody_looks_and_nothing_is_made(alone, tmp_path):
    page = FakePage(seats=[])
    train(tmp_path, small_method(), page)
    assert page.told == ["**diffuse** has ended; what follows is not shown here."]
    assert same(state(tmp_path), state(alone))


def test_looking_is_no_time_of_training(tmp_path, monkeypatch):
    late = 0.0
    real = time.monotonic
    monkeypatch.setattr(clock, "time", SimpleNamespace(monotonic=lambda: real() + late, process_time=time.process_time))

    class Slow(Viewer):
        def look(self, method, step):
            nonlocal late
            late += 1e6
            return False

    schedule = small_schedule(TOTAL)
    summary = small_trainer(None, small_method(), schedule, onlooker=Slow(FakePage())).run()
    assert late == TOTAL * 1e6
    assert summary.seconds < 1e6


def test_a_pause_changes_nothing(alone, tmp_path):
    class Resumed(FakePage):
        """Goes on as soon as it is told of the pause."""

        def tell(self, text):
            super().tell(text)
            if "paused" in text:
                self.paused = False
                self.woken.set()

    page = Resumed()

    class Pausing(Viewer):
        def look(self, method, step):
            page.paused = page.paused or step == 20
            return super().look(method, step)

    viewer = Pausing(page)
    trainer = small_trainer(
        None, small_method(), small_schedule(TOTAL), checkpoint_dir=tmp_path, onlooker=viewer, progress=viewer
    )
    viewer.attend(trainer.scene, None)
    trainer.run()
    assert same(state(tmp_path), state(alone))
    assert any("paused" in text for text in page.told)
    assert not page.paused


def test_pictures_of_a_pause_are_not_charged_to_the_training(monkeypatch):
    now = 100.0
    monkeypatch.setattr(viewer_module, "time", SimpleNamespace(monotonic=lambda: now))
    page = FakePage(share=0.1)
    viewer = Viewer(page)
    trainer = small_trainer(None, small_method(), small_schedule(TOTAL))
    viewer.attend(trainer.scene, None)
    made = page.seats[0].pictures
    real = page.seats[0].show

    def slow(*given) -> None:
        nonlocal now
        now += 10
        real(*given)
        page.paused = page.paused and len(made) < 8

    page.seats[0].show = slow  # type: ignore[method-assign]
    page.paused = True
    viewer.look(trainer.method, 1)
    assert len(made) == 8
    viewer.look(trainer.method, 2)
    assert len(made) == 9
    viewer.look(trainer.method, 3)
    assert len(made) == 9  # that one has to be paid for
    now += 101
    viewer.look(trainer.method, 4)
    assert len(made) == 10


def test_a_stop_leaves_a_checkpoint_of_the_step_and_the_next_run_goes_on(alone, tmp_path):
    page = FakePage()

    class Stopping(Viewer):
        def look(self, method, step):
            page.stopped = step == 23
            return super().look(method, step)

    viewer = Stopping(page)
    trainer = small_trainer(None, small_method(), small_schedule(TOTAL), checkpoint_dir=tmp_path, onlooker=viewer)
    viewer.attend(trainer.scene, None)
    with pytest.raises(TrainingStopped, match="stopped at step 23"):
        trainer.run()
    again = small_trainer(None, small_method(), small_schedule(TOTAL), checkpoint_dir=tmp_path)
    assert again.run().resumed_from == 23
    assert same(state(tmp_path), state(alone))


def test_a_picture_that_cannot_be_made_ends_no_training(alone, tmp_path):
    page = FakePage()
    page.seats[0].show = None  # type: ignore[assignment]
    train(tmp_path, small_method(), page)
    assert same(state(tmp_path), state(alone))
    assert any("shows nothing more of this training: TypeError" in text for text in page.told)
