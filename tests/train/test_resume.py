"""kill -9 at any moment, then the same command again: bit for bit the surfels of an uninterrupted run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from training_cases import small_method, small_schedule, small_trainer

from rtgs.core.cameras import Camera
from rtgs.gaussians.settings import InitSettings, Orientation
from rtgs.train.checkpoint import CheckpointError, checkpoint_path

TOTAL = 60
ROOT = Path(__file__).parents[2]

# Trains with checkpoints in argv[1]. argv[2]: kill this process with SIGKILL at the n-th of the calls that writing a
# checkpoint makes to the system (0: never). A line "step n" after every step lets the test kill from outside.
SCRIPT = """
import os, signal, sys
from pathlib import Path
import time
import torch
from rtgs.train import checkpoint
from training_cases import small_schedule, small_trainer

torch.set_num_threads(1)
left = int(sys.argv[2])

def dying(function):
    def call(*arguments, **options):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call

checkpoint._flush = dying(checkpoint._flush)
checkpoint.os.rename = dying(checkpoint.os.rename)
trainer = small_trainer(schedule=small_schedule(60), checkpoint_dir=Path(sys.argv[1]))
after_step = trainer.method.after_step

def telling(step, observations):
    events = after_step(step, observations)
    print("step", step, flush=True)
    return events

trainer.method.after_step = telling
print("resumed", trainer.run().resumed_from, flush=True)
if left <= 0:
    time.sleep(600)  # until it is killed
"""


def start(folder: Path, die_at_call: int = 0) -> subprocess.Popen[str]:
    path = os.pathsep.join([str(ROOT), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder), str(die_at_call)],
        env=os.environ | {"PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def final_state(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(checkpoint_path(folder, TOTAL) / "state.safetensors")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("uninterrupted")
    small_trainer(schedule=small_schedule(TOTAL), checkpoint_dir=folder).run()
    return final_state(folder)


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert found.keys() == expected.keys()
    different = [name for name in expected if not torch.equal(found[name], expected[name])]
    assert different == []


def finish_here(folder: Path) -> int | None:
    """Go on in this process."""
    return small_trainer(schedule=small_schedule(TOTAL), checkpoint_dir=folder).run().resumed_from


@pytest.mark.parametrize("kill_after", [7, 22, 41, 58])
def test_killed_between_or_within_steps(tmp_path: Path, uninterrupted, kill_after: int):
    process = start(tmp_path)
    assert process.stdout is not None
    for line in process.stdout:
        if line == f"step {kill_after}\n":
            time.sleep(0.002 * (kill_after % 3))  # somewhere inside the next step
            process.send_signal(signal.SIGKILL)
            break
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    resumed_from = finish_here(tmp_path)
    assert resumed_from in {None, 15, 30, 45, 60}
    assert (resumed_from or 0) >= (kill_after + 1) // 15 * 15
    assert_same(final_state(tmp_path), uninterrupted)


@pytest.mark.parametrize("die_at_call", [1, 4, 8, 15])
def test_killed_while_writing_a_checkpoint(tmp_path: Path, uninterrupted, die_at_call: int):
    """Five calls to the system a checkpoint: flush tensors, record, folder; rename; flush the parent."""
    process = start(tmp_path, die_at_call)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    complete = die_at_call // 5  # killed at the last call of one: it is in place already
    assert finish_here(tmp_path) == (15 * complete or None)
    assert_same(final_state(tmp_path), uninterrupted)
    assert not list(tmp_path.glob(".writing_*"))


def test_the_numbers_shown_to_the_user_go_on_too(tmp_path: Path):
    straight = small_trainer(schedule=small_schedule(TOTAL)).run()
    trainer = small_trainer(schedule=small_schedule(TOTAL), checkpoint_dir=tmp_path)
    after_step = trainer.method.after_step

    def interrupted(step: int, observations):
        if step == 40:
            raise KeyboardInterrupt
        return after_step(step, observations)

    trainer.method.after_step = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    resumed = small_trainer(schedule=small_schedule(TOTAL), checkpoint_dir=tmp_path).run()
    assert resumed.resumed_from == 30
    assert (resumed.loss, resumed.psnr_train) == (straight.loss, straight.psnr_train)
    assert resumed.psnr_test == straight.psnr_test


@pytest.mark.parametrize("orientation", ["published", "pca"])
@pytest.mark.parametrize("at", [3, 6])
def test_killed_before_the_first_change_of_rows(tmp_path: Path, orientation: Orientation, at: int):
    """Until then tensors are those that the start made, after it those of a checkpoint: the same bits by either."""
    settings = replace(small_method(), init=InitSettings(orientation=orientation))
    schedule = small_schedule(12, checkpoint_every=3)
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    small_trainer(settings=settings, schedule=schedule, checkpoint_dir=straight).run()
    trainer = small_trainer(settings=settings, schedule=schedule, checkpoint_dir=killed)
    before_step = trainer.method.render

    def interrupted(camera: Camera, step: int, *arguments, **options):
        if step == at:
            raise KeyboardInterrupt
        return before_step(camera, step, *arguments, **options)

    trainer.method.render = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    again = small_trainer(settings=settings, schedule=schedule, checkpoint_dir=killed).run()
    assert again.resumed_from == at
    found, expected = (load_file(checkpoint_path(folder, 12) / "state.safetensors") for folder in (killed, straight))
    assert_same(found, expected)


@pytest.mark.parametrize("orientation", ["published", "pca"])
def test_every_parameter_of_a_new_set_moves(orientation: Orientation):
    trainer = small_trainer(
        settings=replace(small_method(), init=InitSettings(orientation=orientation)), schedule=small_schedule(3)
    )
    first, *_ = trainer.method.sets
    before = {name: tensor.detach().clone() for name, tensor in first.tensors()}
    trainer.run()
    still = [name for name, tensor in first.tensors() if torch.equal(tensor, before[name])]
    assert still == ["sh_rest"], "its bands come later"


def test_a_truncated_newest_checkpoint_costs_time_but_not_exactness(tmp_path: Path, uninterrupted):
    small_trainer(schedule=small_schedule(TOTAL), checkpoint_dir=tmp_path).run()
    newest = checkpoint_path(tmp_path, TOTAL) / "state.safetensors"
    newest.write_bytes(newest.read_bytes()[:1000])
    assert finish_here(tmp_path) == 45
    assert_same(final_state(tmp_path), uninterrupted)


def test_a_finished_run_is_not_trained_again(tmp_path: Path):
    small_trainer(schedule=small_schedule(20), checkpoint_dir=tmp_path).run()
    summary = small_trainer(schedule=small_schedule(20), checkpoint_dir=tmp_path).run()
    assert summary.resumed_from == 20
    assert summary.steps == 20


def test_other_settings_do_not_resume(tmp_path: Path):
    small_trainer(schedule=small_schedule(16), checkpoint_dir=tmp_path).run()
    with pytest.raises(CheckpointError, match=r"schedule\.total: 16 then, 20 now"):
        small_trainer(schedule=small_schedule(20), checkpoint_dir=tmp_path).run()
    with pytest.raises(CheckpointError, match=r"method\.name: 2dgs then, rtgs now"):
        small_trainer(settings=small_method("rtgs"), schedule=small_schedule(16), checkpoint_dir=tmp_path).run()
