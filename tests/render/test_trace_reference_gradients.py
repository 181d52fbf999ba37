"""Gradients of the tracer's twin against finite differences in float64.

The scene avoids every discontinuity (the flags say so): four overlapping tilted surfels, rays from two origins that
meet all of them well above the alpha cut, directions that are not of unit length.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.render.discontinuities.trace import fragile_rays
from rtgs.render.reference.trace import trace_surfels

from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, join, output, surfel, trace, with_rays

POSITIONAL = 7


def smooth_scene() -> TraceTensors:
    """Listed back to front."""
    features = ((0.3, -1.0), (1.0, 0.2), (-0.4, 0.7), (0.8, 0.5))
    layers = join(
        surfel((0.3, 0.1, 5.0), tangent_u=(1, 0.1, 0.5), tangent_v=(0, 1.2, 0.3), scales=(3, 4), opacity=0.8),
        surfel((0.0, -0.1, 3.1), tangent_u=(1, 0.0, 0.3), scales=(2.1, 1.9), opacity=0.7),
        surfel((-0.2, 0.2, 2.4), tangent_u=(1, 0.3, -0.4), tangent_v=(0.2, 1, 0.6), scales=(1.2, 1.5), opacity=0.5),
        surfel((0.1, 0.0, 1.5), tangent_u=(0, 1, 0.2), tangent_v=(0.9, 0, -0.5), scales=(1.1, 0.9), opacity=0.3),
    )
    scene = with_rays(
        layers,
        ((0.0, 0.0, 0.0), (0.03, 0.02, 1.0)),
        ((0.1, -0.1, 0.0), (-0.1, 0.16, 2.0)),
        ((0.2, 0.1, 8.0), (0.01, -0.02, -0.7)),
    )
    generator = torch.Generator().manual_seed(5)
    return replace(
        scene,
        features=torch.tensor(features, dtype=torch.float64),
        sh_dc=0.4 * torch.randn(4, 3, generator=generator, dtype=torch.float64),
        sh_rest=0.15 * torch.randn(4, 15, 3, generator=generator, dtype=torch.float64),
    )


def scalar_of(name: str):
    def scalar(*tensors: Tensor) -> Tensor:
        named = dict(zip(NAMES[POSITIONAL:], tensors[POSITIONAL:]))
        found = output(trace_surfels(*tensors[:POSITIONAL], **named, options=all_outputs()), name)
        weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        return (found * weights).sum()

    return scalar


def test_the_scene_has_no_discontinuity_and_meets_every_surfel():
    scene = smooth_scene()
    positional, named = scene.arguments()
    named.pop("probe")
    assert not fragile_rays(*positional, **named, options=all_outputs()).any()
    weights = output(trace(scene), "weight_sum")
    assert (weights > 0.1).all()


@pytest.mark.parametrize("name", OUTPUTS)
def test_gradients_of_each_output_agree_with_finite_differences(name: str):
    leaves = smooth_scene().leaves(torch.float64).all()
    leaves = leaves[:-1] if name == "colors" else leaves[: POSITIONAL + 1]  # the probe moves nothing, SH only colours
    assert torch.autograd.gradcheck(scalar_of(name), leaves, eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", OUTPUTS)
def test_each_output_depends_on_the_inputs_it_should(name: str):
    """gradcheck compares zeros happily: the gradients must be there."""
    leaves = smooth_scene().leaves(torch.float64)
    gradients = torch.autograd.grad(scalar_of(name)(*leaves.all()), leaves.all(), allow_unused=True)
    without = {"features": {"sh_dc", "sh_rest"}, "colors": {"features"}}.get(name, {"features", "sh_dc", "sh_rest"})
    for tensor, gradient in zip(NAMES, gradients, strict=True):
        present = gradient is not None and bool(gradient.any())
        assert present is (tensor not in without), f"{name} by {tensor}"


def test_clamped_hits_pass_no_gradient_to_shape_and_opacity_but_to_depth():
    scene = surfel(opacity=1.0, features=(2.0,)).leaves(torch.float64)
    found = trace(scene)
    gradients = torch.autograd.grad(found.alpha.sum(), scene.all(), retain_graph=True, allow_unused=True)
    assert not any(g is not None and g.any() for g in gradients)
    (by_mean, by_feature) = torch.autograd.grad(
        output(found, "depth").sum() + output(found, "features").sum(), (scene.means, scene.features)
    )
    assert by_mean[0].tolist() == pytest.approx([0.0, 0.0, 0.99])
    assert by_feature.item() == pytest.approx(0.99)


def gradients_by(scene: TraceTensors, names: tuple[str, ...], **changes) -> list[Tensor]:
    leaves = scene.leaves(torch.float64)
    buffers = trace(leaves, all_outputs(**changes))
    loss = torch.stack([output(buffers, name).square().sum() for name in OUTPUTS]).sum()
    return list(torch.autograd.grad(loss, [dict(leaves.items())[name] for name in names], materialize_grads=True))


def test_the_probe_receives_half_t_times_the_gradient_of_the_mean():
    """Per hit; with one surfel and several rays it is the sum over them."""
    scene = smooth_scene().rows(torch.tensor([1]))
    (signal,) = gradients_by(scene, ("probe",))
    positional, named = scene.arguments()
    found = trace_surfels(*positional, **named, options=all_outputs())
    t = output(found, "depth") / found.alpha
    expected = torch.zeros(3, dtype=torch.float64)
    for ray in range(len(t)):
        (by_mean,) = gradients_by(scene.rays(torch.tensor([ray])), ("means",))
        expected += by_mean[0] * 0.5 * t[ray]
    torch.testing.assert_close(signal[0], expected)


def test_the_probe_does_not_move_anything():
    scene = smooth_scene()
    moved = replace(scene, probe=scene.probe + 7.0)
    assert torch.equal(trace(scene).features, trace(moved).features)  # type: ignore[arg-type]


def test_last_sh_leaves_the_direction_only_the_last_colours_term():
    """Decision 24: the geometric term and all but the last contributor's SH term are lost; nothing else is."""
    scene = smooth_scene().rays(torch.tensor([0]))
    names = tuple(name for name in NAMES if name != "directions")
    for full, last in zip(
        gradients_by(scene, names), gradients_by(scene, names, direction_gradient="last_sh"), strict=True
    ):
        torch.testing.assert_close(full, last, rtol=1e-12, atol=0)
    (lost,) = gradients_by(scene, ("directions",), direction_gradient="last_sh")
    (full,) = gradients_by(scene, ("directions",))
    assert not torch.allclose(lost, full, rtol=0.1)

    # by hand: the far surfel is the last; its weight and every other colour are constants
    buffers = trace(scene)
    weight = output(buffers, "weight_sum")[0]
    direction = scene.directions.clone().requires_grad_()
    alone = replace(scene.rows(torch.tensor([0])), directions=direction, opacities=torch.tensor([0.5]).double())
    seen = trace(alone)
    color = output(seen, "colors") / seen.alpha[:, None]
    (expected,) = torch.autograd.grad((2 * weight * output(buffers, "colors") * color).sum(), direction)
    torch.testing.assert_close(lost, expected)


def test_last_sh_at_degree_0_is_zero():
    (lost,) = gradients_by(smooth_scene(), ("directions",), direction_gradient="last_sh", sh_degree=0)
    assert not lost.any()
