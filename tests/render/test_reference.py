"""The rasteriser twin against closed forms and an independent ray-plane solve (docs/rasterizer.md)."""

import math

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.reference import surfels as reference
from rtgs.render.reference.surfels import rasterize_surfels

from .scenes import ALL_OUTPUTS, OUTPUTS, identity_camera, join, output, render, surfel, with_rows
from .strategies import Recipe, SurfelTensors, build, wild


def ray_plane_solve(surfels: SurfelTensors, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """u, v, z (H, W) of the first surfel's plane, from the 3x3 system p + u a + v b = z ray, per pixel."""
    rotation = camera.rotation
    point = camera.to_camera(surfels.means[0])
    axis_u = surfels.scales[0, 0] * (rotation @ surfels.tangent_u[0])
    axis_v = surfels.scales[0, 1] * (rotation @ surfels.tangent_v[0])
    rays = camera.camera_rays(torch.float64)
    columns = torch.stack((axis_u.expand_as(rays), axis_v.expand_as(rays), -rays), -1)
    return torch.linalg.solve(columns, -point.expand_as(rays)).unbind(-1)


def expected_alpha_depth(surfels: SurfelTensors, camera: Camera, near: float = 0.2) -> tuple[Tensor, Tensor]:
    """Alpha and depth of a single surfel by the page's rules, on top of :func:`ray_plane_solve`."""
    u, v, z = ray_plane_solve(surfels, camera)
    center, center_depth = camera.project(surfels.means[0])
    offset = reference.pixel_centers(camera, center).reshape(camera.height, camera.width, 2) - center
    rho_disc = 2 * offset.square().sum(-1)
    rho_plane = torch.where(z >= near, u * u + v * v, torch.inf)
    alpha = surfels.opacities[0] * torch.exp(-torch.minimum(rho_plane, rho_disc) / 2)
    alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp_max(0.99))
    return alpha, torch.where(rho_plane < rho_disc, z, center_depth)


def test_alpha_at_the_centre_is_the_opacity_and_the_background_shines_through():
    camera = identity_camera()
    one = surfel(opacity=0.6, features=(2.0, -1.0))
    buffers = render(one, camera, background=torch.tensor([0.5, 3.0], dtype=torch.float64))
    assert buffers.alpha[3, 4].item() == pytest.approx(0.6, abs=1e-15)
    assert buffers.features[:, 3, 4].tolist() == pytest.approx([0.6 * 2 + 0.4 * 0.5, -0.6 + 0.4 * 3.0])
    assert output(buffers, "depth")[3, 4].item() == pytest.approx(0.6 * 2.0)
    assert output(buffers, "median_depth")[3, 4].item() == pytest.approx(2.0)


def test_fronto_parallel_surfel_is_a_gaussian_in_pixels():
    camera = identity_camera(fy=14.0)
    alpha = render(surfel(scales=(0.5, 0.3), opacity=0.9), camera).alpha
    # one column away: u = (1 / fx) z / s; one row away: v = (1 / fy) z / s
    assert alpha[3, 5].item() == pytest.approx(0.9 * math.exp(-0.5 * (0.1 * 2 / 0.5) ** 2))
    assert alpha[4, 4].item() == pytest.approx(0.9 * math.exp(-0.5 * (2 / 14 / 0.3) ** 2))


def test_small_surfel_is_drawn_as_the_low_pass_disc():
    camera = identity_camera()
    buffers = render(surfel((0.05, -0.02, 2.0), scales=(1e-5, 1e-5), opacity=0.9), camera)
    offset = (0.25, -0.1)  # of the projected centre from the middle pixel's centre
    distance = (1 - offset[0]) ** 2 + offset[1] ** 2
    assert buffers.alpha[3, 5].item() == pytest.approx(0.9 * math.exp(-distance))
    assert output(buffers, "depth")[3, 5].item() == pytest.approx(2.0 * 0.9 * math.exp(-distance))


@pytest.mark.parametrize("seed", range(6))
def test_tilted_surfel_agrees_with_the_ray_plane_solve(seed: int):
    """Turned camera, off-centre principal point, fx != fy; tangents neither unit nor orthogonal."""
    scene = build(Recipe("ordinary", seed, 1, 23, 17, 3))
    values = SurfelTensors(*(t.double() for t in scene.surfels.all()))
    skewed = values.tangent_u + 0.3 * values.tangent_v
    opaque, scales = torch.tensor([0.9], dtype=torch.float64), torch.tensor([[0.6, 0.3]], dtype=torch.float64)
    values = with_rows(values, tangent_u=skewed, scales=scales, opacities=opaque)
    alpha, depth = expected_alpha_depth(values, scene.camera)
    buffers = render(values, scene.camera)
    torch.testing.assert_close(buffers.alpha, alpha, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(output(buffers, "depth"), alpha * depth, rtol=1e-9, atol=1e-12)
    assert (alpha > 0).sum() > 10


@pytest.mark.parametrize("tilt", [0.2, 0.7, 1.2, 1.5])
def test_surfel_crossing_the_camera_plane_shows_only_what_lies_beyond_near(tilt: float):
    """Its far side behind the camera projects into the picture as well, mirrored; none of that may show."""
    camera = identity_camera(21, 15, cx=8.2, cy=9.1)
    one = surfel(
        (0.1, 0.15, 0.9), tangent_u=(1, 0, 0), tangent_v=(0, math.cos(tilt), math.sin(tilt)), scales=(1.5, 3.0)
    )
    _, _, z = ray_plane_solve(one, camera)
    assert tilt < 1 or ((z < 0.2).any() and (z > 0.2).any())
    alpha, depth = expected_alpha_depth(one, camera)
    buffers = render(one, camera)
    torch.testing.assert_close(buffers.alpha, alpha, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(output(buffers, "depth"), alpha * depth, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("y", [0.03, 0.0])
def test_edge_on_surfel_is_only_its_disc_and_its_gradients_are_finite(y: float):
    """With y = 0 the middle row of pixels lies in the plane: numerator and denominator of the hit vanish."""
    one = surfel((0.0, y, 2.0), tangent_u=(1, 0, 0), tangent_v=(0, y, 2.0)).leaves(torch.float64)
    alpha = render(one, identity_camera()).alpha
    alpha.sum().backward()
    assert alpha[3, 5].item() == pytest.approx(0.6 * math.exp(-(1 + (5 * y) ** 2)))
    assert one.means.grad is not None
    assert one.scales.grad is not None
    assert one.means.grad.isfinite().all()
    assert one.means.grad[0, :2].any()
    assert not one.scales.grad.any()


def test_needle_is_never_thinner_than_the_low_pass():
    alpha = render(surfel(scales=(0.8, 1e-7), opacity=0.9), identity_camera()).alpha
    assert alpha[3, 6].item() == pytest.approx(0.9 * math.exp(-0.5 * (0.2 * 2 / 0.8) ** 2))  # along
    assert alpha[4, 4].item() == pytest.approx(0.9 * math.exp(-1.0))  # across: disc


def test_two_surfels_by_hand():
    camera = identity_camera()
    front = surfel((0, 0, 2.0), opacity=0.4, features=(1.0,))
    back = surfel((0, 0, 5.0), opacity=0.7, features=(10.0,), scales=(2.0, 2.0))
    buffers = render(join(back, front), camera)
    w_front, w_back = 0.4, 0.6 * 0.7
    m_front, m_back = (100 / 99.8 * (1 - 0.2 / z) for z in (2.0, 5.0))
    assert buffers.features[0, 3, 4].item() == pytest.approx(w_front + 10 * w_back)
    assert buffers.alpha[3, 4].item() == pytest.approx(1 - 0.6 * 0.3)
    assert output(buffers, "depth")[3, 4].item() == pytest.approx(2 * w_front + 5 * w_back)
    assert output(buffers, "median_depth")[3, 4].item() == pytest.approx(5.0)
    assert output(buffers, "distortion")[3, 4].item() == pytest.approx(w_front * w_back * (m_front - m_back) ** 2)


def test_distortion_is_the_weighted_sum_over_pairs():
    camera = identity_camera()
    depths, opacities = (1.0, 2.0, 3.0, 7.0), (0.3, 0.5, 0.2, 0.9)
    options = RasterOptions(near=0.1, far=50.0, distortion=True)
    stack = join(*(surfel((0, 0, z), opacity=o) for z, o in zip(depths, opacities)))
    weights, transmittance = [], 1.0
    for o in opacities:
        weights.append(o * transmittance)
        transmittance *= 1 - o
    mapped = [50 / 49.9 * (1 - 0.1 / z) for z in depths]
    pairs = sum(weights[i] * weights[j] * (mapped[i] - mapped[j]) ** 2 for i in range(4) for j in range(i))
    assert output(render(stack, camera, options), "distortion")[3, 4].item() == pytest.approx(pairs)


def test_median_is_the_last_surfel_met_above_one_half_and_zero_without_surfels():
    camera = identity_camera(31, 7)
    stack = join(*(surfel((0, 0, z), opacity=0.35, scales=(0.05, 0.05)) for z in (1.0, 2.0, 3.0)))
    median = output(render(stack, camera), "median_depth")  # T before: 1, 0.65, 0.4225
    assert median[3, 15].item() == pytest.approx(2.0)
    assert median[3, 0].item() == 0.0


def test_normal_is_the_unnormalised_cross_product_turned_to_the_camera():
    tangent_u, tangent_v = (2.0, 0.0, 0.0), (0.0, 1.0, 0.5)  # cross product (0, -1, 2): away from the camera
    one = surfel(tangent_u=tangent_u, tangent_v=tangent_v)
    normal = output(render(one, identity_camera()), "normal")[:, 3, 4]
    assert normal.tolist() == pytest.approx([0.0, 0.6, -1.2])
    swapped = surfel(tangent_u=tangent_v, tangent_v=tangent_u)
    normal = output(render(swapped, identity_camera()), "normal")[:, 3, 4]
    assert normal.tolist() == pytest.approx([0.0, 0.6, -1.2])


def test_normal_is_in_the_world_frame():
    rotation = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # looks along world +x
    camera = Camera(rotation, torch.zeros(3), 10.0, 10.0, 4.5, 3.5, 9, 7)
    one = surfel((2.0, 0.0, 0.0), tangent_u=(0, 1, 0), tangent_v=(0, 0, 1))
    assert output(render(one, camera), "normal")[:, 3, 4].tolist() == pytest.approx([-0.6, 0.0, 0.0])


def test_pixel_stops_after_the_surfel_that_takes_transmittance_below_the_cutoff():
    stack = join(*(surfel((0, 0, z), opacity=0.95) for z in (1.0, 2.0, 3.0, 4.0, 5.0)))
    buffers = render(stack, identity_camera(1, 1))  # T before: 1, 0.05, 2.5e-3, 1.25e-4, 6.25e-6
    assert (1 - buffers.alpha).item() == pytest.approx(0.05**4, rel=1e-6)
    assert output(buffers, "weight_sum").tolist() == pytest.approx([0.95, 0.0475, 0.002375, 0.95 * 1.25e-4, 0.0])


@pytest.mark.parametrize(("factor", "drawn"), [(1.001, True), (0.999, False)])
def test_alpha_cut_is_at_one_in_255(factor: float, drawn: bool):
    assert (render(surfel(opacity=factor / 255), identity_camera()).alpha[3, 4] > 0).item() is drawn
    edge = math.sqrt(2 * math.log(255 * 0.6)) / 2 * 10 * 0.5  # pixels from the centre at which alpha is 1/255
    shifted = identity_camera(3, 1, cx=1.5 + edge * (1 / factor))
    assert (render(surfel(), shifted).alpha[0, 1] > 0).item() is drawn


def test_alpha_is_clamped_and_the_clamp_passes_no_gradient():
    one = surfel(opacity=1.0).leaves(torch.float64)
    alpha = render(one, identity_camera()).alpha
    assert alpha[3, 4].item() == 0.99
    (gradient,) = torch.autograd.grad(alpha[3, 4], one.opacities, retain_graph=True)
    assert gradient.item() == 0.0
    (gradient,) = torch.autograd.grad(alpha[3, 6], one.opacities)
    assert gradient.item() == pytest.approx(alpha[3, 6].item())


CULLED = {
    "behind": {"mean": (0.0, 0.0, -2.0)},
    "at the near plane": {"mean": (0.0, 0.0, 0.2)},
    "opacity": {"opacity": 0.99 / 255},
    "zero scale": {"scales": (0.5, 0.0)},
    "negative scale": {"scales": (-0.5, 0.5)},
    "nan mean": {"mean": (math.nan, 0.0, 2.0)},
    "inf depth": {"mean": (0.0, 0.0, math.inf)},
    "nan opacity": {"opacity": math.nan},
    "inf scale": {"scales": (math.inf, 0.5)},
    "nan tangent": {"tangent_v": (0.0, math.nan, 0.0)},
    "inf feature": {"features": (math.inf,)},
}


@pytest.mark.parametrize("case", CULLED.values(), ids=CULLED.keys())
def test_culled_surfel_leaves_no_trace(case: dict):
    camera = identity_camera()
    kept = surfel((0.1, 0.1, 3.0))
    both = join(surfel(**case), kept).leaves(torch.float64)
    probe = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    buffers = rasterize_surfels(*both.all(), camera, options=ALL_OUTPUTS, screen_probe=probe)
    alone = render(kept, camera)
    for name in OUTPUTS:
        assert torch.equal(output(buffers, name), output(alone, name)), name
    sum(output(buffers, name).sum() for name in OUTPUTS).backward()  # type: ignore[union-attr]
    for tensor in (*both.all(), probe):
        assert tensor.grad is not None
        assert not tensor.grad[0].any()
        assert tensor.grad.isfinite().all()


def test_order_of_rows_does_not_matter_except_for_ties():
    scene = build(Recipe("ordinary", 3, 30, 20, 14, 4))
    values = SurfelTensors(*(t.double() for t in scene.surfels.all()))
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    straight, permuted = render(values, scene.camera), render(values.rows(order), scene.camera)
    for name in OUTPUTS:
        torch.testing.assert_close(output(permuted, name), output(straight, name), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(output(permuted, "weight_sum"), output(straight, "weight_sum")[order])


def test_equal_depths_go_by_row_and_the_key_is_float32():
    first, second = surfel(opacity=0.5, features=(1.0,)), surfel(opacity=0.5, features=(0.0,))
    nearer_in_float64 = surfel((0, 0, 2.0 - 1e-9), opacity=0.5, features=(0.0,))
    camera = identity_camera()
    for other in (second, nearer_in_float64):
        assert render(join(first, other), camera).features[0, 3, 4].item() == pytest.approx(0.5)
        assert render(join(other, first), camera).features[0, 3, 4].item() == pytest.approx(0.25)


def test_weight_sum_is_the_gradient_of_the_summed_features():
    scene = build(Recipe("ordinary", 5, 20, 19, 13, 1, background=False))
    values = scene.surfels.leaves(torch.float64)
    buffers = render(values, scene.camera)
    (gradient,) = torch.autograd.grad(buffers.features.sum(), values.features)
    torch.testing.assert_close(output(buffers, "weight_sum"), gradient[:, 0])
    assert not output(buffers, "weight_sum").requires_grad


def test_optional_outputs_are_none_unless_asked_for():
    buffers = rasterize_surfels(*surfel().all(), identity_camera())
    assert [buffers.depth, buffers.median_depth, buffers.normal, buffers.distortion, buffers.weight_sum] == [None] * 5


def test_no_surfels_give_the_background():
    background = torch.tensor([0.25], dtype=torch.float64)
    buffers = render(surfel().rows(torch.empty(0, dtype=torch.long)), identity_camera(), background=background)
    assert (buffers.features == 0.25).all()
    assert not buffers.alpha.any()


def test_chunks_of_pixels_give_the_same_picture_and_gradients(monkeypatch: pytest.MonkeyPatch):
    scene = build(Recipe("ordinary", 7, 12, 17, 11, 3))

    def run() -> list[Tensor]:
        values = scene.surfels.leaves(torch.float64)
        buffers = render(values, scene.camera)
        loss = torch.stack([output(buffers, name).square().sum() for name in OUTPUTS]).sum()
        return [*(output(buffers, name) for name in (*OUTPUTS, "weight_sum")), *torch.autograd.grad(loss, values.all())]

    whole = run()
    monkeypatch.setattr(reference, "PAIRS_PER_CHUNK", 12 * 25)
    for a, b in zip(run(), whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "shape"),
    [("means", (2, 2)), ("scales", (1, 2)), ("opacities", (2, 1)), ("features", (2, 33)), ("tangent_v", (3, 3))],
)
def test_wrong_shapes_are_named(name: str, shape: tuple[int, ...]):
    pair = with_rows(join(surfel(), surfel()), **{name: torch.ones(shape, dtype=torch.float64)})
    with pytest.raises(ValueError, match=name):
        render(pair, identity_camera())


@pytest.mark.parametrize("seed", range(12))
def test_nothing_is_nan_or_inf_for_extreme_float32_values(seed: int):
    """float64 has room for every product of values from 1e-30 to 1e30."""
    scene = wild(seed, 25)
    values = scene.surfels.leaves(torch.float64)
    buffers = render(values, scene.camera)
    torch.stack([output(buffers, name).sum() for name in OUTPUTS]).sum().backward()
    for name in (*OUTPUTS, "weight_sum"):
        assert output(buffers, name).isfinite().all(), name
    for tensor in values.all():
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
