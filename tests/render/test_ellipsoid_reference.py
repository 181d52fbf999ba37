"""The ellipsoids' twin: closed forms, an independent covariance, finite differences (docs/rasterizer.md)."""

import math

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import EllipsoidBuffers, EllipsoidOptions
from rtgs.render.discontinuities.ellipsoids import ellipsoid_discontinuity_mask
from rtgs.render.reference import surfels as reference
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids

from .ellipsoid_runs import ANTIALIASED, PICTURES, PLAIN, build_ellipsoids, ellipsoid, wild_ellipsoids
from .scenes import identity_camera, join, output
from .strategies import NAMES, Recipe, SurfelTensors
from .test_reference_gradients import projection, smooth_camera


def render(
    values: SurfelTensors, camera: Camera, options: EllipsoidOptions = PLAIN, **extra: Tensor
) -> EllipsoidBuffers:
    return rasterize_ellipsoids(*values.all(), camera, options=options, **extra)


def independent_alpha(values: SurfelTensors, camera: Camera, options: EllipsoidOptions) -> Tensor:
    """(H, W) alpha of the first ellipsoid by 3x3 matrices: Sigma' = J R Sigma R^T J^T + dilation, inverted."""
    axes = torch.stack((values.tangent_u[0], values.tangent_v[0]))
    axes = torch.cat((axes, torch.linalg.cross(axes[0], axes[1])[None])) * values.scales[0][:, None]
    covariance = camera.rotation @ (axes.T @ axes) @ camera.rotation.T
    x, y, z = camera.to_camera(values.means[0]).tolist()
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    middle_x, middle_y = tan_x - camera.cx / camera.fx, tan_y - camera.cy / camera.fy  # of the field of view
    ray_x = min(max(x / z, middle_x - 1.3 * tan_x), middle_x + 1.3 * tan_x)
    ray_y = min(max(y / z, middle_y - 1.3 * tan_y), middle_y + 1.3 * tan_y)
    jacobian = torch.tensor(
        [[camera.fx / z, 0, -camera.fx * ray_x / z], [0, camera.fy / z, -camera.fy * ray_y / z]], dtype=torch.float64
    )
    screen = jacobian @ covariance @ jacobian.T
    dilated = screen + options.dilation * torch.eye(2, dtype=torch.float64)
    opacity = values.opacities[0]
    if options.antialiased:
        opacity = opacity * (torch.linalg.det(screen) / torch.linalg.det(dilated)).clamp_min(2.5e-5).sqrt()
    center, _ = camera.project(values.means[0])
    offset = reference.pixel_centers(camera, center) - center
    rho = ((offset @ torch.linalg.inv(dilated)) * offset).sum(-1).reshape(camera.height, camera.width)
    alpha = opacity * torch.exp(-0.5 * rho)
    return torch.where((alpha >= 1 / 255) & (rho <= options.radius_sigmas**2), alpha.clamp_max(0.99), 0.0)


@pytest.mark.parametrize(
    "options",
    [PLAIN, ANTIALIASED, EllipsoidOptions(dilation=1.5, depth=True), EllipsoidOptions(radius_sigmas=1.5, depth=True)],
    ids=["plain", "antialiased", "dilation", "radius"],
)
@pytest.mark.parametrize("seed", range(4))
def test_one_ellipsoid_agrees_with_the_inverted_covariance(seed: int, options: EllipsoidOptions):
    scene = build_ellipsoids(Recipe("crossing" if seed == 3 else "ordinary", seed, 6, 25, 17, 1, background=False))
    for row in range(6):
        values = SurfelTensors(*(t[row : row + 1].double() for t in scene.surfels.all()))
        buffers = render(values, scene.camera, options)
        expected = independent_alpha(values, scene.camera, options)
        torch.testing.assert_close(buffers.alpha, expected, rtol=1e-9, atol=1e-12)
        depth = scene.camera.project(values.means[0])[1]
        torch.testing.assert_close(output(buffers, "depth"), expected * depth, rtol=1e-9, atol=1e-12)


def test_alpha_at_the_centre_is_the_opacity_and_the_background_shines_through():
    one = ellipsoid(opacity=0.6, features=(2.0, -1.0))
    buffers = render(one, identity_camera(), background=torch.tensor([0.5, 3.0], dtype=torch.float64))
    assert buffers.alpha[3, 4].item() == pytest.approx(0.6, abs=1e-15)
    assert buffers.features[:, 3, 4].tolist() == pytest.approx([0.6 * 2 + 0.4 * 0.5, -0.6 + 0.4 * 3.0])
    assert output(buffers, "depth")[3, 4].item() == pytest.approx(0.6 * 2.0)


def test_a_point_is_drawn_as_the_dilation():
    alpha = render(ellipsoid(scales=(1e-6, 1e-6, 1e-6), opacity=0.9), identity_camera()).alpha
    assert alpha[3, 5].item() == pytest.approx(0.9 * math.exp(-0.5 / 0.3), rel=1e-6)


def test_antialiasing_keeps_the_weight_of_a_small_ellipsoid():
    """A Gaussian of sigma s pixels has the integral 2 pi s^2 o, dilated or not; the floor is 0.005."""
    one = ellipsoid(scales=(0.08, 0.08, 1e-3), opacity=0.9)  # sigma 0.4 pixels
    total = render(one, identity_camera(31, 31), ANTIALIASED).alpha.sum().item()
    assert total == pytest.approx(2 * math.pi * 0.4**2 * 0.9, rel=0.02)
    point = ellipsoid(scales=(1e-6, 1e-6, 1e-6), opacity=0.9)
    assert render(point, identity_camera(), ANTIALIASED).alpha[3, 4].item() == pytest.approx(0.9 * 0.005)


def test_the_radius_cuts_what_the_exact_support_keeps():
    one, camera = ellipsoid(scales=(0.2, 0.2, 0.2), opacity=0.98), identity_camera(31, 1)
    sigma = math.hypot(1.0, math.sqrt(0.3))
    exact, three = (render(one, camera, EllipsoidOptions(radius_sigmas=r)).alpha[0] for r in (math.inf, 3.0))
    distance = (torch.arange(31) - 15).abs() / sigma
    assert torch.equal(exact > 0, distance <= math.sqrt(2 * math.log(255 * 0.98)))
    assert torch.equal(three > 0, distance <= 3)


def test_pixel_stops_after_the_one_that_takes_transmittance_below_the_cutoff():
    stack = join(*(ellipsoid((0, 0, z), opacity=0.95) for z in (1.0, 2.0, 3.0, 4.0, 5.0)))
    buffers = render(stack, identity_camera(1, 1))
    assert (1 - buffers.alpha).item() == pytest.approx(0.05**4, rel=1e-6)
    assert output(buffers, "weight_sum").tolist() == pytest.approx([0.95, 0.0475, 0.002375, 0.95 * 1.25e-4, 0.0])


def test_equal_depths_go_by_row_and_the_key_is_float32():
    first, second = ellipsoid(opacity=0.5, features=(1.0,)), ellipsoid(opacity=0.5, features=(0.0,))
    nearer_in_float64 = ellipsoid((0, 0, 2.0 - 1e-9), opacity=0.5, features=(0.0,))
    for other in (second, nearer_in_float64):
        assert render(join(first, other), identity_camera()).features[0, 3, 4].item() == pytest.approx(0.5)
        assert render(join(other, first), identity_camera()).features[0, 3, 4].item() == pytest.approx(0.25)


CULLED = {
    "behind": {"mean": (0.0, 0.0, -2.0)},
    "at the near plane": {"mean": (0.0, 0.0, 0.2)},
    "opacity": {"opacity": 0.99 / 255},
    "zero scale": {"scales": (0.5, 0.5, 0.0)},
    "nan mean": {"mean": (math.nan, 0.0, 2.0)},
    "inf scale": {"scales": (math.inf, 0.5, 0.5)},
    "nan tangent": {"tangent_v": (0.0, math.nan, 0.0)},
}


@pytest.mark.parametrize("case", CULLED.values(), ids=CULLED.keys())
def test_a_culled_ellipsoid_leaves_no_trace(case: dict):
    camera, kept = identity_camera(), ellipsoid((0.1, 0.1, 3.0))
    both = join(ellipsoid(**case), kept).leaves(torch.float64)
    probe = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    buffers = rasterize_ellipsoids(*both.all(), camera, options=ANTIALIASED, screen_probe=probe)
    alone = render(kept, camera, ANTIALIASED)
    for name in PICTURES:
        assert torch.equal(output(buffers, name), output(alone, name)), name
    sum(output(buffers, name).sum() for name in PICTURES).backward()  # type: ignore[union-attr]
    for tensor in (*both.all(), probe):
        assert tensor.grad is not None
        assert not tensor.grad[0].any()
        assert tensor.grad.isfinite().all()


def smooth_scene(camera: Camera) -> SurfelTensors:
    """Camera-frame ellipsoids brought to the world: long, flat, sheared, one beyond the Jacobian's clamp, one tiny."""
    local = join(
        ellipsoid((0.3, 0.1, 5.0), tangent_u=(1, 0.1, 0.5), tangent_v=(0, 1.2, 0.3), scales=(3, 4, 2), opacity=0.8),
        ellipsoid((0.03, -0.05, 3.1), scales=(0.05, 0.3, 0.1), opacity=0.7),
        ellipsoid(
            (-0.2, 0.2, 2.4), tangent_u=(1, 0.3, -0.4), tangent_v=(0.2, 1, 0.6), scales=(1.2, 1.5, 3.0), opacity=0.5
        ),
        ellipsoid(
            (-2.6, 0.0, 1.5), tangent_u=(0, 1, 0.2), tangent_v=(0.9, 0, -0.5), scales=(1.1, 2.9, 1.0), opacity=0.6
        ),
    )
    features = torch.tensor([[0.3, -1.0], [1.0, 0.2], [-0.4, 0.7], [0.8, 0.5]], dtype=torch.float64)
    return SurfelTensors(
        (local.means - camera.translation) @ camera.rotation,
        local.tangent_u @ camera.rotation,
        local.tangent_v @ camera.rotation,
        *(local.scales, local.opacities, features),
    )


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
def test_the_smooth_scene_is_smooth_and_all_of_it_shows(options: EllipsoidOptions):
    camera = smooth_camera()
    values = smooth_scene(camera)
    assert not ellipsoid_discontinuity_mask(*values.all(), camera, options=options).any()
    assert (output(render(values, camera, options), "weight_sum") > 0.03).all()


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
@pytest.mark.parametrize("name", PICTURES)
def test_gradients_agree_with_finite_differences(name: str, options: EllipsoidOptions):
    camera = smooth_camera()
    background = torch.tensor([0.3, -0.6], dtype=torch.float64)

    def scalar(*tensors: Tensor) -> Tensor:
        picture = output(rasterize_ellipsoids(*tensors, camera, background=background, options=options), name)
        return (picture * projection(picture.shape)).sum()

    leaves = smooth_scene(camera).leaves(torch.float64).all()
    assert torch.autograd.gradcheck(scalar, leaves, eps=1e-6, atol=1e-7, rtol=1e-5)
    gradients = torch.autograd.grad(scalar(*leaves), leaves)
    for tensor, gradient in zip(NAMES, gradients, strict=True):
        assert bool(gradient.any()) is (tensor != "features" or name == "features"), tensor


def test_the_signal_is_the_derivative_by_the_centre_in_device_coordinates():
    """The principal point moves every projected centre and nothing else, as long as no Jacobian is clamped."""
    camera = smooth_camera()
    scene = smooth_scene(camera)
    wide = identity_camera(9, 7)
    one = SurfelTensors(*(t[1:2] for t in scene.all()))
    one = SurfelTensors(torch.tensor([[0.1, 0.05, 3.0]], dtype=torch.float64), *one.all()[1:])

    def scalar(cx: float, cy: float, probe: Tensor | None = None) -> Tensor:
        view = Camera(wide.rotation, wide.translation, wide.fx, wide.fy, cx, cy, wide.width, wide.height)
        buffers = rasterize_ellipsoids(*one.all(), view, options=PLAIN, screen_probe=probe)
        return sum((output(buffers, n) * projection(output(buffers, n).shape, i)).sum() for i, n in enumerate(PICTURES))  # type: ignore[return-value]

    probe = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    (signal,) = torch.autograd.grad(scalar(wide.cx, wide.cy, probe), probe)
    step = 1e-6
    by_x = (scalar(wide.cx + step, wide.cy) - scalar(wide.cx - step, wide.cy)) / (2 * step) * wide.width / 2
    by_y = (scalar(wide.cx, wide.cy + step) - scalar(wide.cx, wide.cy - step)) / (2 * step) * wide.height / 2
    assert signal[0].tolist() == pytest.approx([by_x.item(), by_y.item()], rel=1e-6)


def test_weight_sum_is_the_gradient_of_the_summed_features():
    scene = build_ellipsoids(Recipe("ordinary", 5, 20, 19, 13, 1, background=False))
    values = scene.surfels.leaves(torch.float64)
    buffers = render(values, scene.camera)
    (gradient,) = torch.autograd.grad(buffers.features.sum(), values.features)
    torch.testing.assert_close(output(buffers, "weight_sum"), gradient[:, 0])
    assert not output(buffers, "weight_sum").requires_grad


def test_optional_outputs_are_none_unless_asked_for_and_no_ellipsoids_give_the_background():
    buffers = rasterize_ellipsoids(*ellipsoid().all(), identity_camera())
    assert (buffers.depth, buffers.weight_sum) == (None, None)
    background = torch.tensor([0.25], dtype=torch.float64)
    empty = render(ellipsoid().rows(torch.empty(0, dtype=torch.long)), identity_camera(), background=background)
    assert (empty.features == 0.25).all()


def test_chunks_of_pixels_give_the_same_picture_and_gradients(monkeypatch: pytest.MonkeyPatch):
    scene = build_ellipsoids(Recipe("ordinary", 7, 12, 17, 11, 3))

    def run() -> list[Tensor]:
        values = scene.surfels.leaves(torch.float64)
        buffers = render(values, scene.camera)
        loss = torch.stack([output(buffers, name).square().sum() for name in PICTURES]).sum()
        return [*(output(buffers, name) for name in PICTURES), *torch.autograd.grad(loss, values.all())]

    whole = run()
    monkeypatch.setattr(reference, "PAIRS_PER_CHUNK", 12 * 25)
    for a, b in zip(run(), whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_nan_or_inf_for_extreme_float32_values(seed: int, options: EllipsoidOptions):
    values = wild_ellipsoids(seed, 25).surfels.leaves(torch.float64)
    buffers = render(values, wild_ellipsoids(seed, 25).camera, options)
    torch.stack([output(buffers, name).sum() for name in PICTURES]).sum().backward()
    for name in (*PICTURES, "weight_sum"):
        assert output(buffers, name).isfinite().all(), name
    for tensor in values.all():
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
