"""Gradients of the rasteriser twin against finite differences in float64.

The scene avoids every discontinuity (the mask says so, and the step is far smaller than its bands): four overlapping
surfels at well separated depths that cover all pixels of a small picture well above the alpha cut; one of them is so
small that it is drawn as its disc.
"""

import math

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference.surfels import attach_probe, rasterize_surfels

from .scenes import ALL_OUTPUTS, OUTPUTS, join, output, render, surfel
from .strategies import NAMES, SurfelTensors


def smooth_camera() -> Camera:
    """Turned, off-centre, fx != fy; 4 x 3 pixels."""
    c, s = math.cos(0.3), math.sin(0.3)
    rotation = torch.tensor([[c, 0, s], [0.06, 1, 0], [-s, 0, c]], dtype=torch.float64)
    rotation = torch.linalg.qr(rotation).Q
    rotation = rotation * torch.sign(torch.diagonal(rotation))
    return Camera(rotation, torch.tensor([0.1, -0.2, 0.3]), fx=4.0, fy=5.0, cx=1.8, cy=1.7, width=4, height=3)


def smooth_scene(camera: Camera) -> SurfelTensors:
    """Camera-frame surfels brought to the world: tilted, sheared, drawn back to front."""
    local = join(
        surfel((0.3, 0.1, 5.0), tangent_u=(1, 0.1, 0.5), tangent_v=(0, 1.2, 0.3), scales=(3, 4), opacity=0.8),
        surfel((0.03, -0.05, 3.1), scales=(1e-3, 2e-3), opacity=0.7),
        surfel((-0.2, 0.2, 2.4), tangent_u=(1, 0.3, -0.4), tangent_v=(0.2, 1, 0.6), scales=(1.2, 1.5), opacity=0.5),
        surfel((0.1, 0.0, 1.5), tangent_u=(0, 1, 0.2), tangent_v=(0.9, 0, -0.5), scales=(1.1, 0.9), opacity=0.3),
    )
    features = torch.tensor([[0.3, -1.0], [1.0, 0.2], [-0.4, 0.7], [0.8, 0.5]], dtype=torch.float64)
    return SurfelTensors(
        (local.means - camera.translation) @ camera.rotation,
        local.tangent_u @ camera.rotation,
        local.tangent_v @ camera.rotation,
        *(local.scales, local.opacities, features),
    )


def projection(shape: torch.Size, seed: int = 0) -> Tensor:
    """Fixed random weights that turn a picture into a scalar."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_scene_has_no_discontinuity_and_shows_both_branches():
    camera = smooth_camera()
    values = smooth_scene(camera)
    assert not discontinuity_mask(*values.all(), camera, options=ALL_OUTPUTS).any()
    weights = output(render(values, camera), "weight_sum")
    assert (weights > 0.1).all()
    disc = render(values.rows(torch.tensor([1])), camera)
    shown = disc.alpha > 0
    assert shown.any()
    torch.testing.assert_close(output(disc, "depth")[shown], 3.1 * disc.alpha[shown])


@pytest.mark.parametrize("name", OUTPUTS)
def test_gradients_of_each_output_agree_with_finite_differences(name: str):
    camera = smooth_camera()
    background = torch.tensor([0.3, -0.6], dtype=torch.float64)

    def scalar(*tensors: Tensor) -> Tensor:
        picture = output(rasterize_surfels(*tensors, camera, background=background, options=ALL_OUTPUTS), name)
        return (picture * projection(picture.shape)).sum()

    leaves = smooth_scene(camera).leaves(torch.float64).all()
    assert torch.autograd.gradcheck(scalar, leaves, eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", OUTPUTS)
def test_each_output_depends_on_the_inputs_it_should(name: str):
    """gradcheck compares zeros happily: the gradients must be there."""
    camera = smooth_camera()
    leaves = smooth_scene(camera).leaves(torch.float64)
    picture = output(render(leaves, camera), name)
    gradients = torch.autograd.grad((picture * projection(picture.shape)).sum(), leaves.all(), allow_unused=True)
    without = {"median_depth": {"opacities"}}.get(name, set()) | ({"features"} if name != "features" else set())
    for tensor, gradient in zip(NAMES, gradients, strict=True):
        present = gradient is not None and bool(gradient.any())
        assert present is (tensor not in without), f"{name} by {tensor}"


def test_densification_signal_is_the_derivative_by_the_projected_centre():
    """Moving p_x at fixed z, axes fixed, moves M_x[2] alone; the signal is per unit of NDC = 2 m / size - 1."""
    camera = smooth_camera()
    values = smooth_scene(camera)

    def scalar(means: Tensor, probe: Tensor | None = None) -> Tensor:
        buffers = rasterize_surfels(means, *values.all()[1:], camera, options=ALL_OUTPUTS, screen_probe=probe)
        pictures = [output(buffers, name) for name in OUTPUTS]
        return torch.stack([(p * projection(p.shape, i)).sum() for i, p in enumerate(pictures)]).sum()

    probe = torch.zeros(4, 2, dtype=torch.float64, requires_grad=True)
    (signal,) = torch.autograd.grad(scalar(values.means, probe), probe)
    step = 1e-6
    for row in range(4):
        for axis, size in enumerate((camera.width, camera.height)):
            shift = torch.zeros_like(values.means)
            shift[row] = step * camera.rotation[axis]
            plus, minus = values.means + shift, values.means - shift
            moved = (camera.project(plus)[0] - camera.project(minus)[0])[row, axis] * 2 / size
            difference = (scalar(plus) - scalar(minus)) / moved
            assert signal[row, axis].item() == pytest.approx(difference.item(), rel=1e-5, abs=1e-8)


def test_the_probe_does_not_move_anything():
    camera = smooth_camera()
    local = torch.tensor([[0.1, 0.2, 3.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    probe = torch.full((2, 2), 7.0, dtype=torch.float64, requires_grad=True)
    assert torch.equal(attach_probe(local, probe, camera), local)


def test_median_gradient_goes_to_its_own_surfel_alone():
    camera = smooth_camera()
    leaves = smooth_scene(camera).leaves(torch.float64)
    median = output(render(leaves, camera), "median_depth")
    (gradient,) = torch.autograd.grad(median[1, 1], leaves.means)
    assert int(gradient.any(1).sum()) == 1
