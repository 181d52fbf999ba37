"""The native rasteriser's own promises: determinism, threads, memory reuse, checked arguments."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rtgs.native import core
from rtgs.render.buffers import RasterOptions
from rtgs.render.surfels import rasterize_surfels

from .native_scene import PICTURES, SCENE_OPTIONS, NativeScene, native_scene

ROOT = Path(__file__).parents[2]


def everything(scene: NativeScene, seed: int = 0) -> list[Tensor]:
    """All pictures, the weight sums and all gradients of a random upstream gradient."""
    generator = torch.Generator().manual_seed(seed)
    leaves = scene.leaves()
    probe = torch.zeros(len(leaves[0]), 2, requires_grad=True)
    buffers = rasterize_surfels(*leaves, scene.camera, options=SCENE_OPTIONS, screen_probe=probe)  # type: ignore[misc]
    pictures = [getattr(buffers, name) for name in PICTURES]
    loss = sum((p * torch.randn(p.shape, generator=generator)).sum() for p in pictures)
    gradients = torch.autograd.grad(loss, [*leaves, probe])  # type: ignore[arg-type]
    return [*(p.detach() for p in pictures), buffers.weight_sum, *gradients]  # type: ignore[list-item]


def assert_same_bits(a: list[Tensor], b: list[Tensor]) -> None:
    for x, y in zip(a, b, strict=True):
        assert torch.equal(x.contiguous().view(torch.int32), y.contiguous().view(torch.int32))


@pytest.mark.parametrize("size", [0.05, 0.8])
def test_bits_do_not_depend_on_the_number_of_threads(isa: str, size: float):
    scene = native_scene(count=3000, width=150, height=101, channels=5, size=size)
    expected = everything(scene)
    for threads in (2, 3, 8):
        torch.set_num_threads(threads)
        assert_same_bits(expected, everything(scene))


def test_bits_do_not_depend_on_earlier_calls(isa: str):
    small, large = native_scene(50, 33, 21, 3), native_scene(900, 90, 75, 20, seed=1, size=0.4)
    core.release_raster_memory()
    first = everything(small)
    everything(large)
    assert_same_bits(first, everything(small))


def test_two_python_threads_do_not_disturb_each_other():
    scenes = [native_scene(400 + 100 * k, 80, 60, 3 + k, seed=k) for k in range(4)]
    expected = [everything(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            for a, b in zip(expected, pool.map(everything, scenes), strict=True):
                assert_same_bits(a, b)


def test_a_second_backward_pass_gives_the_same_bits():
    scene = native_scene(200, 50, 40, 3)
    leaves = scene.leaves()
    loss = scene.render(SCENE_OPTIONS, leaves).features.square().sum()
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    assert_same_bits(list(first), list(torch.autograd.grad(loss, leaves)))


def test_second_derivatives_are_refused_not_dropped():
    scene = native_scene(60, 30, 20, 3)
    leaves = scene.leaves()
    image = scene.render(SCENE_OPTIONS, leaves).features
    (gradient,) = torch.autograd.grad(image.square().sum(), leaves[0], create_graph=True)
    assert gradient.requires_grad  # a constant would silently drop what depends on it
    with pytest.raises(RuntimeError, match="once_differentiable"):
        (gradient.square().sum() + image.sum()).backward()


def test_the_default_dtype_does_not_matter():
    scene = native_scene(60, 30, 20, 3)
    expected = everything(scene)
    torch.set_default_dtype(torch.float64)
    try:
        leaves = scene.leaves()
        buffers = scene.render(SCENE_OPTIONS, leaves)
        gradients = torch.autograd.grad(buffers.features.sum(), leaves)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(buffers.features.detach(), expected[PICTURES.index("features")])
    assert all(gradient.dtype == torch.float32 for gradient in gradients)


def test_a_render_alive_at_exit_ends_quietly():
    script = (
        "import torch\nfrom tests.render.native_scene import SCENE_OPTIONS, native_scene\n"
        "scene = native_scene(60, 30, 20, 3)\nbuffers = scene.render(SCENE_OPTIONS, scene.leaves())"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_several_renders_before_one_backward_pass():
    scene = native_scene(200, 50, 40, 3)
    leaves = scene.leaves()
    single = torch.autograd.grad(scene.render(SCENE_OPTIONS, leaves).features.sum(), leaves)
    double = torch.autograd.grad(sum(scene.render(SCENE_OPTIONS, leaves).features.sum() for _ in range(2)), leaves)
    for a, b in zip(single, double, strict=True):
        torch.testing.assert_close(2 * a, b)


def test_only_wanted_gradients_are_made():
    scene = native_scene(60, 30, 20, 3)
    leaves = list(scene.tensors)
    leaves[5] = leaves[5].clone().requires_grad_()
    scene.render(SCENE_OPTIONS, leaves).features.sum().backward()
    assert leaves[5].grad is not None
    assert all(leaf.grad is None for leaf in leaves[:5])


def test_no_gradient_is_tracked_without_leaves():
    buffers = native_scene(60, 30, 20, 3).render(SCENE_OPTIONS)
    assert not buffers.features.requires_grad
    assert buffers.weight_sum is not None


def test_the_weight_sum_is_no_part_of_the_graph():
    scene = native_scene(60, 30, 20, 3)
    weight_sum = scene.render(SCENE_OPTIONS, scene.leaves()).weight_sum
    assert weight_sum is not None
    assert not weight_sum.requires_grad


def test_weight_sum_adds_up_to_alpha(isa: str):
    buffers = native_scene(500, 70, 50, 3).render(SCENE_OPTIONS)
    assert buffers.weight_sum is not None
    torch.testing.assert_close(buffers.weight_sum.double().sum(), buffers.alpha.double().sum(), rtol=1e-5, atol=0)


def test_nan_upstream_reaches_the_gradient(isa: str):
    """The trainer's guard must see it: nothing replaces it on the way."""
    scene = native_scene(60, 30, 20, 3)
    leaves = scene.leaves()
    upstream = torch.zeros(3, 20, 30)
    upstream[0, 10, 15] = torch.nan
    scene.render(SCENE_OPTIONS, leaves).features.backward(upstream)
    assert leaves[0].grad is not None
    assert leaves[0].grad.isnan().any()
    leaves = scene.leaves()
    scene.render(SCENE_OPTIONS, leaves).features.sum().backward()  # and leaves nothing behind
    assert all(leaf.grad.isfinite().all() for leaf in leaves if leaf.grad is not None)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("index", range(6))
def test_a_surfel_that_is_not_finite_changes_nothing(isa: str, bad: float, index: int):
    scene = native_scene(61, 40, 30, 3)
    without = NativeScene(tuple(t[1:] for t in scene.tensors), scene.camera)
    tensors = [t.clone() for t in scene.tensors]
    tensors[index].view(61, -1)[0, 0] = bad
    found = everything(NativeScene(tuple(tensors), scene.camera))
    expected = everything(without)
    for a, b in zip(found[: len(PICTURES)], expected, strict=False):
        assert torch.equal(a, b)
    for a, b in zip(found[len(PICTURES) :], expected[len(PICTURES) :], strict=True):
        assert not a[0].any()
        assert torch.equal(a[1:], b)


def test_surfels_over_every_tile(isa: str):
    scene = native_scene(40, 200, 140, 3, size=30.0)
    found = everything(scene)
    assert found[1].min() > 0.5
    assert all(t.isfinite().all() for t in found)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (16, 16), (17, 15), (33, 2)])
def test_odd_image_sizes(isa: str, width: int, height: int):
    scene = native_scene(100, width, height, 2, size=0.5)
    found = everything(scene)
    assert found[0].shape == (2, height, width)
    assert all(t.isfinite().all() for t in found)
    torch.testing.assert_close(found[6].sum(), found[1].sum(), rtol=1e-4, atol=1e-5)


def test_strided_inputs_and_upstream():
    scene = native_scene(80, 40, 30, 4)
    wide = [torch.stack((t, t), -1)[..., 0] for t in scene.tensors]
    assert not wide[0].is_contiguous()
    leaves = scene.leaves()
    expected = torch.autograd.grad(scene.render(SCENE_OPTIONS, leaves).features.permute(1, 2, 0).sum(), leaves)
    strided = [t.detach().requires_grad_() for t in wide]
    found = torch.autograd.grad(scene.render(SCENE_OPTIONS, strided).features.permute(1, 2, 0).sum(), strided)
    assert_same_bits(list(expected), list(found))


BROKEN = {
    "means must have shape": (0, lambda t: t[:, :2]),
    "tangent_u must have shape": (1, lambda t: t[1:]),
    "scales must have shape": (3, lambda t: t[:, :1]),
    "opacities must have shape": (4, lambda t: t[:, None]),
    "features must be": (5, lambda t: t[:, :0]),
    "tangent_v must be float32": (2, lambda t: t.double()),
}


@pytest.mark.parametrize("message", BROKEN)
def test_wrong_tensors_are_named(message: str):
    index, change = BROKEN[message]
    scene = native_scene(10, 20, 20, 3)
    tensors = list(scene.tensors)
    tensors[index] = change(tensors[index])
    with pytest.raises(ValueError, match=message):
        rasterize_surfels(*tensors, scene.camera)


def test_wrong_options_are_named():
    scene = native_scene(10, 20, 20, 3)
    with pytest.raises(ValueError, match=r"near=2\.0 and far=1\.0"):
        scene.render(RasterOptions(near=2.0, far=1.0))
    with pytest.raises(ValueError, match=r"alpha_cutoff=1.5 must be above 0"):
        scene.render(RasterOptions(alpha_cutoff=1.5))
    with pytest.raises(ValueError, match=r"transmittance_cutoff=0.0 must be above 0"):
        scene.render(RasterOptions(transmittance_cutoff=0.0))
    with pytest.raises(ValueError, match="background must have shape"):
        rasterize_surfels(*scene.tensors, scene.camera, background=torch.zeros(4))
    with pytest.raises(ValueError, match="screen_probe must have shape"):
        rasterize_surfels(*scene.tensors, scene.camera, screen_probe=torch.zeros(10, 3))
    with pytest.raises(ValueError, match="sides above"):
        NativeScene(scene.tensors, replace(scene.camera, width=1 << 19)).render(RasterOptions())
