"""Views that grow with the steps: when, to which size, and that a run goes on bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from training_cases import small_scene, small_schedule, small_trainer

from rtgs.core.errors import RtgsError
from rtgs.methods.plans import shrunk_from
from rtgs.methods.settings import TransmittanceSettings
from rtgs.train.resolution import GrowingViews, factor_starts, shrunk, spectrum_shares
from rtgs.train.settings import ScheduleSettings


def test_a_picture_without_detail_is_held_by_small_ones_and_noise_by_its_area():
    view = small_scene().train[0]
    height, width = view.image.shape[1:]
    x = torch.arange(width).expand(3, height, width)
    smooth = replace(view, image=0.5 + 0.3 * torch.cos(2 * math.pi * x / width))
    assert spectrum_shares([smooth], 4)[3] == pytest.approx(1, abs=1e-3)
    noise = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0)) - 0.5
    shares = spectrum_shares([replace(view, image=noise)], 4)
    assert shares == pytest.approx([1, 1 / 4, 1 / 9, 1 / 16], rel=0.2)
    fine = replace(view, image=0.5 + 0.3 * torch.cos(2 * math.pi * 0.4 * x))
    assert spectrum_shares([fine], 2)[1] < 0.9


def test_black_photos_hold_all_they_have():
    (view,) = small_scene().train[:1]
    black = replace(view, image=torch.zeros_like(view.image))
    shares = spectrum_shares([black, black], 3)
    assert shares == (1.0, 1.0, 1.0)
    assert factor_starts(shares, 100) == ((0, 1),)


def test_sizes_begin_where_the_logarithm_of_what_they_hold_is_due():
    shares = [1.0, 0.8, 0.4, 0.2]  # the last holds less than a quarter
    whole = math.log(1 / 0.4)
    assert factor_starts(shares, 1000) == ((0, 3), (round(1000 * math.log(2) / whole), 2), (1000, 1))
    assert factor_starts([1.0], 1000) == ((0, 1),)
    assert factor_starts([1.0, 1.0, 1.0], 1000) == ((0, 1),), "no detail is lost, and none won"


def test_a_shrunk_view_is_the_mean_over_its_pixels_and_frames_the_same():
    view = small_scene().train[0]
    height, width = view.image.shape[1:]
    masked = replace(view, mask=torch.arange(width).expand(height, width) < width // 2)
    small = shrunk(masked, 2)
    camera = small.camera
    assert small.image.shape == (3, camera.height, camera.width) == (3, height // 2, width // 2)
    if height % 2 == width % 2 == 0:
        expected = masked.image.reshape(3, height // 2, 2, width // 2, 2).mean((2, 4))
        torch.testing.assert_close(small.image, expected, rtol=0, atol=1e-6)
    point = view.camera.center + view.camera.rays(torch.float64).directions[height // 3, width // 4] * 2.0
    (pixel, _), (little, _) = view.camera.project(point), camera.project(point)
    scale = torch.tensor([camera.width / width, camera.height / height], dtype=torch.float64)
    torch.testing.assert_close(little, pixel * scale)
    assert small.mask is not None
    assert small.mask[:, : camera.width // 2 - 1].all()
    assert not small.mask[:, camera.width // 2 + 1 :].any()
    if view.normal is not None:
        assert small.normal is not None
        lengths = small.normal.norm(dim=0)
        assert ((lengths - 1).abs() < 1e-5).logical_or(lengths == 0).all()


def test_a_shrunk_mask_holds_where_most_of_a_pixel_does():
    view = small_scene().train[0]
    rows, columns = (torch.arange(size) for size in view.image.shape[1:])
    mask = ((rows[:, None] % 2 == 0) & (columns % 2 == 0)) | (columns >= 16) & (rows[:, None] + columns > 0)
    small = shrunk(replace(view, mask=mask), 2)
    assert small.mask is not None
    assert not small.mask[:, :7].any(), "one pixel of four"
    assert small.mask[:, 9:].all()


def test_views_keep_their_size_unless_it_is_asked_for_or_where_they_are_small():
    scene = small_scene()
    plain = GrowingViews(scene.train, small_schedule())
    assert plain.starts == ((0, 1),)
    assert plain.decisions == ()
    assert plain.at(1, 0) is scene.train[1]
    least = min(min(view.image.shape[1:]) for view in scene.train)
    growing = GrowingViews(scene.train, small_schedule(coarse=8))
    assert growing.starts[0][1] <= max(1, least // 32)


def larger_scene():
    """The small scene's views, four times as large."""
    scene = small_scene()

    def enlarged(view):
        camera = view.camera.resized(4 * view.camera.width, 4 * view.camera.height)
        image = view.image.repeat_interleave(4, 1).repeat_interleave(4, 2)
        return replace(view, camera=camera, image=image, normal=None, mask=None)

    train, test = (tuple(map(enlarged, views)) for views in (scene.train, scene.test))
    return replace(scene, train=train, test=test)


def test_steps_see_larger_views_one_after_the_other_and_the_log_says_when():
    scene = larger_scene()
    growing = GrowingViews(scene.train, small_schedule(total=100, coarse=4, coarse_until=0.6))
    steps, factors = zip(*growing.starts, strict=True)
    assert list(steps) == sorted(steps)
    assert steps[0] == 0
    assert steps[-1] == 60
    assert list(factors) == list(range(factors[0], 0, -1))
    assert factors[0] > 1
    sizes = [growing.at(0, step).camera.width for step in range(100)]
    assert sizes == sorted(sizes)
    assert sizes[59] < sizes[60] == scene.train[0].camera.width
    assert sizes == [scene.train[0].camera.width // growing.factor(step) for step in range(100)]
    (decision,) = growing.decisions
    assert "1/1 from step 60" in str(decision)


def test_views_may_shrink_after_some_steps_on_whole_ones():
    scene = larger_scene()
    whole = scene.train[0].camera.width
    growing = GrowingViews(scene.train, small_schedule(total=100, coarse=4, coarse_from=0.3, coarse_until=0.6))
    first, *later = growing.starts
    assert first == (0, 1)
    assert later[0][0] == 30
    assert later[-1] == (60, 1)
    sizes = [growing.at(0, step).camera.width for step in range(100)]
    assert set(sizes[:30]) == set(sizes[60:]) == {whole}
    assert sizes[30:60] == sorted(sizes[30:60])
    assert max(sizes[30:60]) < whole
    at_once = GrowingViews(scene.train, small_schedule(total=30, coarse=4, coarse_until=1.0)).starts
    assert [(step - 30, factor) for step, factor in later] == list(at_once)


def test_the_stage_of_glass_begins_with_views_of_half_the_size():
    schedule = small_schedule(total=100)
    until = TransmittanceSettings(half_size_until=0.6)
    shown = shrunk_from(until, schedule, 30)
    assert GrowingViews(larger_scene().train, shown).starts == ((0, 1), (30, 2), (60, 1))
    assert shrunk_from(until, schedule, 60) == schedule  # over before it begins
    assert shrunk_from(TransmittanceSettings(), schedule, 30) == schedule
    asked = small_schedule(total=100, coarse=4)
    assert shrunk_from(until, asked, 30) == asked


def test_a_trainer_shows_views_as_it_is_told():
    scene = larger_scene()
    told = small_schedule(total=4, coarse=2)
    summary = (trainer := small_trainer(scene, schedule=small_schedule(total=4), views=lambda: told)).run()
    assert trainer._growing.starts == ((0, 2), (2, 1))
    assert "1/2 from step 0" in " ".join(map(str, summary.decisions))
    assert "stage learns at less cost" in " ".join(map(str, summary.decisions))


@pytest.mark.parametrize("first", [0.0, 0.3])
def test_a_run_goes_on_bit_for_bit_from_a_checkpoint_amid_small_views(tmp_path, first: float):
    scene = larger_scene()
    schedule = small_schedule(total=30, coarse=4, coarse_from=first, coarse_until=0.8)
    whole = small_trainer(scene, schedule=schedule)
    whole.run()
    stopped = small_trainer(scene, schedule=schedule, checkpoint_dir=tmp_path)
    while stopped._step < 15:
        stopped._train_step()
        stopped._between_steps()
    resumed = small_trainer(scene, schedule=schedule, checkpoint_dir=tmp_path)
    assert resumed.run().resumed_from == 15
    for name, tensor in whole.method.state().items():
        assert torch.equal(tensor, resumed.method.state()[name]), name


@pytest.mark.parametrize(
    ("key", "value"), [("coarse", 0), ("coarse", 9), ("coarse_until", 0.0), ("coarse_until", 1.5), ("coarse_from", 0.5)]
)
def test_what_is_out_of_range_is_refused(key: str, value: float):
    with pytest.raises(RtgsError, match=rf"schedule\.{key}={value}"):
        ScheduleSettings(**{key: value})
