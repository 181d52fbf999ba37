"""Which pixels the training views show: a plane before cameras in a row, things in the way, and the sky."""

from __future__ import annotations

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.evaluate.coverage import framed_by

WIDTH, HEIGHT, FOCAL, AWAY = 40, 30, 40.0, 2.0


def camera(x: float, *, turned: bool = False) -> Camera:
    """At (x, 0, 0), looking along +z, or along -z."""
    rotation = torch.diag(torch.tensor([-1.0, 1.0, -1.0] if turned else [1.0, 1.0, 1.0], dtype=torch.float64))
    center = torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    return Camera(rotation, -rotation @ center, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def flat(z: float) -> torch.Tensor:
    return torch.full((HEIGHT, WIDTH), z)


@pytest.mark.parametrize("columns", [0, 7, 39, 41])
def test_a_camera_to_the_side_shows_the_columns_that_are_left(columns: int):
    """On a plane at a depth of 2 a step of 0.05 is one pixel."""
    aside = camera(columns * AWAY / FOCAL)
    count = framed_by(camera(0.0), flat(AWAY), [(aside, flat(AWAY))])
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.int16)
    expected[:, columns:] = 1
    assert torch.equal(count, expected)


def test_views_are_counted_and_those_that_look_away_are_not():
    others = [(camera(0.0), flat(AWAY))] * 3 + [(camera(0.0, turned=True), flat(AWAY))]
    assert bool((framed_by(camera(0.0), flat(AWAY), others) == 3).all())


def test_what_is_hidden_from_a_camera_is_not_shown_by_it():
    """A thing at half the depth covers the right half of the other picture; what is 2 % nearer hides nothing."""
    hiding = flat(0.98 * AWAY)
    hiding[:, WIDTH // 2 :] = AWAY / 2
    count = framed_by(camera(0.0), flat(AWAY), [(camera(0.0), hiding)])
    assert bool((count[:, : WIDTH // 2] == 1).all())
    assert bool((count[:, WIDTH // 2 :] == 0).all())


def test_the_sky_is_shown_where_the_other_picture_looks_the_same_way_and_has_nothing_before_it():
    sky = flat(0.0)
    other = flat(0.0)
    other[: HEIGHT // 2] = 5.0
    count = framed_by(camera(0.0), sky, [(camera(3.0), other)])
    assert bool((count[HEIGHT // 2 :] == 1).all()), "so far away that the step to the side is nothing"
    assert bool((count[: HEIGHT // 2] == 0).all())
    near = framed_by(camera(0.0), flat(AWAY), [(camera(0.0), sky)])
    assert bool((near == 1).all()), "a picture without a depth hides nothing"
