"""Curves of a training: as it goes, and of its records."""

from __future__ import annotations

import math

import numpy as np

from rtgs.train.progress import StepReport
from rtgs.view.curves import MOST_POINTS, Curves


def test_a_training_that_goes_back_to_a_checkpoint_forgets_what_it_does_again():
    curves = Curves()
    for step in (10, 20, 30, 20, 30):
        curves.add(StepReport(step, loss=1 / step, psnr=step, surfels=5))
    assert curves.steps == [10, 20, 30]
    assert math.isnan(curves.held_out[-1])


def test_a_long_training_is_thinned_evenly_with_its_end():
    curves = Curves()
    for step in range(0, 60_000, 10):
        curves.add(StepReport(step, 0.5, 20.0, 5, held_out=19.0))
    steps, *rest = curves.arrays()
    assert len(steps) == MOST_POINTS
    assert (steps[0], steps[-1]) == (0, 59_990)
    assert np.ptp(np.diff(steps)) <= 10
    assert all(len(each) == len(steps) for each in rest)


def test_records_of_a_run_become_curves():
    rows = [
        {"step": 100, "train/loss": 0.2, "train/psnr": 20.0},
        {"step": 50, "train/loss": 0.3, "train/psnr": 15.0, "test/psnr": 14.0},
        {"step": 60, "boundary/start": 3.0},
    ]
    curves = Curves.of_history(rows)
    assert curves.steps == [50, 100]
    assert curves.loss == [0.3, 0.2]
    assert curves.held_out[0] == 14.0
