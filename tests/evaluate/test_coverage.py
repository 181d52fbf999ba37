"""Which pixels the training views show: a plane before cameras in a row, things in the way, and the sky."""

from __future__ import annotations

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.evaluate.coverage import LONG_SIDE, Shown, at_size, framed, framed_by, judged

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
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    expected[:, columns:] = True
    assert torch.equal(framed(Shown.of(camera(0.0), flat(AWAY)), aside, flat(AWAY)), expected)


def test_views_are_counted_and_those_that_look_away_are_not():
    others = [(camera(0.0), flat(AWAY))] * 3 + [(camera(0.0, turned=True), flat(AWAY))]
    twice = framed_by([(camera(0.0), flat(AWAY)), (camera(0.0, turned=True), flat(AWAY))], iter(others))
    assert [count.dtype for count in twice] == [torch.int16] * 2
    assert bool((twice[0] == 3).all())
    assert bool((twice[1] == 1).all())


def test_a_picture_s_points_are_made_once(monkeypatch: pytest.MonkeyPatch):
    asked = []
    rays = Camera.rays
    monkeypatch.setattr(Camera, "rays", lambda *given: asked.append(1) or rays(*given))
    framed_by([(camera(0.0), flat(AWAY))] * 2, [(camera(0.0), flat(AWAY))] * 5)
    assert len(asked) == 2


def test_what_is_hidden_from_a_camera_is_not_shown_by_it():
    """A thing at half the depth covers the right half of the other picture; what is 2 % nearer hides nothing."""
    hiding = flat(0.98 * AWAY)
    hiding[:, WIDTH // 2 :] = AWAY / 2
    shown = framed(Shown.of(camera(0.0), flat(AWAY)), camera(0.0), hiding)
    assert bool(shown[:, : WIDTH // 2].all())
    assert not shown[:, WIDTH // 2 :].any()


@pytest.mark.parametrize("away", [0.0, 1e-9, 3.0])
def test_the_sky_is_shown_where_the_other_picture_looks_the_same_way_and_has_nothing_before_it(away: float):
    sky, other = flat(0.0), flat(0.0)
    other[: HEIGHT // 2] = 5.0
    shown = framed(Shown.of(camera(0.0), sky), camera(away), other)
    assert bool(shown[HEIGHT // 2 :].all()), "so far away that a step to the side is nothing"
    assert not shown[: HEIGHT // 2].any()
    assert not framed(Shown.of(camera(0.0), sky), camera(away, turned=True), sky).any()
    plane = Shown.of(camera(0.0), flat(AWAY))
    assert bool(framed(plane, camera(0.0), sky).all()), "a picture without a depth hides nothing"


def test_large_pictures_are_judged_at_fewer_pixels():
    there = torch.zeros(3, dtype=torch.float64)
    large = Camera(torch.eye(3, dtype=torch.float64), there, 900.0, 900.0, 500.0, 300.0, 1000, 600)
    small = judged(large)
    assert (small.width, small.height) == (LONG_SIDE, 240)
    assert judged(small) is small
    values = torch.arange(12).reshape(3, 4)
    assert torch.equal(at_size(at_size(values, 9, 12), 3, 4), values)
    assert at_size(values, 6, 8)[:2, :2].tolist() == [[0, 0], [0, 0]]
