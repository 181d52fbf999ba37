"""The screen filter of surfels: its twin, an independent covariance, finite differences, and what it is for."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import EllipsoidOptions, RasterOptions
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference import surfels as reference
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids
from rtgs.render.reference.surfel_filter import convolve_surfels as by_singular_values
from rtgs.render.surfel_filter import convolve_surfels
from rtgs.render.surfels import rasterize_surfels

from .scenes import ALL_OUTPUTS, OUTPUTS, identity_camera, output, surfel
from .strategies import NAMES, Recipe, SurfelTensors, build
from .test_reference_gradients import projection, smooth_camera, smooth_scene
from .twin_runs import Pools, answer, run

VARIANCE = 0.3
CONVOLVED = RasterOptions(convolved=True, low_pass=VARIANCE)
ALL_CONVOLVED = replace(ALL_OUTPUTS, convolved=True, low_pass=VARIANCE)
NEAR = 0.2


def geometry(values: SurfelTensors) -> tuple[Tensor, ...]:
    return values.all()[:5]


def footprint(values: tuple[Tensor, ...], camera: Camera) -> Tensor:
    """(N, 2, 2) d (pixel) / d (u, v) at the centres, by central differences of the projection."""
    means, tangent_u, tangent_v, scales, *_ = values
    columns = []
    for axis in (scales[:, :1] * tangent_u, scales[:, 1:] * tangent_v):
        ahead, behind = camera.project(means + 1e-5 * axis)[0], camera.project(means - 1e-5 * axis)[0]
        columns.append((ahead - behind) / 2e-5)
    return torch.stack(columns, -1)


def ordinary(seed: int = 0) -> tuple[SurfelTensors, Camera]:
    scene = build(Recipe("ordinary", seed, 40, 33, 25, 2))
    return SurfelTensors(*(t.double() for t in scene.surfels.all())), scene.camera


def test_the_covariance_grows_by_the_variance_and_the_weight_stays():
    values, camera = ordinary()
    axis_u, axis_v, opacities = convolve_surfels(*geometry(values), camera, VARIANCE, NEAR)
    before = footprint(geometry(values), camera)
    after = footprint((values.means, axis_u, axis_v, torch.ones_like(values.scales)), camera)
    covariance = before @ before.mT
    torch.testing.assert_close(after @ after.mT, covariance + VARIANCE * torch.eye(2).double(), rtol=1e-6, atol=1e-6)
    shrunk = torch.linalg.det(before).abs() / torch.linalg.det(after).abs()
    torch.testing.assert_close(opacities, values.opacities * shrunk, rtol=1e-6, atol=1e-9)


def test_depths_along_the_axes_stay():
    values, camera = ordinary()
    axis_u, axis_v, _ = convolve_surfels(*geometry(values), camera, VARIANCE, NEAR)
    forward = camera.rotation[2]
    torch.testing.assert_close(axis_u @ forward, (values.scales[:, :1] * values.tangent_u) @ forward)
    torch.testing.assert_close(axis_v @ forward, (values.scales[:, 1:] * values.tangent_v) @ forward)


@pytest.mark.parametrize("seed", range(3))
def test_closed_form_and_singular_values_agree_with_their_gradients(seed: int):
    values, camera = ordinary(seed)
    results = []
    for convolve in (convolve_surfels, by_singular_values):
        leaves = values.leaves(torch.float64)
        outputs = convolve(*geometry(leaves), camera, VARIANCE, NEAR)
        loss = sum((out * projection(out.shape, place)).sum() for place, out in enumerate(outputs))
        results.append((outputs, torch.autograd.grad(loss, geometry(leaves))))
    for fast, twin in zip(*results, strict=True):
        torch.testing.assert_close(fast, twin, rtol=1e-8, atol=1e-10)


def test_a_surfel_seen_edge_on_becomes_a_narrow_finite_disc_of_no_weight():
    across = surfel(tangent_v=(0.0, 0.0, 1.0), scales=(0.5, 0.5))
    camera = identity_camera()
    axis_u, axis_v, opacities = convolve_surfels(*geometry(across), camera, VARIANCE, NEAR)
    pixel = 2.0 / 10.0  # z / f
    assert opacities.item() == 0.0
    assert axis_u.norm().item() == pytest.approx(math.hypot(0.5, math.sqrt(VARIANCE) * pixel), rel=1e-9)
    width, depth = axis_v[0, 1].abs().item(), axis_v[0, 2].item()
    assert (width, depth) == (pytest.approx(math.sqrt(VARIANCE) * pixel), pytest.approx(0.5))


@pytest.mark.parametrize("name", OUTPUTS)
def test_gradients_of_each_output_agree_with_finite_differences(name: str):
    camera, values = smooth_camera(), smooth_scene(smooth_camera())
    assert not discontinuity_mask(*values.all(), camera, options=ALL_CONVOLVED).any()

    def scalar(*tensors: Tensor) -> Tensor:
        picture = output(reference.rasterize_surfels(*tensors, camera, options=ALL_CONVOLVED), name)
        return (picture * projection(picture.shape)).sum()

    assert torch.autograd.gradcheck(scalar, values.leaves(torch.float64).all(), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["ordinary", "crowded", "tiny"])
@pytest.mark.parametrize("variance", [0.1, 0.5])
def test_kernel_and_twin_agree(isa: str, kind: str, variance: float):
    options = replace(ALL_CONVOLVED, low_pass=variance)
    pools = Pools()
    for seed in range(6):
        found = answer(build(Recipe(kind, seed, 30, 33, 25, 3)), seed, options)
        pools.add(run(rasterize_surfels, found.scene, torch.float32, found.upstream, options), found)
    assert pools.flagged_share < 0.5
    for name, pool in pools.pictures.items():
        assert pool.share_beyond(1e-5) <= 1e-3, f"{name}: worst {pool.worst:.1e}"
    for name, pool in pools.gradients.items():
        assert pool.worst <= 1e-4, name


@pytest.mark.parametrize("low_pass", [0.1, 2.0])
def test_another_low_pass_disc(isa: str, low_pass: float):
    options = replace(ALL_OUTPUTS, low_pass=low_pass)
    pools = Pools()
    for seed in range(6):
        found = answer(build(Recipe("tiny", seed, 30, 33, 25, 3)), seed, options)
        pools.add(run(rasterize_surfels, found.scene, torch.float32, found.upstream, options), found)
    for name, pool in pools.pictures.items():
        assert pool.share_beyond(1e-5) <= 1e-3, f"{name}: worst {pool.worst:.1e}"
    for name, pool in pools.gradients.items():
        assert pool.worst <= 1e-4, name


def pattern(count: int = 40) -> SurfelTensors:
    """A board of faint surfels, light and dark by turns, a pixel apart at the full size; half of them dark."""
    place = torch.arange(count, dtype=torch.float64) - (count - 1) / 2
    y, x = torch.meshgrid(place, place, indexing="ij")
    means = torch.stack((x.flatten(), y.flatten(), torch.full((count * count,), 64.0).double()), 1)
    rows = len(means)
    light = ((torch.arange(count)[:, None] + torch.arange(count)) % 2).flatten().double()
    along = torch.tensor([1.0, 0.0, 0.0]).double().expand(rows, 3)
    down = torch.tensor([0.0, 1.0, 0.0]).double().expand(rows, 3)
    scales = torch.full((rows, 2), 0.3).double()
    return SurfelTensors(means, along, down, scales, torch.full((rows,), 0.05).double(), light[:, None])


def mean_light(divisor: float, options: RasterOptions) -> float:
    """Of the middle of the pattern at a size ``divisor`` times smaller."""
    side = int(32 / divisor)
    camera = Camera(torch.eye(3), torch.zeros(3), 64 / divisor, 64 / divisor, side / 2, side / 2, side, side)
    options = replace(options, alpha_cutoff=1e-6)
    picture = reference.rasterize_surfels(*pattern().all(), camera, options=options).features[0]
    quarter = side // 4
    return picture[quarter : side - quarter, quarter : side - quarter].mean().item()


@pytest.mark.parametrize("divisor", [2.0, 4.0])
def test_a_fine_pattern_has_the_same_mean_at_every_size(divisor: float):
    full = mean_light(1.0, CONVOLVED)
    assert mean_light(divisor, CONVOLVED) == pytest.approx(full, rel=0.02)
    # the disc of 2DGS does not shrink with the surfels: what is rendered smaller is more opaque
    assert mean_light(divisor, RasterOptions()) > 1.5 * mean_light(1.0, RasterOptions())


def test_the_same_of_ellipsoids():
    """Their cut at an alpha of 1/255 takes a few percent: a wider, sparser pattern."""

    def mean(divisor: float, options: EllipsoidOptions) -> float:
        board = pattern(20)
        side = int(32 / divisor)
        camera = Camera(torch.eye(3), torch.zeros(3), 64 / divisor, 64 / divisor, side / 2, side / 2, side, side)
        round_ones = torch.full((len(board.means), 3), 0.6).double()
        opaque = torch.full_like(board.opacities, 0.2)
        apart = board.means * torch.tensor([2.3, 2.3, 1.0]).double()  # at all places between pixel centres
        rows = (apart, board.tangent_u, board.tangent_v, round_ones, opaque, board.features)
        picture = rasterize_ellipsoids(*rows, camera, options=options).features[0]
        quarter = side // 4
        return picture[quarter : side - quarter, quarter : side - quarter].mean().item()

    compensated = EllipsoidOptions(dilation=0.1, antialiased=True)
    assert mean(2.0, compensated) == pytest.approx(mean(1.0, compensated), rel=0.05)
    assert mean(2.0, EllipsoidOptions()) > 1.2 * mean(1.0, EllipsoidOptions())


def test_normals_are_those_of_the_surfels():
    tilted = surfel(tangent_v=(0.0, 0.6, 0.8), scales=(0.02, 0.02), opacity=0.9)
    buffers = reference.rasterize_surfels(*tilted.all(), identity_camera(), options=ALL_CONVOLVED)
    shown = buffers.alpha > 0.01
    assert shown.any()
    normal = output(buffers, "normal")[:, shown] / buffers.alpha[shown]
    expected = torch.tensor([0.0, 0.8, -0.6]).double()[:, None].expand_as(normal)
    torch.testing.assert_close(normal, expected, rtol=1e-6, atol=1e-6)


def test_gradients_reach_every_input_of_the_kernel():
    values, camera = ordinary()
    leaves = values.leaves(torch.float32)
    rasterize_surfels(*leaves.all(), camera, options=CONVOLVED).features.sum().backward()
    for name in NAMES:
        grad = getattr(leaves, name).grad
        assert grad is not None, name
        assert bool(grad.isfinite().all()), name
        assert bool((grad != 0).any()), name
