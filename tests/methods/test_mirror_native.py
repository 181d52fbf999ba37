"""Mirror rays and their weight: native kernels against plain torch in float64, every instruction set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.methods.shading.mirror import SHORTEST_NORMAL, SentRays, SurfacePixels, mirror_rays, mirror_rays_twin
from rtgs.optics.microfacet import specular_weights
from rtgs.optics.reflection import reflection_weight
from rtgs.optics.settings import OpticsSettings

COUNTS = (0, 1, 15, 16, 33, 500)


def drawn_pixels(count: int) -> tuple[SurfacePixels, Tensor, Tensor]:
    """Surfaces seen from all sides, some without a normal; the camera rays; the camera's centre."""
    generator = torch.Generator().manual_seed(count)
    normal = torch.randn(3, count, generator=generator)
    normal *= torch.rand(count, generator=generator)
    normal[:, ::7] *= 0.3 * SHORTEST_NORMAL
    normal[:, ::13] = 0
    view = torch.randn(3, count, generator=generator)
    depth = 0.1 + 5 * torch.rand(count, generator=generator)
    other = torch.zeros(count)
    return SurfacePixels(other.expand(3, -1), other, other, other, normal, depth), view, torch.tensor([0.3, -2.0, 1.0])


def close(found: Tensor, expected: Tensor, tolerance: float) -> bool:
    scale = float(expected.abs().max()) if expected.numel() else 1.0
    return bool(((found.double() - expected).abs() <= tolerance * max(scale, 1e-12)).all())


@pytest.mark.parametrize("length", ["unit", "raw"])
@pytest.mark.parametrize("count", COUNTS)
def test_mirror_rays_and_their_gradients_are_those_of_the_twin(isa: str, count: int, length: str):
    pixels, view, center = drawn_pixels(count)
    upstream = [
        torch.randn(shape, generator=torch.Generator().manual_seed(9)) for shape in ((count, 3),) * 2 + ((count,),)
    ]
    results = []
    for dtype, function in ((torch.float32, mirror_rays), (torch.float64, mirror_rays_twin)):
        normal, depth = (m.to(dtype).clone().requires_grad_() for m in (pixels.normal, pixels.depth))
        given = SurfacePixels(*(m.to(dtype) for m in (pixels.diffuse, *[pixels.specular] * 3)), normal, depth)
        rays = function(given, center.to(dtype), view.to(dtype), length)
        outputs = (rays.origins, rays.directions, rays.cosine)
        gradients = torch.autograd.grad(outputs, (normal, depth), [g.to(dtype) for g in upstream])
        results.append((*outputs, *gradients))
    assert all(close(found.detach(), expected.detach(), 2e-6) for found, expected in zip(*results, strict=True))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("more", [0, 21])
@pytest.mark.parametrize("count", COUNTS)
def test_rays_of_some_pixels_before_others_are_those_of_the_twin(isa: str, count: int, share: float, more: int):
    pixels, view, center = drawn_pixels(count)
    generator = torch.Generator().manual_seed(5)
    own = (torch.rand(count, generator=generator) < share).nonzero()[:, 0]
    others = torch.randn(2, more, 3, generator=generator)
    upstream = [torch.randn(shape, generator=generator) for shape in ((len(own) + more, 3),) * 2 + ((count,),)]
    results = []
    for dtype, function in ((torch.float32, mirror_rays), (torch.float64, mirror_rays_twin)):
        leaves = [m.to(dtype).clone().requires_grad_() for m in (pixels.normal, pixels.depth, *others)]
        given = SurfacePixels(*(m.to(dtype) for m in (pixels.diffuse, *[pixels.specular] * 3)), *leaves[:2])
        sent = SentRays(own, (leaves[2], leaves[3]) if more else None)
        rays = function(given, center.to(dtype), view.to(dtype), "unit", sent)
        outputs = (rays.origins, rays.directions, rays.cosine)
        asked = leaves if more else leaves[:2]
        results.append((*outputs, *torch.autograd.grad(outputs, asked, [g.to(dtype) for g in upstream])))
    assert all(close(found.detach(), expected.detach(), 2e-6) for found, expected in zip(*results, strict=True))


@pytest.mark.parametrize("own", [[-1, 2], [0, 8], [3, 3], [4, 2]])
def test_pixels_that_do_not_ascend_within_the_picture_are_refused(own: list[int]):
    pixels, view, center = drawn_pixels(8)
    with pytest.raises(ValueError, match="own must ascend within the 8 pixels"):
        mirror_rays(pixels, center, view, "unit", SentRays(torch.tensor(own)))


@pytest.mark.parametrize("gain", [1.0, 16.0, 0.0])
@pytest.mark.parametrize("count", COUNTS)
def test_the_weight_and_its_gradients_are_those_of_the_twin(isa: str, count: int, gain: float):
    optics = OpticsSettings(max_gain=gain)
    generator = torch.Generator().manual_seed(count)
    cosine, roughness, f0 = torch.rand(3, count, generator=generator)
    cosine = cosine * 1.4 - 0.2  # beyond both of its bounds
    roughness[::3] *= 0.01  # and below its floor
    f0[::5] = 0
    upstream = torch.randn(count, generator=generator)

    def evaluated(function: Callable[..., Tensor], dtype: torch.dtype) -> tuple[Tensor, ...]:
        leaves = [m.to(dtype).clone().requires_grad_() for m in (cosine, roughness, f0)]
        weight = function(*leaves, optics)
        return (weight.detach(), *torch.autograd.grad(weight, leaves, upstream.to(dtype)))

    def twin(*arguments) -> Tensor:
        return specular_weights(*arguments).reflection

    native, plain = evaluated(reflection_weight, torch.float32), evaluated(twin, torch.float32)
    # The remap cancels near its floor: plain torch in float32 is as far from float64.
    for found, single, exact in zip(native, plain, evaluated(twin, torch.float64), strict=True):
        error = float((single - exact).abs().max() / exact.abs().max().clamp_min(1e-12)) if count else 0.0
        assert close(found, exact, max(1e-5, 4 * error))


@pytest.mark.parametrize(
    "optics",
    [OpticsSettings(weight="envgs"), OpticsSettings(weight="split_sum"), OpticsSettings(masking="separable")],
)
def test_other_models_are_the_plain_ones(optics: OpticsSettings):
    cosine, roughness, f0 = torch.rand(3, 20, generator=torch.Generator().manual_seed(1))
    found = reflection_weight(cosine, roughness, f0, optics)
    assert torch.equal(found, specular_weights(cosine, roughness, f0, optics).reflection)
    rgb = torch.rand(20, 3, generator=torch.Generator().manual_seed(2))
    found = reflection_weight(cosine, roughness, rgb, OpticsSettings())
    assert torch.equal(found, specular_weights(cosine, roughness, rgb, OpticsSettings()).reflection)


def test_the_cosine_can_be_cut_off_natively():
    leaves = [m.clone().requires_grad_() for m in torch.rand(3, 20, generator=torch.Generator().manual_seed(1))]
    reflection_weight(*leaves, OpticsSettings(detach_cosine=True)).sum().backward()
    assert leaves[0].grad is None
    assert leaves[1].grad is not None


@pytest.mark.parametrize("raw", [False, True])
def test_threads_change_nothing(isa, raw):
    pixels, view, center = drawn_pixels(20_001)
    numbers = torch.rand(3, 20_001, generator=torch.Generator().manual_seed(1))
    sent = SentRays((numbers[0] < 0.6).nonzero()[:, 0])
    before = torch.get_num_threads()
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        leaves = [each.clone().requires_grad_() for each in (pixels.normal, pixels.depth, *numbers)]
        given = replace(pixels, normal=leaves[0], depth=leaves[1])
        rays = mirror_rays(given, center, view, "raw" if raw else "unit", sent)
        weight = reflection_weight(*leaves[2:], OpticsSettings())
        outputs = (rays.origins, rays.directions, rays.cosine, weight)
        sum((each * each.detach().sin()).sum() for each in outputs).backward()
        found.append([*(each.detach() for each in outputs), *(leaf.grad for leaf in leaves)])
    torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, each) for one, each in zip(found[0], other, strict=True))
