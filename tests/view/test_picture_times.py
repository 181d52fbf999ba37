"""How much time pictures may take, how large they are, and which one is due."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.view.around import quaternion, vertical_fov
from rtgs.view.budget import LEAST_PIXELS, Budget, Speed
from rtgs.view.mixing import Choice
from rtgs.view.seats import STILL, Gaze, Seen, due
from rtgs.view.settings import ViewerSettings
from tests.train.training_cases import look_at_origin

WHOLE = Choice()


@dataclass(eq=False)
class FakeSeat:
    gaze: Gaze
    moved: float = 0.0
    seen: Seen | None = None

    def show(self, pixels: np.ndarray, depth: np.ndarray | None, draft: bool) -> None: ...


def gaze(width: int = 400, height: int = 300, **changes) -> Gaze:
    camera = look_at_origin(0.7)
    x, y, z = camera.center.tolist()
    values = {"wxyz": quaternion(camera), "position": (x, y, z), "fov": vertical_fov(camera)} | changes
    return Gaze(**values, width=width, height=height)


def seen(looked: Gaze, pixels: int, choice: Choice = WHOLE, step: int = 5) -> Seen:
    return Seen(looked, choice, step, looked.camera(pixels, 400), {"image": torch.zeros(3, 1, 1)})


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_pictures_take_their_share_of_the_time_and_no_more(share: float):
    """A clock of our own: steps of 10 ms, pictures of 30 ms whenever they are allowed."""
    now, spent, budget = 0.0, 0.0, Budget(0.0)
    while now < 60:
        now += 0.01
        if budget.free(now, share):
            now += 0.03
            spent += 0.03
            budget.spend(0.03)
    assert spent / now == pytest.approx(share, rel=0.05)


def test_a_viewer_that_did_nothing_may_not_spend_all_it_saved():
    budget = Budget(0.0)
    assert budget.free(3600.0, 0.1)
    budget.spend(0.2)
    assert not budget.free(3600.1, 0.1)
    assert budget.free(3602.0, 0.1)


def test_a_share_of_all_is_never_refused():
    budget = Budget(0.0)
    budget.spend(1e6)
    assert budget.free(0.0, 1.0)


def test_drafts_are_small_where_pictures_are_slow_and_grow_to_the_full_size():
    speed = Speed()
    assert speed.draft(160_000) == 10_000
    speed.learn(10_000, 1.0)
    assert speed.draft(160_000) == LEAST_PIXELS
    sizes = [speed.draft(160_000)]
    while sizes[-1] < 160_000:
        sizes.append(speed.finer(sizes[-1], 160_000))
    assert 2 < len(sizes) < 6
    speed.learn(10_000, 1e-4)
    assert speed.draft(160_000) == 160_000


def test_a_gaze_is_the_camera_of_a_photo():
    """Of a page as large as the photo, at its place: the same rays."""
    photo = look_at_origin(0.7)
    camera = gaze(photo.width, photo.height).camera(photo.width * photo.height, 400)
    torch.testing.assert_close(camera.rays(torch.float64).directions, photo.rays(torch.float64).directions)
    torch.testing.assert_close(camera.center, photo.center)
    small = gaze().camera(1200, 400)
    assert (small.width, small.height) == (40, 30)
    assert gaze().camera(10**9, 200).width == 200


@pytest.mark.parametrize(
    "changes", [{"fov": math.nan}, {"fov": 3.1}, {"wxyz": (0.0, 0.0, 0.0, 0.0)}, {"position": (math.inf, 0.0, 0.0)}]
)
def test_what_a_page_sends_may_be_no_camera(changes):
    broken = gaze(**changes)
    assert not broken.usable
    assert due([FakeSeat(broken)], Choice(), 1, 9.0, Speed(), 400) is None


def test_moving_cameras_come_first_then_switches_then_finer_pictures_then_newer_ones():
    looked, full, now = gaze(), 120_000, 100.0
    old = FakeSeat(looked, 0.0, seen(looked, full, step=4))
    coarse = FakeSeat(looked, 0.0, seen(looked, 1200))
    other = FakeSeat(looked, 0.0, seen(looked, full, Choice("diffuse")))
    moving = FakeSeat(looked, now, seen(gaze(fov=1.0), full))
    done = FakeSeat(looked, 0.0, seen(looked, full))
    seats = [done, old, coarse, other, moving]
    order = []
    while (found := due(seats, Choice(), 5, now, Speed(1e5), 400)) is not None:
        order.append((found.seat, found.pixels))
        seats.remove(found.seat)
    assert order == [(moving, 8000), (other, 0), (coarse, 100_000), (old, full)]


def test_a_camera_that_has_just_moved_waits_for_the_finer_picture():
    looked = gaze()
    seat = FakeSeat(looked, 100.0, seen(looked, 1200))
    assert due([seat], Choice(), 6, 100.0 + STILL / 2, Speed(), 400) is None
    assert due([seat], Choice(), 6, 100.0 + 2 * STILL, Speed(), 400) is not None


def test_depths_that_are_missing_are_rendered():
    looked = gaze()
    seat = FakeSeat(looked, 0.0, seen(looked, 120_000))
    found = due([seat], Choice(depth=True), 5, 100.0, Speed(), 400)
    assert found is not None
    assert found.pixels == 120_000


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"host": " "}, "viewer.host=' ' must be an address"),
        ({"port": 70_000}, "viewer.port=70000 must be 0 to 65535"),
        ({"share": 0.0}, "viewer.share=0.0 must be above 0"),
        ({"share": 1.5}, "viewer.share=1.5 must be above 0 and at most 1"),
        ({"long_side": 3}, "viewer.long_side=3 must be 16 to 8192"),
    ],
)
def test_settings_out_of_range_are_refused(values, message):
    with pytest.raises(RtgsError, match=message):
        ViewerSettings(**values)


def test_the_page_is_on_this_machine_unless_asked():
    assert ViewerSettings().host == "127.0.0.1"
