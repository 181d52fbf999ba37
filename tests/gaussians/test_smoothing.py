"""The 3D smoothing filter: intervals by hand, convolution of two Gaussians, finite differences, fused parameters."""

import math
from dataclasses import replace

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.gaussians.smoothing import Smoothing, sampling_intervals, smoothed
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels, activate

NEAR = 0.1


def camera(focal: float, z: float = 0.0, turned: bool = False) -> Camera:
    """At (0, 0, z), 40x30 pixels, looking along +z, or along -z where ``turned``."""
    rotation = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) if turned else torch.eye(3)
    return Camera(rotation, -rotation.double() @ torch.tensor([0.0, 0.0, z]).double(), focal, focal, 20, 15, 40, 30)


def shape(scales: torch.Tensor, opacities: torch.Tensor) -> ActivatedGaussians:
    rows = torch.zeros(len(scales), 3, dtype=scales.dtype)
    return ActivatedGaussians(rows, rows, rows, scales, opacities, rows)


def test_the_closest_sampling_counts():
    means = torch.tensor([[0.0, 0.0, 4.0]])
    assert sampling_intervals(means, [camera(20)], NEAR).item() == pytest.approx(4 / 20)
    # a longer lens, or a shorter distance, samples more finely
    assert sampling_intervals(means, [camera(20), camera(50)], NEAR).item() == pytest.approx(4 / 50)
    assert sampling_intervals(means, [camera(20), camera(20, 3.0)], NEAR).item() == pytest.approx(1 / 20)
    # one that looks away does not count, nor does one that is too near
    assert sampling_intervals(means, [camera(20), camera(50, 3.0, turned=True)], NEAR).item() == pytest.approx(4 / 20)
    assert sampling_intervals(means, [camera(20), camera(50, 3.95)], NEAR).item() == pytest.approx(4 / 20)


def test_the_finer_side_of_a_pixel_counts():
    tall = replace(camera(20), fy=50.0)
    assert sampling_intervals(torch.tensor([[0.0, 0.0, 4.0]]), [tall], NEAR).item() == pytest.approx(4 / 50)


def test_what_no_camera_frames_has_the_largest_interval_of_the_others():
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 8.0], [0.0, 0.0, -5.0], [90.0, 0.0, 4.0]])
    intervals = sampling_intervals(means, [camera(20)], NEAR)
    assert intervals.tolist() == pytest.approx([0.2, 0.4, 0.4, 0.4])
    assert sampling_intervals(means[2:], [camera(20)], NEAR).tolist() == [0.0, 0.0]


def test_a_margin_around_the_picture_counts_as_seen():
    half_width = 4 * 20 / 20  # at depth 4
    rows = torch.tensor([[share * half_width, 0.0, 4.0] for share in (1.25, 1.35)])
    assert sampling_intervals(rows, [camera(20), camera(10)], NEAR).tolist() == pytest.approx([0.2, 0.4])


@pytest.mark.parametrize("axes", [2, 3])
def test_variances_add_and_the_integral_stays(axes: int):
    scales = torch.rand(50, axes, dtype=torch.float64) + 0.01
    opacities = torch.rand(50, dtype=torch.float64)
    intervals = torch.rand(50, dtype=torch.float64)
    after = smoothed(shape(scales, opacities), intervals, 0.2)
    torch.testing.assert_close(after.scales**2, scales**2 + 0.2 * intervals[:, None] ** 2)
    torch.testing.assert_close(after.opacities * after.scales.prod(1), opacities * scales.prod(1))


def test_finite_differences():
    scales = torch.tensor([[0.3, 0.01], [2.0, 0.4]], dtype=torch.float64, requires_grad=True)
    opacities = torch.tensor([0.7, 0.2], dtype=torch.float64, requires_grad=True)
    intervals = torch.tensor([0.1, 3.0], dtype=torch.float64)

    def outputs(scales: torch.Tensor, opacities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        after = smoothed(shape(scales, opacities), intervals, 0.2)
        return after.scales, after.opacities

    assert torch.autograd.gradcheck(outputs, (scales, opacities))


def surfels(count: int = 6) -> Surfels:
    generator = torch.Generator().manual_seed(0)
    draw = lambda *size: torch.randn(*size, generator=generator)  # noqa: E731
    means = draw(count, 3) * 0.2 + torch.tensor([0.0, 0.0, 4.0])
    return Surfels(means, draw(count, 2) - 3, draw(count, 4), draw(count), draw(count, 3), draw(count, 3, 3))


def test_fused_parameters_show_what_the_filter_shows():
    raw = surfels()
    smoothing = Smoothing(0.2, [camera(20)], NEAR)
    center = torch.zeros(3)
    filtered = smoothing.apply(activate(raw, center, 1))
    fused = activate(smoothing.fused(raw), center, 1)
    torch.testing.assert_close(fused.scales, filtered.scales)
    torch.testing.assert_close(fused.opacities, filtered.opacities)
    torch.testing.assert_close(fused.colors, filtered.colors)
    assert bool((filtered.scales >= math.sqrt(0.2) * smoothing.intervals[:, None]).all())


def test_intervals_follow_another_number_of_gaussians_only():
    smoothing = Smoothing(0.2, [camera(20)], NEAR)
    first = activate(surfels(4), torch.zeros(3), 1)
    smoothing.apply(first)
    moved = replace(first, means=first.means * 2)
    before = smoothing.intervals.clone()
    smoothing.apply(moved)
    assert torch.equal(smoothing.intervals, before)
    smoothing.refresh(moved.means)
    assert not torch.equal(smoothing.intervals, before)
    smoothing.apply(activate(surfels(6), torch.zeros(3), 1))
    assert len(smoothing.intervals) == 6
