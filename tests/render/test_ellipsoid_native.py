"""The native ellipsoid rasteriser's own promises: determinism, threads, memory reuse, rules shared with the twin."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.render.buffers import EllipsoidOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids

from .comparison import pixel_error, relative_error
from .ellipsoid_runs import ANTIALIASED, PICTURES, PLAIN, answer, ellipsoid, run, single_precision
from .native_scene import SCENE_OPTIONS, NativeScene, native_scene
from .scenes import identity_camera, join, output
from .strategies import SurfelScene, SurfelTensors
from .test_rasterize_native import assert_same_bits

OFF = (0.013, -0.021)  # world offset that keeps hand-made ellipsoids off exact pixel centres


def ellipsoid_scene(
    count: int, width: int, height: int, channels: int, seed: int = 0, size: float = 0.15
) -> NativeScene:
    flat = native_scene(count, width, height, channels, seed, size)
    generator = torch.Generator().manual_seed(seed + 1)
    third = size * torch.exp(0.7 * torch.randn(count, 1, generator=generator))
    tensors = list(flat.tensors)
    tensors[3] = torch.cat((tensors[3], third), 1)
    return replace(flat, tensors=tuple(tensors))


def everything(scene: NativeScene, options: EllipsoidOptions = ANTIALIASED) -> list[Tensor]:
    """All pictures, the weight sums and all gradients of a random upstream gradient."""
    generator = torch.Generator().manual_seed(0)
    leaves = scene.leaves()
    probe = torch.zeros(len(leaves[0]), 2, requires_grad=True)
    buffers = rasterize_ellipsoids(*leaves, scene.camera, options=options, screen_probe=probe)
    pictures = [output(buffers, name) for name in PICTURES]
    loss = torch.stack([(p * torch.randn(p.shape, generator=generator)).sum() for p in pictures]).sum()
    gradients = torch.autograd.grad(loss, [*leaves, probe])
    return [*(p.detach() for p in pictures), output(buffers, "weight_sum"), *gradients]


@pytest.mark.parametrize("size", [0.05, 0.8])
def test_bits_do_not_depend_on_the_number_of_threads(isa: str, size: float):
    scene = ellipsoid_scene(3000, 150, 101, 5, size=size)
    expected = everything(scene)
    for threads in (2, 3, 8):
        torch.set_num_threads(threads)
        assert_same_bits(expected, everything(scene))


def test_bits_do_not_depend_on_earlier_calls(isa: str):
    """Of either rasteriser: they share their memory."""
    small, large = ellipsoid_scene(50, 33, 21, 3), ellipsoid_scene(900, 90, 75, 20, seed=1, size=0.4)
    core.release_raster_memory()
    first = everything(small)
    everything(large)
    flat = native_scene(700, 70, 65, 9, seed=2)
    leaves = flat.leaves()
    flat.render(SCENE_OPTIONS, leaves).features.sum().backward()
    assert_same_bits(first, everything(small))


def test_the_order_of_rows_does_not_change_a_bit(isa: str):
    scene = ellipsoid_scene(300, 60, 45, 4)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(2))
    straight = everything(scene)
    shuffled = everything(replace(scene, tensors=tuple(t[order] for t in scene.tensors)))
    assert_same_bits(straight[:3], shuffled[:3])
    assert_same_bits([t[order] for t in straight[3:]], shuffled[3:])


def test_a_second_backward_pass_gives_the_same_bits_and_second_derivatives_are_refused():
    scene = ellipsoid_scene(60, 30, 20, 3)
    leaves = scene.leaves()
    loss = rasterize_ellipsoids(*leaves, scene.camera).features.square().sum()
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    assert_same_bits(list(first), list(torch.autograd.grad(loss, leaves, retain_graph=True)))
    (gradient,) = torch.autograd.grad(loss, leaves[0], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        (gradient.square().sum() + loss).backward()


def test_weight_sum_adds_up_to_alpha_and_is_no_part_of_the_graph(isa: str):
    scene = ellipsoid_scene(500, 70, 50, 3)
    buffers = rasterize_ellipsoids(*scene.leaves(), scene.camera, options=PLAIN)
    weight_sum = output(buffers, "weight_sum")
    assert not weight_sum.requires_grad
    torch.testing.assert_close(weight_sum.double().sum(), buffers.alpha.detach().double().sum(), rtol=1e-5, atol=0)


def test_nan_upstream_reaches_the_gradient(isa: str):
    """The trainer's guard must see it: nothing replaces it on the way."""
    scene = ellipsoid_scene(60, 30, 20, 3)
    leaves = scene.leaves()
    upstream = torch.zeros(3, 20, 30)
    upstream[0, 10, 15] = torch.nan
    rasterize_ellipsoids(*leaves, scene.camera).features.backward(upstream)
    assert leaves[0].grad is not None
    assert leaves[0].grad.isnan().any()
    leaves = scene.leaves()
    rasterize_ellipsoids(*leaves, scene.camera).features.sum().backward()  # and leaves nothing behind
    assert all(leaf.grad.isfinite().all() for leaf in leaves if leaf.grad is not None)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("index", range(6))
def test_an_ellipsoid_that_is_not_finite_changes_nothing(isa: str, bad: float, index: int):
    scene = ellipsoid_scene(61, 40, 30, 3)
    without = replace(scene, tensors=tuple(t[1:] for t in scene.tensors))
    tensors = [t.clone() for t in scene.tensors]
    tensors[index].view(61, -1)[0, -1] = bad
    found, expected = everything(replace(scene, tensors=tuple(tensors))), everything(without)
    assert_same_bits(found[:3], expected[:3])
    for a, b in zip(found[3:], expected[3:], strict=True):
        assert not a[0].any()
        assert torch.equal(a[1:], b)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (16, 16), (17, 15), (33, 2)])
def test_odd_image_sizes(isa: str, width: int, height: int):
    found = everything(ellipsoid_scene(100, width, height, 2, size=0.5))
    assert found[0].shape == (2, height, width)
    assert all(t.isfinite().all() for t in found)


def test_no_ellipsoids_give_the_background(isa: str):
    scene = ellipsoid_scene(0, 9, 7, 2)
    background = torch.tensor([0.25, -1.0])
    buffers = rasterize_ellipsoids(*scene.tensors, scene.camera, background=background, options=PLAIN)
    assert torch.equal(buffers.features, background[:, None, None].expand(2, 7, 9))
    assert not buffers.alpha.any()
    assert output(buffers, "weight_sum").shape == (0,)


VISIBLE = ellipsoid((0.05, 0.04, 3.0), opacity=0.5, features=(-2.0,))
RULES: dict[str, SurfelTensors] = {
    "round": ellipsoid((*OFF, 2.0)),
    "a point": ellipsoid((*OFF, 2.0), scales=(1e-6, 1e-6, 1e-6), opacity=0.9),
    "needle": ellipsoid((*OFF, 2.0), tangent_u=(0.6, 0.8, 0.3), scales=(9.0, 1e-6, 1e-6), opacity=0.9),
    "along the line of sight": ellipsoid((*OFF, 3.0), scales=(1e-3, 1e-3, 8.0)),
    "tangents neither unit nor orthogonal": ellipsoid((*OFF, 2.0), tangent_u=(2, 0.3, 0.5), tangent_v=(0.4, 0.7, -0.1)),
    "beyond the Jacobian's clamp": join(ellipsoid((-4.0, 0.1, 1.0), scales=(2.0, 1.0, 3.0), opacity=0.9), VISIBLE),
    "close": ellipsoid((*OFF, 0.21), scales=(0.02, 0.05, 0.3), opacity=0.7),
    "over every pixel": join(ellipsoid((*OFF, 2.0), scales=(500.0, 300.0, 900.0), opacity=0.5), VISIBLE),
    "stop rule": join(*(ellipsoid((*OFF, 1.0 + i), opacity=0.95, scales=(3, 3, 3)) for i in range(6))),
    "clamp": ellipsoid((*OFF, 2.0), opacity=1.0),
    "opacity above one": ellipsoid((*OFF, 2.0), opacity=3.0),
    "ties by row": join(ellipsoid((*OFF, 2.0), opacity=0.5), ellipsoid((*OFF, 2.0), opacity=0.5, features=(-1.0,))),
    "alpha cut": join(ellipsoid((*OFF, 2.0), opacity=2 / 255), VISIBLE),
    "below the opacity cut": join(ellipsoid((*OFF, 2.0), opacity=0.9 / 255), VISIBLE),
    "behind": join(ellipsoid((0.0, 0.0, -2.0), scales=(3, 3, 3)), VISIBLE),
    "before near": join(ellipsoid((0.0, 0.0, 0.15), scales=(3, 3, 3)), VISIBLE),
    "zero scale": join(ellipsoid((*OFF, 2.0), scales=(0.5, 0.5, 0.0)), VISIBLE),
    "nan mean": join(ellipsoid((math.nan, 0.0, 2.0)), VISIBLE),
}


@pytest.mark.parametrize("options", [PLAIN, ANTIALIASED], ids=["plain", "antialiased"])
@pytest.mark.parametrize("rule", RULES)
def test_rule(isa: str, rule: str, options: EllipsoidOptions):
    camera = identity_camera(21, 19, fx=11.0, fy=13.0, cx=8.4, cy=10.7)
    scene = SurfelScene(single_precision(RULES[rule]), camera, torch.tensor([0.3]))
    expected = answer(scene, options=options)
    assert expected.flagged.double().mean() <= 0.25
    native = run(rasterize_ellipsoids, scene, torch.float32, expected.upstream, options)
    for name in PICTURES:
        error = pixel_error(native.pictures[name], expected.exact.pictures[name])
        assert error[~expected.flagged].max() <= 1e-5, name
    for name, gradient in expected.exact.gradients.items():
        assert relative_error(native.gradients[name], gradient).max() <= 1e-4, name


def test_a_far_off_principal_point():
    """The field of view that bounds the Jacobian moves with it; the picture is the same ellipsoid elsewhere."""
    values = single_precision(join(ellipsoid((1.6, 0.4, 2.0), scales=(0.3, 0.2, 0.9), opacity=0.8), VISIBLE))
    camera = Camera(torch.eye(3), torch.zeros(3), 20.0, 20.0, -6.0, 5.0, 24, 16)
    scene = SurfelScene(values, camera, None)
    expected = answer(scene)
    native = run(rasterize_ellipsoids, scene, torch.float32, expected.upstream)
    assert expected.exact.pictures["alpha"].max() > 0.5
    assert relative_error(native.gradients["means"], expected.exact.gradients["means"]).max() <= 1e-4


BAD_OPTIONS = {
    "near=": EllipsoidOptions(near=0.0),
    "dilation=": EllipsoidOptions(dilation=0.0),
    "radius_sigmas=": EllipsoidOptions(radius_sigmas=-1.0),
}


@pytest.mark.parametrize("message", BAD_OPTIONS)
def test_wrong_options_are_named(message: str):
    scene = ellipsoid_scene(4, 8, 8, 3)
    with pytest.raises(ValueError, match=message):
        rasterize_ellipsoids(*scene.tensors, scene.camera, options=BAD_OPTIONS[message])


def test_wrong_tensors_are_named():
    scene = ellipsoid_scene(4, 8, 8, 3)
    tensors = list(scene.tensors)
    with pytest.raises(ValueError, match="scales must have shape"):
        rasterize_ellipsoids(*tensors[:3], tensors[3][:, :2], *tensors[4:], scene.camera)
    with pytest.raises(ValueError, match="means must be float32"):
        rasterize_ellipsoids(tensors[0].double(), *tensors[1:], scene.camera)
