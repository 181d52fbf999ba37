"""The tracer's twin against closed forms and at degenerate input (docs/tracer.md)."""

import math
from dataclasses import replace

import pytest
import torch

from rtgs.gaussians.harmonics import evaluate_sh
from rtgs.render.buffers import TraceOptions
from rtgs.render.reference.trace import trace_surfels

from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, join, output, surfel, trace, with_rays

DOWN_Z = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def values(buffers, name: str) -> list:
    return output(buffers, name)[0].tolist()


def test_one_surfel_is_a_gaussian_in_its_plane():
    scene = with_rays(surfel(opacity=0.9), *(((x, y, 0.0), (0.0, 0.0, 1.0)) for x, y in ((0, 0), (0.5, 0), (0, 0.5))))
    found = trace(scene)
    expected = torch.tensor([0.9, 0.9 * math.exp(-0.5), 0.9 * math.exp(-2.0)], dtype=torch.float64)
    torch.testing.assert_close(found.alpha, expected)
    torch.testing.assert_close(output(found, "depth"), 2 * expected)
    torch.testing.assert_close(output(found, "features")[:, 0], expected)
    torch.testing.assert_close(output(found, "weight_sum"), expected.sum()[None])


def test_tilted_surfel_and_a_direction_of_any_length():
    """The plane through (0, 0, 2) with slope 1 in x is met by (0.3, 0, 1) at t = 2 / (1 - 0.3)."""
    half = math.sqrt(0.5)
    tilted = surfel(tangent_u=(half, 0.0, half), opacity=0.5)
    t = 2 / 0.7
    u = (0.3 * t * half + (t - 2) * half) / 0.5
    for length in (1.0, 0.25):
        found = trace(with_rays(tilted, ((0.0, 0.0, 0.0), (0.3 * length, 0.0, length))))
        alpha = 0.5 * math.exp(-0.5 * u * u)
        assert found.alpha.item() == pytest.approx(alpha)
        assert output(found, "depth").item() == pytest.approx(alpha * t / length)
        assert values(found, "normal") == pytest.approx([alpha * half, 0.0, -alpha * half])


def test_two_layers_in_either_row_order():
    near = surfel((0, 0, 1.0), opacity=0.3, features=(1.0, 0.0))
    far = surfel((0, 0, 4.0), opacity=0.8, features=(0.0, 1.0))
    for scene in (join(near, far), join(far, near)):
        found = trace(scene)
        assert values(found, "features") == pytest.approx([0.3, 0.7 * 0.8])
        assert found.alpha.item() == pytest.approx(1 - 0.7 * 0.2)
        assert output(found, "depth").item() == pytest.approx(0.3 * 1 + 0.56 * 4)


def test_ties_go_by_row():
    first, second = surfel(opacity=0.5, features=(1.0, 0.0)), surfel(opacity=0.5, features=(0.0, 1.0))
    assert values(trace(join(first, second)), "features") == pytest.approx([0.5, 0.25])


def test_normals_turn_against_the_ray():
    scene = surfel(opacity=0.5)
    for direction in (1.0, -1.0):
        found = trace(with_rays(scene, ((0.0, 0.0, 2.0 - direction), (0.0, 0.0, direction))))
        assert values(found, "normal") == pytest.approx([0.0, 0.0, -0.5 * direction])


def test_color_is_sh_at_the_unit_direction_clamped_at_zero():
    generator = torch.Generator().manual_seed(3)
    dark = replace(
        surfel(opacity=0.7, sh_dc=(0.3, -4.0, 0.1)),
        sh_rest=0.2 * torch.randn(1, 15, 3, generator=generator, dtype=torch.float64),
    )
    scene = with_rays(dark, ((0.0, 0.0, 0.0), (0.2, -0.1, 2.0)))
    unit = torch.nn.functional.normalize(scene.directions, dim=-1)
    for degree in range(4):
        found = trace(scene, all_outputs(sh_degree=degree))
        color = evaluate_sh(scene.sh_dc, scene.sh_rest, unit, degree).clamp_min(0)
        torch.testing.assert_close(output(found, "colors"), found.alpha[:, None] * color)
        assert output(found, "colors")[0, 1] == 0
    capped = replace(scene, sh_rest=scene.sh_rest[:, :3])
    torch.testing.assert_close(trace(capped).colors, trace(scene, all_outputs(sh_degree=1)).colors)


def test_bounds_are_open_and_per_ray():
    scene = with_rays(surfel(opacity=0.5), *[DOWN_Z] * 4)
    lower = torch.tensor([0.0, 1.9999, 2.0, 2.1], dtype=torch.float64)
    assert trace(scene, all_outputs(t_min=lower)).alpha.tolist() == [0.5, 0.5, 0.0, 0.0]
    upper = torch.tensor([math.inf, 2.0001, 2.0, 1.0], dtype=torch.float64)
    assert trace(scene, all_outputs(t_max=upper)).alpha.tolist() == [0.5, 0.5, 0.0, 0.0]
    assert not trace(scene, all_outputs(t_min=2.0)).alpha.any()
    assert not trace(scene, all_outputs(t_max=2.0)).alpha.any()


def test_the_hit_below_the_transmittance_cutoff_is_added_and_the_last():
    layers = join(*(surfel((0, 0, z), opacity=0.9) for z in (1.0, 2.0, 3.0, 4.0)))
    for cutoff, count in ((0.5, 1), (0.05, 2), (0.0, 4)):
        assert trace(layers, all_outputs(transmittance_cutoff=cutoff)).alpha.item() == pytest.approx(1 - 0.1**count)


def test_alpha_cutoff_bounds_the_support_and_the_clamp_the_peak():
    radius = math.sqrt(2 * math.log(0.5 / 0.1))
    rays = [((0.5 * radius * share, 0.0, 0.0), (0.0, 0.0, 1.0)) for share in (0.999, 1.001)]
    found = trace(with_rays(surfel(opacity=0.5), *rays), all_outputs(alpha_cutoff=0.1))
    assert found.alpha.tolist() == pytest.approx([0.5 * math.exp(-0.5 * (0.999 * radius) ** 2), 0.0])
    assert trace(surfel(opacity=1.0)).alpha.item() == 0.99


def test_rays_along_a_plane_miss_it():
    rays = [((0.0, 0.0, 2.0), (1.0, 0.0, 0.0)), ((-1.0, 0.0, 2.0 + 5e-7), (1.0, 0.0, -5e-7))]
    grazing = ((-1.0, 0.0, 2.0 + 5e-6), (1.0, 0.0, -5e-6))
    found = trace(with_rays(surfel(opacity=0.5), *rays, grazing))
    assert found.alpha.tolist() == pytest.approx([0.0, 0.0, 0.5], abs=1e-9)


def broken(scene: TraceTensors, name: str, value: float) -> TraceTensors:
    tensor = dict(scene.items())[name].clone()
    tensor.view(len(tensor), -1)[0, 0] = value
    return replace(scene, **{name: tensor})


@pytest.mark.parametrize("name", ["means", "tangent_u", "tangent_v", "scales", "opacities"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_surfel_that_is_not_finite_is_left_out(name: str, bad: float):
    pair = broken(join(surfel((0, 0, 1.0)), surfel()), name, bad).leaves(torch.float64)
    found = trace(pair)
    assert found.alpha.item() == pytest.approx(0.6)
    gradients = torch.autograd.grad(output(found, "depth").sum(), pair.all()[:5], allow_unused=True)
    assert all(g is None or (g.isfinite().all() and not g[0].any()) for g in gradients)


@pytest.mark.parametrize(
    ("name", "value"), [("scales", 0.0), ("scales", -1.0), ("opacities", 1 / 256), ("opacities", 0.0)]
)
def test_surfels_without_support_are_left_out(name: str, value: float):
    assert trace(broken(surfel(), name, value)).alpha.item() == 0


def test_no_area_is_left_out():
    assert trace(surfel(tangent_v=(1.0, 0.0, 0.0))).alpha.item() == 0


@pytest.mark.parametrize(
    "ray",
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, math.inf, 1.0)),
    ],
)
def test_unusable_rays_meet_nothing_and_pass_no_gradient(ray):
    scene = with_rays(surfel(), ray, DOWN_Z).leaves(torch.float64)
    found = trace(scene)
    assert found.alpha.tolist() == [0.0, pytest.approx(0.6)]
    gradients = torch.autograd.grad(output(found, "colors").sum() + found.alpha.sum(), scene.all(), allow_unused=True)
    assert all(g is None or g.isfinite().all() for g in gradients)


@pytest.mark.parametrize(("surfels", "rays"), [(0, 3), (2, 0), (0, 0)])
def test_empty_sets_give_zeros(surfels: int, rays: int):
    scene = with_rays(join(surfel(), surfel()), *[DOWN_Z] * 3)
    scene = scene.rows(torch.arange(surfels)).rays(torch.arange(rays))
    found = trace(scene)
    shapes = {"colors": (rays, 3), "features": (rays, 1), "alpha": (rays,), "depth": (rays,), "normal": (rays, 3)}
    for name in OUTPUTS:
        assert output(found, name).shape == shapes[name]
        assert surfels != 0 or not output(found, name).any()
    assert output(found, "weight_sum").shape == (surfels,)


def test_outputs_that_nobody_asked_for_are_none():
    scene = surfel()
    found = trace_surfels(*scene.all()[:7])
    assert (found.colors, found.features, found.depth, found.normal, found.weight_sum) == (None,) * 5
    assert found.alpha.item() == pytest.approx(0.6)


def test_chunks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch):
    layers = join(*(surfel((0, 0.02 * z, z), opacity=0.4) for z in (1.0, 2.0, 3.0)))
    scene = with_rays(layers, *(((0.05 * x, 0.0, 0.0), (0.01 * x, 0.0, 1.0)) for x in range(7)))

    def everything() -> list[torch.Tensor]:
        leaves = scene.leaves(torch.float64)
        buffers = trace(leaves)
        loss = torch.stack([output(buffers, n).square().sum() for n in OUTPUTS]).sum()
        return [*(output(buffers, n) for n in (*OUTPUTS, "weight_sum")), *torch.autograd.grad(loss, leaves.all())]

    whole = everything()
    monkeypatch.setattr("rtgs.render.reference.trace.PAIRS_PER_CHUNK", 6)
    for name, a, b in zip((*OUTPUTS, "weight_sum", *NAMES), whole, everything(), strict=True):
        torch.testing.assert_close(a, b, msg=name)


BROKEN_ARGUMENTS = {
    "means must have shape": {"means": torch.zeros(2, 2)},
    "tangent_v must have shape": {"tangent_v": torch.zeros(2, 3)},
    "scales must have shape": {"scales": torch.zeros(1, 3)},
    "opacities must have shape": {"opacities": torch.zeros(1, 1)},
    "directions must have shape": {"directions": torch.zeros(2, 3)},
    "origins must have shape": {"origins": torch.zeros(1, 2)},
    "features must be": {"features": torch.zeros(1, 33)},
    "sh_dc must have shape": {"sh_dc": torch.zeros(1, 4)},
    "sh_rest must have shape": {"sh_rest": torch.zeros(1, 5, 3)},
    "probe must have shape": {"probe": torch.zeros(1, 2)},
}


@pytest.mark.parametrize("message", BROKEN_ARGUMENTS)
def test_wrong_shapes_are_named(message: str):
    with pytest.raises(ValueError, match=message):
        trace(replace(surfel(), **BROKEN_ARGUMENTS[message]))


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("SH degree 4", TraceOptions(sh_degree=4)),
        (r"transmittance_cutoff=1\.0", TraceOptions(transmittance_cutoff=1.0)),
        (r"alpha_cutoff=0\.0", TraceOptions(alpha_cutoff=0.0)),
        ("order='best'", TraceOptions(order="best")),  # type: ignore[arg-type]
        ("direction_gradient='none'", TraceOptions(direction_gradient="none")),  # type: ignore[arg-type]
        ("t_min must be one number", TraceOptions(t_min=torch.zeros(2))),
    ],
)
def test_wrong_options_are_named(message: str, options: TraceOptions):
    with pytest.raises(ValueError, match=message):
        trace(surfel(), options)


def test_sh_rest_needs_sh_dc():
    with pytest.raises(ValueError, match="without sh_dc"):
        trace_surfels(*surfel().all()[:7], sh_rest=surfel().sh_rest)
