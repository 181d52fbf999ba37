"""The absolute densification signal (AbsGS): what pixels pull apart does not cancel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.render.buffers import EllipsoidOptions, RasterOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids as ellipsoid_twin
from rtgs.render.reference.surfels import rasterize_surfels as surfel_twin
from rtgs.render.surfels import rasterize_surfels

from . import ellipsoid_runs, twin_runs
from .comparison import relative_error
from .scenes import ALL_OUTPUTS, identity_camera
from .strategies import Recipe, SurfelTensors, build
from .test_ellipsoid_native import ellipsoid_scene
from .test_rasterize_native import assert_same_bits

RECIPES = [Recipe("ordinary", 5, 20, 19, 13, seed, background=False) for seed in (1, 2, 3)]
ELLIPSOIDS = EllipsoidOptions(depth=True, weight_sum=True, absolute_probe=True)
SURFELS = replace(ALL_OUTPUTS, absolute_probe=True)


def alone(axes: int) -> SurfelTensors:
    """One Gaussian, tilted, some pixels wide."""
    double = torch.float64
    scales = torch.tensor([[0.5, 0.3, 0.4][:axes]], dtype=double)
    u, v = torch.tensor([[0.9, 0.1, 0.3]], dtype=double), torch.tensor([[-0.1, 0.95, 0.2]], dtype=double)
    features = torch.tensor([[0.7, -0.4]], dtype=double)
    return SurfelTensors(
        torch.tensor([[0.1, 0.05, 3.0]], dtype=double), u, v, scales, torch.tensor([0.6], dtype=double), features
    )


@pytest.mark.parametrize(("twin", "axes"), [(ellipsoid_twin, 3), (surfel_twin, 2)])
def test_it_is_the_sum_over_pixels_of_what_each_changes_by_when_the_picture_moves(twin: Callable, axes: int):
    """A moved principal point moves the whole picture: central differences of each pixel by themselves."""
    camera = identity_camera(9, 7)
    one = alone(axes)
    kind = EllipsoidOptions if axes == 3 else RasterOptions
    upstream = torch.randn(3, 7, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def pixels(x: float, y: float) -> Tensor:  # (H, W), what each adds to the loss
        found = twin(*one.all(), replace(camera, cx=camera.cx + x, cy=camera.cy + y))
        return (torch.cat((found.features, found.alpha[None])) * upstream).sum(0)

    probe = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    options = kind(absolute_probe=True)
    found = twin(*one.all(), camera, options=options, screen_probe=probe)
    loss = (torch.cat((found.features, found.alpha[None])) * upstream).sum()
    (signal,) = torch.autograd.grad(loss, probe)

    step = 1e-6
    by_x = (pixels(step, 0) - pixels(-step, 0)) / (2 * step) * (camera.width / 2)
    by_y = (pixels(0, step) - pixels(0, -step)) / (2 * step) * (camera.height / 2)
    assert signal[0].tolist() == pytest.approx([by_x.abs().sum().item(), by_y.abs().sum().item()], rel=1e-6)
    assert by_x.sum().abs() < 0.8 * by_x.abs().sum()  # so that a sum that is not absolute would not do


def all_close(actual: dict[str, Tensor], exact: dict[str, Tensor]) -> None:
    for name, gradient in exact.items():
        assert relative_error(actual[name], gradient).max() < 2e-4, name


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda r: str(r.seed))
def test_ellipsoids_agree_with_their_twin(isa: str, recipe: Recipe):
    exact = ellipsoid_runs.expected(recipe, ELLIPSOIDS)
    actual = ellipsoid_runs.run(rasterize_ellipsoids, exact.scene, torch.float32, exact.upstream, ELLIPSOIDS)
    all_close(actual.gradients, exact.exact.gradients)
    assert bool((exact.exact.gradients["screen_probe"] > 0).any())


@pytest.mark.parametrize("convolved", [False, True])
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda r: str(r.seed))
def test_surfels_agree_with_their_twin(isa: str, recipe: Recipe, convolved: bool):
    options = replace(SURFELS, convolved=convolved)
    exact = twin_runs.answer(build(recipe), recipe.seed, options)
    actual = twin_runs.run(rasterize_surfels, exact.scene, torch.float32, exact.upstream, options)
    all_close(actual.gradients, exact.exact.gradients)
    assert bool((exact.exact.gradients["screen_probe"] > 0).any())


@pytest.mark.parametrize("options", [ELLIPSOIDS, SURFELS], ids=["ellipsoids", "surfels"])
def test_only_the_signal_changes_and_never_falls_below_the_net_one(isa: str, options: EllipsoidOptions | RasterOptions):
    """Of surfels without maps of depth and normals: those move with the centre as well, which this one leaves out."""
    scene = ellipsoid_scene(300, 60, 45, 3)
    render = rasterize_ellipsoids if isinstance(options, EllipsoidOptions) else rasterize_surfels
    tensors = list(scene.tensors)
    if render is rasterize_surfels:
        tensors[3] = tensors[3][:, :2].contiguous()

    def gradients(absolute: bool, threads: int = 1) -> list[Tensor]:
        torch.set_num_threads(threads)
        leaves = [t.clone().requires_grad_() for t in tensors]
        probe = torch.zeros(300, 2, requires_grad=True)
        chosen = type(options)(absolute_probe=absolute)
        image = render(*leaves, scene.camera, options=chosen, screen_probe=probe).features  # type: ignore[arg-type]
        loss = (image * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))).sum()
        return [*torch.autograd.grad(loss, [*leaves, probe])]

    *net, net_signal = gradients(absolute=False)
    *rest, signal = gradients(absolute=True)
    assert_same_bits(net, rest)
    assert_same_bits([*rest, signal], gradients(absolute=True, threads=3))
    if render is rasterize_ellipsoids:  # of surfels the net signal has the mean's motion through the axes, too
        assert bool((signal >= net_signal.abs() * (1 - 1e-4)).all())
    assert signal.sum() > 1.5 * net_signal.abs().sum()


def test_maps_that_nothing_asks_of_do_not_change_it(isa: str):
    """The signal's place in a row of gradients depends on which maps there are."""
    scene = ellipsoid_scene(300, 60, 45, 3)

    def signal(*maps: str) -> Tensor:
        tensors = [t.clone().requires_grad_() for t in scene.tensors]
        probe = torch.zeros(300, 2, requires_grad=True)
        options = RasterOptions(absolute_probe=True, **dict.fromkeys(maps, True))  # type: ignore[arg-type]
        shape = (*tensors[:3], tensors[3][:, :2], *tensors[4:])
        image = rasterize_surfels(*shape, scene.camera, options=options, screen_probe=probe).features
        (image * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
        assert probe.grad is not None
        return probe.grad

    plain = signal()
    for maps in (("depth",), ("normal",), ("depth", "normal", "distortion")):
        assert relative_error(signal(*maps), plain).max() < 1e-5, maps
