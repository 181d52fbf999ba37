"""Refusals of settings: one wording, one error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_bad_numbers, refuse_below, refuse_unknown, refuse_unless
from rtgs.prepare.errors import PrepareError
from rtgs.scenes.settings import CaptureError


@dataclass
class Weights:
    """A settings object with one float of each kind, and a text that is none of its business."""

    normal: float = 0.05
    normal_start: float = 0.5
    name: str = "-1"


def test_legal_values_pass():
    refuse_bad_numbers(Weights(), "loss")
    refuse_unless(True, "a.b", 1, "never read")
    refuse_below("a.b", None, 1)
    refuse_below("a.b", 1, 1)
    refuse_unknown("a.b", "colmap", ("colmap", "blender"))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (Weights(normal=-0.1), r"^loss\.normal=-0\.1 must be a finite number of at least 0$"),
        (Weights(normal=math.nan), r"^loss\.normal=nan must be a finite number of at least 0$"),
        (Weights(normal_start=1.5), r"^loss\.normal_start=1\.5 must be between 0 and 1$"),
    ],
)
def test_bad_numbers_are_named(weights, message):
    with pytest.raises(RtgsError, match=message):
        refuse_bad_numbers(weights, "loss")


@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_too_small_and_not_finite(value):
    with pytest.raises(RtgsError, match=rf"^a\.b={value} must be at least 1$"):
        refuse_below("a.b", value, 1)


def test_an_unknown_word_lists_the_known_ones_and_the_nearest():
    with pytest.raises(RtgsError) as raised:
        refuse_unknown("scene.format", "colamp", ("colmap", "blender"))
    told = "scene.format='colamp' is unknown: choose one of colmap, blender; did you mean 'colmap'?"
    assert str(raised.value) == told
    with pytest.raises(RtgsError, match=r"choose one of colmap, blender$"):
        refuse_unknown("scene.format", "xyz", ("colmap", "blender"))


def test_errors_that_a_user_can_mend_have_one_root():
    assert issubclass(CaptureError, RtgsError)
    assert issubclass(PrepareError, RtgsError)
