"""Quality over time: equal times, equal steps, knees, and a training that waits for a mesh."""

from __future__ import annotations

import csv
import io

import pytest

from rtgs.evaluate.curves import Look, QualityCurve, comma_separated, markdown, with_others, with_pause

LOOKS = (Look(10, 10.0, 20.0), Look(20, 20.0, 28.0), Look(40, 40.0, 29.0), Look(80, 90.0, 30.0))


def curve(looks=LOOKS, *, method: str = "rtgs", seed: int = 0, scene: str = "sedan") -> QualityCurve:
    return QualityCurve(scene, method, "quick", seed, tuple(looks))


def test_a_run_at_a_time_lies_between_its_looks():
    made = curve()
    assert made.at_seconds(5.0) is None
    assert made.at_seconds(20.0) == LOOKS[1]
    assert made.at_seconds(25.0) == Look(25, 25.0, 28.25)
    assert made.at_seconds(500.0) == LOOKS[-1]
    assert made.at_steps(40) == LOOKS[2]
    assert made.at_steps(30) is None


def test_the_knee_is_where_time_begins_to_bring_little():
    assert curve().knee == LOOKS[1]
    dipping = (LOOKS[0], Look(20, 20.0, 28.0), Look(30, 30.0, 24.0), Look(80, 90.0, 30.0))
    assert curve(dipping).knee == dipping[1]
    straight = tuple(Look(k, float(k), 20.0 + k) for k in (1, 2, 3))
    assert curve(straight).knee is None
    assert curve(LOOKS[:2]).knee is None
    assert curve([Look(k, float(k), 20.0) for k in (1, 2, 3)]).knee is None


def test_a_training_that_waits_for_its_mesh_stands_still_meanwhile():
    made = curve(with_pause(LOOKS, 20, 30.0))
    assert [look.cpu_seconds for look in made.looks] == [10.0, 20.0, 50.0, 70.0, 120.0]
    at = made.at_seconds(35.0)
    assert at is not None
    assert (at.steps, at.psnr) == (20, 28.0)
    assert with_pause(LOOKS, 80, 0.0) == list(LOOKS)


def test_the_further_models_of_an_ensemble_count_when_they_are_trained():
    """Until then the quality is that of the run's own model."""
    last = LOOKS[-1]
    made = curve(with_others(LOOKS, Look(last.steps, last.cpu_seconds + 100.0, last.psnr + 2.0, None)))
    assert made.looks[: len(LOOKS)] == LOOKS
    assert made.at_seconds(last.cpu_seconds + 99.0).psnr == last.psnr
    for after in (100.0, 101.0):
        assert made.at_seconds(last.cpu_seconds + after).psnr == last.psnr + 2.0
    assert made.at_steps(last.steps).psnr == last.psnr


def test_equal_times_and_equal_steps_stand_in_one_table():
    masked = [Look(look.steps, look.cpu_seconds, look.psnr, look.psnr - 5) for look in LOOKS]
    text = markdown([curve(), curve(masked, method="a|b", seed=1)], (0.5, 1.5, 2), (20, 30))
    lines = text.splitlines()
    assert lines[4] == "| PSNR | 0.5 min | 1.5 min | 2 min | 20 steps | 30 steps | end | CPU s | knee |"
    assert lines[6] == "| rtgs, quick | 28.50 | 30.00 | 30.00* | 28.00 | - | 30.00 | 90 | 28.00 at 20 s |"
    assert "| a\\|b, quick, seed 1 | 23.50 | 25.00 | 25.00* | 23.00 | - | 25.00 | 90 | 23.00 at 20 s |" in lines
    assert "| rtgs, quick | - | - | -* | - | - | - | 90 | - at 20 s |" in lines
    assert "PSNR in the mask" not in markdown([curve()], (1,), (20,))
    rows = list(csv.DictReader(io.StringIO(comma_separated([curve(method="=sum")]))))
    assert [float(row["psnr"]) for row in rows] == [20.0, 28.0, 29.0, 30.0]
    assert [row["knee"] for row in rows] == ["0", "1", "0", "0"]
    assert rows[0]["method"] == "'=sum"


def test_looks_that_go_back_in_time_are_refused():
    with pytest.raises(ValueError, match="2 looks whose times do not rise"):
        curve([LOOKS[1], LOOKS[0]])
    with pytest.raises(ValueError, match="0 looks"):
        curve([])
