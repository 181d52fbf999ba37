"""Losses: the native kernels against their float64 twins, the twins against finite differences and closed forms."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.render.depth_normals import depth_normals
from rtgs.train import losses, reference_losses

ISAS = core.available_isas()
SIZES = [(1, 1), (2, 3), (3, 2), (3, 3), (11, 11), (17, 4), (5, 33), (37, 50)]  # (height, width)
quick = settings(max_examples=25, deadline=None, database=None)


@pytest.fixture(autouse=True)
def restore_process_state():
    isa, threads = core.isa(), torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    core.select_isa(isa)
    torch.set_num_threads(threads)


def make_camera(height: int, width: int, generator: torch.Generator) -> Camera:
    """Any orientation, fx != fy, principal point off the centre."""
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    rotation = rotation * torch.linalg.det(rotation)
    center = torch.randn(3, generator=generator)
    return Camera(rotation, center, 1.1 * width + 1, 1.3 * width + 1, 0.45 * width, 0.6 * height, width, height)


def make_view(height: int, width: int, generator: torch.Generator, empty: float) -> tuple[torch.Tensor, ...]:
    """A rendered view as (normal, depth, alpha) with a share of ``empty`` pixels."""
    alpha = 0.02 + 0.98 * torch.rand(height, width, generator=generator)
    alpha[torch.rand(height, width, generator=generator) < empty] = 0
    depth = (2 + torch.rand(height, width, generator=generator)) * alpha
    normal = torch.randn(3, height, width, generator=generator) * alpha
    return normal, depth, alpha


def leaves(tensors, dtype=torch.float32) -> list[torch.Tensor]:
    return [tensor.to(dtype, copy=True).requires_grad_() for tensor in tensors]


def assert_gradients_close(native, twin, relative: float, floors) -> None:
    for ours, exact, floor in zip(native, twin, floors, strict=True):
        assert torch.isfinite(ours.grad).all()
        assert (ours.grad - exact.grad).abs().max() <= relative * exact.grad.abs().max() + floor


# ---- photometric -------------------------------------------------------------------------------------------


def make_pair(height: int, width: int, channels: int, kind: str, generator: torch.Generator):
    image = torch.rand(channels, height, width, generator=generator)
    noise = torch.randn(channels, height, width, generator=generator)
    if kind == "close":
        return image, image + 1e-3 * noise
    if kind == "constant":
        return torch.full_like(image, 0.7), torch.full_like(image, 0.2)
    if kind == "black":
        return torch.zeros_like(image), image
    if kind == "extreme":
        return image.round(), 1 - image.round()
    if kind == "bright":
        return 30 * image, image
    return image, torch.rand(channels, height, width, generator=generator)


@pytest.mark.parametrize("isa", ISAS)
@quick
@given(
    size=st.sampled_from(SIZES),
    channels=st.sampled_from([1, 3, 4]),
    kind=st.sampled_from(["random", "close", "constant", "black", "extreme", "bright"]),
    weights=st.sampled_from([(0.8, 0.2), (0.0, 1.0), (1.0, 0.0)]),
    seed=st.integers(0, 2**31),
)
def test_photometric_loss_equals_its_twin(isa, size, channels, kind, weights, seed):
    core.select_isa(isa)
    image, target = make_pair(*size, channels, kind, torch.Generator().manual_seed(seed))
    exact = photometric_results(reference_losses, image.double(), target.double(), weights)
    rounded = photometric_results(reference_losses, image, target, weights)
    native = photometric_results(losses, image, target, weights)
    relative = (2e-5, 2e-5, 2e-5, 1e-4, 2e-5)
    floors = (5e-7, 0.0, 5e-7, 0.0, 5e-7)  # an SSIM near 0 is the difference of two numbers near 1
    for ours, float32_twin, truth, share, floor in zip(native, rounded, exact, relative, floors, strict=True):
        # Flat bright pictures lose digits in E[x^2] - E[x]^2 whatever the code: allow 4 times what it costs the twin.
        allowed = max(share * truth.abs().max(), 4 * (float32_twin - truth).abs().max(), floor)
        assert torch.isfinite(ours).all()
        assert (ours - truth).abs().max() <= allowed


def photometric_results(module, image, target, weights) -> list[torch.Tensor]:
    """Total, l1, dssim, gradient of three times the total, SSIM map."""
    leaf = image.clone().requires_grad_()
    loss = module.photometric_loss(leaf, target, *weights)
    (3 * loss.total).backward()
    assert leaf.grad is not None
    values = [
        loss.total.detach(),
        torch.tensor(loss.l1),
        torch.tensor(loss.dssim),
        leaf.grad,
        module.ssim_map(image, target),
    ]
    return [value.double() for value in values]


def test_photometric_twin_passes_gradcheck():
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(2, 4, 13, generator=generator, dtype=torch.float64, requires_grad=True)
    target = torch.rand(2, 4, 13, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: reference_losses.photometric_loss(x, target, 0.7, 0.4).total, image)


@pytest.mark.parametrize("isa", ISAS)
def test_equal_images_have_no_loss_and_no_gradient(isa):
    core.select_isa(isa)
    image = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(2), requires_grad=True)
    loss = losses.photometric_loss(image, image.detach().clone())
    loss.total.backward()
    assert (float(loss.total.detach()), loss.l1, loss.dssim) == (0.0, 0.0, 0.0)
    assert image.grad is not None
    assert image.grad.abs().max() == 0


def test_ssim_agrees_with_scikit_image_inside():
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(40, 60, generator=generator)
    target = (image + 0.2 * torch.randn(40, 60, generator=generator)).clamp(0, 1)
    expected = structural_similarity(
        image.double().numpy(), target.double().numpy(), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, full=True,
    )[1]  # fmt: skip
    ours = losses.ssim_map(image[None], target[None])[0]
    assert (ours[5:-5, 5:-5] - torch.from_numpy(expected)[5:-5, 5:-5]).abs().max() < 1e-5  # the padding differs outside
    assert float(losses.ssim(image[None], target[None])) == pytest.approx(float(ours.mean()), abs=1e-6)


def test_without_dssim_it_is_l1_and_never_ssim(monkeypatch):
    monkeypatch.setattr(reference_losses, "ssim_map", None)
    image = torch.rand(3, 9, 21, generator=torch.Generator().manual_seed(4))
    target = torch.zeros_like(image)
    assert reference_losses.photometric_loss(image, target, 0.5, 0.0).dssim == 0.0
    loss = losses.photometric_loss(image, target, 0.5, 0.0)
    assert loss.dssim == 0.0
    assert float(loss.total) == pytest.approx(0.5 * float(image.mean()), rel=1e-6)


def test_a_non_finite_pixel_shows_in_the_loss():
    image = torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(5))
    image[1, 4, 7] = math.nan
    loss = losses.photometric_loss(image, torch.zeros_like(image))
    assert not math.isfinite(loss.l1)
    assert not math.isfinite(loss.dssim)


# ---- normal consistency ------------------------------------------------------------------------------------


@pytest.mark.parametrize("isa", ISAS)
@quick
@given(
    size=st.sampled_from(SIZES),
    empty=st.sampled_from([0.0, 0.2, 1.0]),
    scale=st.sampled_from([1.0, 1e-6, 1e6]),
    override=st.booleans(),
    inverse_depth_weight=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_normal_consistency_equals_its_twin(isa, size, empty, scale, override, inverse_depth_weight, seed):
    core.select_isa(isa)
    generator = torch.Generator().manual_seed(seed)
    camera = make_camera(*size, generator)
    normal, depth, alpha = make_view(*size, generator, empty)
    inputs = (normal, scale * depth, alpha, scale * (2 + torch.rand(*size, generator=generator)))

    def run(module, dtype, weighted: bool):
        values = leaves(inputs, dtype)
        surface = values[3] if override else None
        loss = module.normal_consistency_loss(
            *values[:3], camera, inverse_depth_weight=weighted, depth_override=surface
        )
        (2 * loss).backward()
        assert (values[2].grad is None) == override  # alpha counts as the divisor of the depth only
        return loss.detach(), [values[i] for i in ([0, 3] if override else [0, 1, 2])]

    native, ours = run(losses, torch.float32, inverse_depth_weight)
    twin, exact = run(reference_losses, torch.float64, inverse_depth_weight)
    assert float(native) == pytest.approx(float(twin), rel=1e-5, abs=1e-6)
    # A weight that is 0 for the twin is round-off here: measured on the gradient it would have had with weight 1.
    plain = run(reference_losses, torch.float64, False)[1]
    floors = [1e-6 * float(value.grad.abs().max()) + 1e-12 * max(1, 1 / scale) for value in plain]
    assert_gradients_close(ours, exact, 5e-5, floors)


def test_normal_twins_pass_gradcheck():
    generator = torch.Generator().manual_seed(6)
    camera = make_camera(5, 6, generator)
    normal, depth, alpha = leaves(make_view(5, 6, generator, 0.0), torch.float64)  # empty pixels jump
    twin = reference_losses.normal_consistency_loss
    assert torch.autograd.gradcheck(lambda n, d: twin(n, d, alpha.detach(), camera), (normal, depth))
    # alpha as a divisor: only this part of it is differentiated, so it is given to the two places separately
    fixed, multiplier = normal.detach(), alpha.detach().clone()

    def by_divisor(a):
        unit = reference_losses.depth_normals(losses.surface_depth(depth.detach(), a), camera)
        return (1 - (fixed * multiplier * unit).sum(dim=0)).mean()

    assert torch.autograd.gradcheck(by_divisor, alpha)
    (expected,) = torch.autograd.grad(by_divisor(alpha), alpha)
    (actual,) = torch.autograd.grad(twin(fixed, depth.detach(), alpha, camera), alpha)
    torch.testing.assert_close(actual, expected)
    mono = torch.nn.functional.normalize(torch.randn(3, 5, 6, generator=generator, dtype=torch.float64), dim=0)
    for form in ("cosine", "envgs"):
        loss = partial(reference_losses.mono_normal_loss, mono_normal=mono, camera=camera, form=form)
        assert torch.autograd.gradcheck(loss, normal)


def plane_view(height: int, width: int) -> tuple[Camera, torch.Tensor, torch.Tensor]:
    """A camera, the z-depth (H, W) float64 of a tilted plane, and the plane's world normal facing the camera."""
    camera = make_camera(height, width, torch.Generator().manual_seed(7))
    local = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64), dim=0)
    depth = -2.5 / (camera.camera_rays(torch.float64) @ local)
    return camera, depth, camera.rotation.T @ local


@pytest.mark.parametrize("isa", ISAS)
def test_a_plane_has_its_own_normal_and_no_loss_inside(isa):
    core.select_isa(isa)
    camera, depth, normal = plane_view(20, 37)
    for normals_of in (depth_normals, reference_losses.depth_normals):
        found = normals_of(depth, camera)
        assert (found - normal[:, None, None])[:, 1:-1, 1:-1].abs().max() < 1e-9
        assert found[:, 0].abs().max() == 0
        assert found[:, :, -1].abs().max() == 0
    border = 20 * 37 - 18 * 35  # zero depth normal there: each pixel adds 1
    alpha = torch.full((20, 37), 0.5)
    view = (normal.float()[:, None, None] * 2 * torch.ones(3, 20, 37), depth.float() * alpha, alpha)
    loss = losses.normal_consistency_loss(*view, camera)
    assert float(loss) * 20 * 37 == pytest.approx(border, abs=1e-3)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("empty", ["alpha", "depth"])
def test_no_surface_gives_a_constant_and_zero_gradients(isa, empty):
    core.select_isa(isa)
    camera = make_camera(9, 20, torch.Generator().manual_seed(8))
    normal, depth, alpha = leaves(make_view(9, 20, torch.Generator().manual_seed(8), 0.0))
    with torch.no_grad():
        {"alpha": alpha, "depth": depth}[empty].zero_()
    loss = losses.normal_consistency_loss(normal, depth, alpha, camera, inverse_depth_weight=True)
    loss.backward()
    assert float(loss.detach()) == 1.0
    for value in (normal, depth, alpha):
        assert value.grad is not None
        assert value.grad.abs().max() == 0


def test_inverse_depth_weights_fall_from_near_to_far():
    depth = torch.linspace(1, 101, 200 * 200).view(200, 200)
    weights = losses.inverse_depth_weights(depth, torch.ones_like(depth))
    torch.testing.assert_close(weights, (1 - (depth - 2) / 98).clamp(0, 1), atol=0.01, rtol=0)  # a grid of samples
    assert (losses.inverse_depth_weights(torch.full((4, 5), 3.0)) == 1).all()
    depth, alpha = make_view(90, 150, torch.Generator().manual_seed(12), 0.3)[1:]
    twin = reference_losses.inverse_depth_weights(depth.double(), alpha.double())
    torch.testing.assert_close(losses.inverse_depth_weights(depth, alpha).double(), twin, atol=1e-5, rtol=0)


def test_surface_depth_mixes_expected_and_median():
    depth, alpha = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.0]])
    median = torch.tensor([[4.0, 0.0]])
    assert losses.surface_depth(depth, alpha).tolist() == [[2.0, 0.0]]
    assert losses.surface_depth(depth, alpha, median, 0.25).tolist() == [[2.5, 0.0]]
    assert losses.surface_depth(depth, alpha, median, 1.0).tolist() == [[4.0, 0.0]]
    with pytest.raises(ValueError, match="median"):
        losses.surface_depth(depth, alpha, None, 0.5)


# ---- monocular normals -------------------------------------------------------------------------------------


@pytest.mark.parametrize("isa", ISAS)
@quick
@given(
    size=st.sampled_from(SIZES),
    form=st.sampled_from(["cosine", "envgs"]),
    weighted=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_mono_normal_loss_equals_its_twin(isa, size, form, weighted, seed):
    core.select_isa(isa)
    generator = torch.Generator().manual_seed(seed)
    camera = make_camera(*size, generator)
    normal = make_view(*size, generator, 0.2)[0]
    mono = torch.nn.functional.normalize(torch.randn(3, *size, generator=generator), dim=0)
    mono[:, torch.rand(*size, generator=generator) < 0.3] = 0
    weight = torch.rand(*size, generator=generator) if weighted else None
    (ours,), (exact,) = leaves([normal]), leaves([normal], torch.float64)
    native = losses.mono_normal_loss(ours, mono, camera, form=form, weight=weight)
    twin = reference_losses.mono_normal_loss(
        exact, mono.double(), camera, form=form, weight=weight.double() if weighted else None
    )
    assert float(native.detach()) == pytest.approx(float(twin.detach()), rel=1e-5, abs=1e-6)
    native.backward()
    twin.backward()
    assert_gradients_close([ours], [exact], 1e-5, [1e-12])


def test_mono_normals_are_read_in_the_camera_frame():
    camera, _, normal = plane_view(6, 8)
    world = normal.float()[:, None, None].expand(3, 6, 8)
    local = (camera.rotation @ normal).float()[:, None, None].expand(3, 6, 8)
    assert local[2].max() < 0  # z forward: what faces the camera points backward
    for form in ("cosine", "envgs"):
        assert float(losses.mono_normal_loss(0.3 * world, local, camera, form=form)) == pytest.approx(0, abs=1e-6)
    assert float(losses.mono_normal_loss(world, -local, camera)) == pytest.approx(2, abs=1e-6)


def test_distortion_loss_is_the_mean():
    assert float(losses.distortion_loss(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))) == 3.0


# ---- all of them -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("isa", ISAS)
def test_results_do_not_depend_on_the_number_of_threads(isa):
    core.select_isa(isa)
    generator = torch.Generator().manual_seed(9)
    camera = make_camera(133, 61, generator)
    image, target = make_pair(133, 61, 3, "random", generator)
    view = make_view(133, 61, generator, 0.1)
    mono = torch.nn.functional.normalize(torch.randn(3, 133, 61, generator=generator), dim=0)

    def run(threads: int) -> list[torch.Tensor]:
        torch.set_num_threads(threads)
        values = leaves((image, *view))
        terms = [
            losses.photometric_loss(values[0], target).total,
            losses.normal_consistency_loss(*values[1:], camera, inverse_depth_weight=True),
            losses.mono_normal_loss(values[1], mono, camera, form="envgs"),
        ]
        torch.stack(terms).sum().backward()
        pictures = [losses.photometric_loss(image, target).total, losses.ssim_map(image, target)]
        return [*(term.detach() for term in terms), *pictures, *(value.grad for value in values)]

    alone = run(1)
    for threads in (2, 3, 7):
        for one, many in zip(alone, run(threads), strict=True):
            assert torch.equal(one, many)
    assert torch.equal(alone[0], alone[3])


def test_non_contiguous_pictures_are_taken():
    generator = torch.Generator().manual_seed(10)
    image, target = make_pair(12, 14, 3, "random", generator)
    turned = image.permute(1, 2, 0).contiguous().permute(2, 0, 1).requires_grad_()
    loss = losses.photometric_loss(turned, target).total
    loss.backward()
    assert torch.equal(loss.detach(), losses.photometric_loss(image, target).total)
    assert turned.grad is not None
    assert turned.grad.shape == image.shape


def test_wrong_inputs_are_named():
    camera = make_camera(4, 6, torch.Generator().manual_seed(11))
    image, flat = torch.rand(3, 4, 6), torch.rand(4, 6)
    for call, message in [
        (lambda: losses.photometric_loss(image, torch.rand(3, 6, 4)), r"target .*\(3, 4, 6\).*\(3, 6, 4\)"),
        (lambda: losses.photometric_loss(flat, flat), r"\(C, H, W\)"),
        (lambda: losses.photometric_loss(image[:, :0], image[:, :0]), "at least one pixel"),
        (lambda: losses.photometric_loss(image.double(), image.double()), "reference_losses"),
        (lambda: losses.photometric_loss(image, image.clone().requires_grad_()), "detach"),
        (lambda: losses.normal_consistency_loss(image, flat, flat.T, camera), "alpha"),
        (lambda: losses.normal_consistency_loss(image, flat, flat, camera, depth_override=image), "depth_override"),
        (lambda: losses.mono_normal_loss(image, flat, camera), "mono_normal"),
        (lambda: losses.mono_normal_loss(image, image, camera, form="l2"), "cosine"),
        (lambda: losses.mono_normal_loss(image, image, camera, weight=image), "weight"),
        (lambda: losses.inverse_depth_weights(image), "depth"),
        (lambda: losses.inverse_depth_weights(flat, flat.T), "alpha"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
