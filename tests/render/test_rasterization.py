"""The functions with gsplat's arguments: the same pictures as the model's own renderer, closed forms, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

import rtgs
from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import Surfels
from rtgs.render.rasterization import rasterization, rasterization_2dgs

from .comparison import relative_error

WIDTH, HEIGHT = 41, 30


def cameras(count: int = 2) -> list[Camera]:
    found = []
    for index in range(count):
        angle = 0.2 * index
        turn = torch.tensor(
            [
                [math.cos(angle), 0, -math.sin(angle)],
                [0, 1, 0],
                [math.sin(angle), 0, math.cos(angle)],
            ]
        )
        found.append(Camera(turn, torch.tensor([0.1 * index, -0.05, 0.3]), 40.0, 44.0, 21.0, 14.5, WIDTH, HEIGHT))
    return found


def matrices(every: list[Camera]) -> tuple[Tensor, Tensor]:
    """(C, 4, 4) and (C, 3, 3), as gsplat takes them."""
    views, lenses = torch.eye(4).repeat(len(every), 1, 1), torch.zeros(len(every), 3, 3)
    for view, lens, camera in zip(views, lenses, every, strict=True):
        view[:3, :3], view[:3, 3] = camera.rotation, camera.translation
        lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], lens[2, 2] = camera.fx, camera.fy, camera.cx, camera.cy, 1
    return views, lenses


def model(kind: type[Ellipsoids] | type[Surfels], count: int = 60) -> Ellipsoids | Surfels:
    generator = torch.Generator().manual_seed(4)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    means = torch.cat((0.7 * normal(2), 0.4 * normal(1) + 2.5), dim=1)
    axes = 3 if kind is Ellipsoids else 2
    shape = {"means": means, "log_scales": 0.4 * normal(axes) - 2.2, "quaternions": normal(4)}
    return kind(**shape, opacity_logits=normal(), sh_dc=normal(3), sh_rest=0.3 * normal(15, 3))


def given(gaussians: Ellipsoids | Surfels) -> tuple[Tensor, ...]:
    """The tensors of the model as gsplat takes them."""
    coefficients = torch.cat((gaussians.sh_dc[:, None], gaussians.sh_rest), dim=1)
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales.exp(), gaussians.opacity_logits.sigmoid())
    return (*shape, coefficients)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_ellipsoids_are_those_of_the_models_own_renderer(mode: str):
    gaussians, every = model(Ellipsoids), cameras()
    images, alphas, meta = rasterization(
        *given(gaussians), *matrices(every), WIDTH, HEIGHT, sh_degree=2, near_plane=0.2, rasterize_mode=mode
    )
    assert images.shape == (2, HEIGHT, WIDTH, 3)
    assert alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert meta == {"width": WIDTH, "height": HEIGHT, "n_cameras": 2}
    for image, camera in zip(images, every, strict=True):
        own = rtgs.render_splats(gaussians, camera, sh_degree=2, antialiased=mode == "antialiased")
        assert float(own.std()) > 0.1
        assert relative_error(image.permute(2, 0, 1), own).max() < 1e-5


def test_surfels_are_those_of_the_models_own_renderer():
    gaussians, every = model(Surfels), cameras()
    images, alphas, normals, surface, distortion, medians, _ = rasterization_2dgs(
        *given(gaussians), *matrices(every), WIDTH, HEIGHT, sh_degree=3, near_plane=0.2
    )
    for image, camera in zip(images, every, strict=True):
        assert relative_error(image.permute(2, 0, 1), rtgs.render_splats(gaussians, camera)).max() < 1e-5
    assert normals.shape == surface.shape == (2, HEIGHT, WIDTH, 3)
    assert distortion.shape == medians.shape == alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert float(distortion.min()) >= 0


def test_a_large_disc_has_its_own_normal_twice_and_its_depth():
    """A disc across the view of half a metre to the side of nothing: both normals are that of its plane."""
    view, lens = matrices(cameras(1))
    means = torch.tensor([[0.0, 0.0, 2.0]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[50.0, 50.0]])
    found = rasterization_2dgs(
        means, quats, scales, torch.tensor([0.9]), torch.ones(1, 1), view, lens, WIDTH, HEIGHT, render_mode="RGB+ED"
    )
    image, alphas, normals, surface, _, medians, _ = (each for each in found)
    inner = (0, slice(1, -1), slice(1, -1))
    torch.testing.assert_close(image[..., 1], torch.full_like(image[..., 1], 2.3), rtol=1e-5, atol=0)
    torch.testing.assert_close(medians, torch.full_like(medians, 2.3), rtol=1e-5, atol=0)
    torch.testing.assert_close(image[..., :1], alphas)
    expected = alphas[inner] * torch.tensor([0.0, 0.0, -1.0])
    torch.testing.assert_close(normals[inner], expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(surface[inner], expected, rtol=0, atol=1e-4)


def test_one_round_ellipsoid_is_a_gaussian_of_the_projected_width():
    """In the centre of the picture: variance (f s / z)^2 + eps2d."""
    view, lens = torch.eye(4)[None], torch.tensor([[[50.0, 0, 20.5], [0, 50.0, 15.5], [0, 0, 1]]])
    one = (torch.tensor([[0.0, 0, 4]]), torch.tensor([[2.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.8]))
    image, alphas, _ = rasterization(*one, torch.tensor([[0.5, 1.0]]), view, lens, WIDTH, HEIGHT, eps2d=0.5)
    x = torch.arange(WIDTH) + 0.5 - 20.5
    expected = 0.8 * torch.exp(-0.5 * x**2 / (2.5**2 + 0.5))
    row = alphas[0, 15, :, 0]
    kept = expected > 1 / 255
    torch.testing.assert_close(row[kept], expected[kept], rtol=1e-5, atol=1e-6)
    assert float(row[~kept].abs().max()) == 0
    torch.testing.assert_close(image[0, 15], row[:, None] * torch.tensor([0.5, 1.0]))


def test_depth_modes_agree_with_each_other():
    gaussians, every = model(Ellipsoids), matrices(cameras())
    shown = {
        mode: rasterization(*given(gaussians), *every, WIDTH, HEIGHT, sh_degree=0, render_mode=mode)[0]
        for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")
    }
    alphas = rasterization(*given(gaussians), *every, WIDTH, HEIGHT, sh_degree=0)[1]
    assert torch.equal(shown["RGB+D"], torch.cat((shown["RGB"], shown["D"]), dim=-1))
    assert torch.equal(shown["RGB+ED"], torch.cat((shown["RGB"], shown["ED"]), dim=-1))
    torch.testing.assert_close(shown["ED"] * alphas, shown["D"])
    covered = alphas > 0.01
    depths = shown["ED"][covered]
    assert 0.5 < float(depths.min()) < float(depths.max()) < 6


def test_colours_of_their_own_for_each_camera_and_backgrounds():
    gaussians, every = model(Ellipsoids), matrices(cameras())
    *shape, _ = given(gaussians)
    colors = torch.rand(2, len(gaussians), 5, generator=torch.Generator().manual_seed(0))
    behind = torch.rand(2, 5, generator=torch.Generator().manual_seed(1))
    both, alphas, _ = rasterization(*shape, colors, *every, WIDTH, HEIGHT, backgrounds=behind)
    for index in range(2):
        one, _, _ = rasterization(*shape, colors[index], *(each[index : index + 1] for each in every), WIDTH, HEIGHT)
        expected = one[0] + (1 - alphas[index]) * behind[index]
        torch.testing.assert_close(both[index], expected, rtol=1e-5, atol=1e-6)


def test_what_is_beyond_the_far_plane_is_left_out():
    gaussians, every = model(Ellipsoids), matrices(cameras(1))
    *shape, colors = given(gaussians)
    depth = gaussians.means @ every[0][0, :3, :3].T + every[0][0, :3, 3]
    near = depth[:, 2] < 2.7
    assert 0 < int(near.sum()) < len(near)
    cut, _, _ = rasterization(*shape, colors, *every, WIDTH, HEIGHT, sh_degree=1, far_plane=2.7)
    kept, _, _ = rasterization(*(each[near] for each in shape), colors[near], *every, WIDTH, HEIGHT, sh_degree=1)
    assert torch.equal(cut, kept)


@pytest.mark.parametrize("kind", [Ellipsoids, Surfels])
def test_what_is_before_the_near_plane_is_left_out(kind):
    gaussians, every = model(kind), matrices(cameras(1))
    *shape, colors = given(gaussians)
    depth = gaussians.means @ every[0][0, :3, :3].T + every[0][0, :3, 3]
    beyond = depth[:, 2] > 2.7
    assert 0 < int(beyond.sum()) < len(beyond)
    render = rasterization if kind is Ellipsoids else rasterization_2dgs
    cut = render(*shape, colors, *every, WIDTH, HEIGHT, sh_degree=1, near_plane=2.7)[0]
    kept = render(*(each[beyond] for each in shape), colors[beyond], *every, WIDTH, HEIGHT, sh_degree=1, near_plane=2.7)
    assert torch.equal(cut, kept[0])
    whole = render(*shape, colors, *every, WIDTH, HEIGHT, sh_degree=1)[0]
    assert float((whole - cut).abs().max()) > 0.1


@pytest.mark.parametrize("kind", [Ellipsoids, Surfels])
def test_gradients_are_those_of_the_models_own_renderer(kind):
    """By its raw parameters: what is given here is what they are activated to."""
    gaussians, (camera, *_) = model(kind), cameras(1)
    upstream = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2))
    raw = gaussians.requires_grad_()
    rows = rtgs.activate_gaussians(raw, camera.center.float(), 3)
    parts = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities, rows.colors, camera)
    if kind is Ellipsoids:
        own = rtgs.rasterize_ellipsoids(*parts, options=rtgs.EllipsoidOptions(near=0.2))
    else:
        own = rtgs.rasterize_surfels(*parts, options=rtgs.RasterOptions(near=0.2))
    (upstream * own.features).sum().backward()

    leaves = [each.detach().clone().requires_grad_() for each in given(gaussians)]
    render = rasterization if kind is Ellipsoids else rasterization_2dgs
    found = render(*leaves, *matrices([camera]), WIDTH, HEIGHT, sh_degree=3, near_plane=0.2)
    (upstream * found[0][0].permute(2, 0, 1)).sum().backward()
    means, quats, scales, opacities, colors = (each.grad for each in leaves)
    opacity = leaves[3].detach()
    for name, mine, theirs in (
        ("means", means, raw.means.grad),
        ("quats", quats, raw.quaternions.grad),
        ("scales", scales * leaves[2].detach(), raw.log_scales.grad),
        ("opacities", opacities * opacity * (1 - opacity), raw.opacity_logits.grad),
        ("dc", colors[:, 0], raw.sh_dc.grad),
        ("rest", colors[:, 1:], raw.sh_rest.grad),
    ):
        assert float(theirs.abs().max()) > 0, name
        assert relative_error(mine, theirs).max() < 1e-4, name


def refused(match: str, function=rasterization, **changes: object) -> None:
    views, lenses = matrices(cameras())
    *shape, colors = given(model(Ellipsoids, 5))
    names = ("means", "quats", "scales", "opacities")
    words = dict(zip(names, shape, strict=True), colors=colors, viewmats=views, Ks=lenses, width=WIDTH, height=HEIGHT)
    words |= {"sh_degree": 1} | changes
    with pytest.raises(ValueError, match=match):
        function(**words)


def test_what_does_not_fit_is_refused_by_name():
    refused(r"quats must be \(5, 4\), got \(5, 3\)", quats=torch.zeros(5, 3))
    refused(r"scales must be \(5, 3\), got \(5, 1\)", scales=torch.ones(5, 1))
    refused(r"Ks must be \(2, 3, 3\), got \(1, 3, 3\)", Ks=torch.eye(3)[None])
    refused(r"viewmats\[0\] holds no rotation", viewmats=2 * torch.eye(4).repeat(2, 1, 1))
    refused(
        r"Ks\[1\] has skew 0.5",
        Ks=torch.stack([torch.eye(3), torch.eye(3).index_put_((torch.tensor(0), torch.tensor(1)), torch.tensor(0.5))]),
    )
    refused(r"render_mode='XYZ' is none of 'RGB', 'D'", render_mode="XYZ")
    refused(r"rasterize_mode='mip' is none of", rasterize_mode="mip")
    refused(r"sh_degree=4 must be 0 to 3", sh_degree=4)
    refused(r"colors is for 3 cameras, viewmats has 2", colors=torch.zeros(3, 5, 4, 3))
    refused(r"colors must be \(N, K, 3\) or .* got \(5, 3\)", colors=torch.zeros(5, 3))
    refused(r"backgrounds must be \(2, 3\), got \(3,\)", backgrounds=torch.zeros(3))
    refused(r"viewmats holds no camera", viewmats=torch.zeros(0, 4, 4), Ks=torch.zeros(0, 3, 3))
    refused(r"render_mode='depth' is none of", rasterization_2dgs, render_mode="depth")


@pytest.mark.parametrize("function", [rasterization, rasterization_2dgs])
def test_what_would_be_rendered_wrongly_is_refused_by_name(function) -> None:
    views, _ = matrices(cameras())
    mirrored = views @ torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])).to(views)
    refused(r"viewmats\[0\] mirrors", function, viewmats=mirrored)
    _, lenses = matrices(cameras())
    doubled, skewed, bottom = 2 * lenses, lenses.clone(), views.clone()
    skewed[:, 1, 0] = 3.0
    bottom[:, 3, 3] = 2.0
    refused(r"Ks\[0\] has the last row \[0.0, 0.0, 2.0\]", function, Ks=doubled)
    refused(r"Ks\[0\] has skew 3.0", function, Ks=skewed)
    refused(r"viewmats\[0\] has the bottom row", function, viewmats=bottom)
    refused(r"width=32\.0 must be a whole number", function, width=32.0)
    refused(r"height=0 must be", function, height=0)
    refused(r"width=True must be", function, width=True)
    refused(r"near_plane=2 must be less than far_plane=1", function, near_plane=2, far_plane=1)
    refused(r"near_plane=nan must be", function, near_plane=float("nan"))
    few = torch.zeros(5, 9, 3)
    refused(r"colors must be \(N, K, 3\) with K at least 16 for sh_degree=3", function, sh_degree=3, colors=few)
    refused(r"colors must be .* at least 1 for sh_degree=0", function, sh_degree=0, colors=torch.zeros(5, 0, 3))
    refused(r"colors must be .*got \(5, 4, 2\)", function, colors=torch.zeros(5, 4, 2))


def test_a_size_may_be_a_number_of_numpy() -> None:
    views, lenses = matrices(cameras())
    words = {"sh_degree": 1, "width": np.int64(WIDTH), "height": HEIGHT}
    image, _, _ = rasterization(*given(model(Ellipsoids, 5)), views, lenses, **words)
    assert image.shape[1:3] == (HEIGHT, WIDTH)
