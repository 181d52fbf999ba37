"""The native tracer's own promises: any number of hits, finite results, checked arguments."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rtgs.render.buffers import TraceOptions
from rtgs.render.reference import trace as reference_trace
from rtgs.render.trace import SurfelTree, trace_surfels

from .native_trace_scene import BY_RAY, GEOMETRY, LABELS, everything, native_trace_scene
from .trace_runs import TraceScene, run_trace
from .trace_scenes import NAMES, OUTPUTS, TraceTensors, join, output, surfel, with_rays

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("count", [300, 6000])
def test_no_hit_is_dropped(isa: str, count: int):
    """Far more faint layers on every ray than any fixed buffer would hold; the rays stop nowhere."""
    generator = torch.Generator().manual_seed(4)
    scene = native_trace_scene(count, 20, 2, seed=5)
    depth = torch.linspace(1, 11, count)[torch.randperm(count, generator=generator)]
    tilt = 2e-4 * torch.randn(count, 3, generator=generator)
    normal = torch.nn.functional.normalize(tilt + torch.tensor([0.0, 0.0, 1.0]), dim=1)
    tangent_u = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]), normal), dim=1)
    scene = replace(
        scene,
        means=torch.stack((torch.zeros(count), torch.zeros(count), depth), 1),
        tangent_u=tangent_u,
        tangent_v=torch.linalg.cross(normal, tangent_u),
        scales=torch.full((count, 2), 50.0),
        opacities=torch.full((count,), 0.0045 + 1.0 / count),
        origins=0.01 * torch.randn(20, 3, generator=generator),
        directions=torch.tensor([0.0, 0.0, 1.0]) + 0.01 * torch.randn(20, 3, generator=generator),
    )
    options = TraceOptions(transmittance_cutoff=0.0, depth=True, normal=True, weight_sum=True)
    upstream = {"alpha": torch.ones(20), "depth": torch.ones(20), "colors": torch.ones(20, 3)}
    upstream |= {"features": torch.ones(20, 2), "normal": torch.ones(20, 3)}
    case = TraceScene(scene, options)
    found = run_trace(trace_surfels, case, torch.float32, upstream)
    exact = run_trace(reference_trace.trace_surfels, case, torch.float64, upstream)
    assert (exact.weight_sum > 0).all()
    assert (found.weight_sum > 0).all()
    for name, tensor in found.outputs.items():
        expected = exact.outputs[name].float()
        torch.testing.assert_close(tensor, expected, rtol=0, atol=2e-5 * expected.abs().max().item(), msg=name)
    for name in ("means", "opacities", "features", "sh_dc", "directions"):
        expected = exact.gradients[name].float()
        limit = 1e-4 * expected.abs().max().item()
        torch.testing.assert_close(found.gradients[name], expected, rtol=0, atol=limit, msg=name)


def test_more_hits_than_sixteen_bits_count():
    """The tape of such a packet has wide rows, and its surfels are sorted by long keys."""
    count, generator = 66_000, torch.Generator().manual_seed(4)
    depth = torch.linspace(1, 11, count)[torch.randperm(count, generator=generator)]
    column = torch.zeros(count)
    axes = (torch.tensor([[1.0, 0, 0]]).repeat(count, 1), torch.tensor([[0.0, 1, 0]]).repeat(count, 1))
    opacity = 2e-5 + 2e-5 * torch.rand(count, generator=generator)
    feature = torch.randn(count, 1, generator=generator)
    leaves = [opacity.clone().requires_grad_(), feature.clone().requires_grad_()]
    means, scales = torch.stack((column, column, depth), 1), torch.full((count, 2), 50.0)
    options = TraceOptions(transmittance_cutoff=0.0, alpha_cutoff=1e-5, depth=True)
    ray = (torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
    found = trace_surfels(means, *axes, scales, leaves[0], *ray, features=leaves[1], options=options)
    order = depth.argsort()
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    alpha = exact[0][order]
    before = torch.cat((alpha.new_ones(1), (1 - alpha).cumprod(0)[:-1]))
    weight = alpha * before
    expected = (weight.sum(), (weight * depth[order]).sum(), (weight * exact[1][order, 0]).sum())
    actual = (found.alpha[0], output(found, "depth")[0], output(found, "features")[0, 0])
    for one, other in zip(actual, expected, strict=True):
        assert float(one.detach()) == pytest.approx(float(other.detach()), rel=2e-4)
    upstream = (0.5, 1.0, 2.0)
    by_native = torch.autograd.grad(sum(u * v for u, v in zip(upstream, actual, strict=True)), leaves)  # type: ignore[arg-type]
    by_hand = torch.autograd.grad(sum(u * v for u, v in zip(upstream, expected, strict=True)), exact)  # type: ignore[arg-type]
    for one, other in zip(by_native, by_hand, strict=True):
        assert float((one.double() - other).abs().max()) <= 1e-4 * float(other.abs().max())


@pytest.mark.parametrize(("surfels", "rays"), [(0, 5), (1, 5), (3, 0), (0, 0), (1, 1), (8, 17)])
def test_small_sets(isa: str, surfels: int, rays: int):
    scene = native_trace_scene(surfels, rays, size=2.0)
    found = everything(scene)
    shapes = {"colors": (rays, 3), "features": (rays, 3), "alpha": (rays,), "depth": (rays,), "normal": (rays, 3)}
    for name, tensor in zip(LABELS, found, strict=True):
        assert tensor.isfinite().all(), name
        assert tensor.shape == shapes.get(name, tensor.shape)
    torch.testing.assert_close(found[5].sum(), found[2].sum())
    if not surfels:
        assert not any(t.any() for t in found)


def test_one_surfel_head_on_along_its_plane_and_from_inside_it(isa: str):
    rays = [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ((-3.0, 0.0, 2.0), (1.0, 0.0, 0.0)),  # in the plane
        ((0.1, 0.0, 2.0), (0.0, 1.0, 0.0)),  # in the plane, starting on the surfel
        ((0.1, 0.0, 2.0), (0.0, 0.0, 1.0)),  # starting on the surfel: t = 0 does not count
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, math.inf, 1.0)),
    ]
    scene = TraceTensors(*(t.float() for t in with_rays(surfel(), *rays).all()))
    found = everything(scene)
    assert found[2].tolist() == pytest.approx([0.6, 0, 0, 0, 0, 0, 0])
    assert all(tensor.isfinite().all() for tensor in found)
    for name in BY_RAY:
        assert not found[LABELS.index(name)][1:].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NAMES[:GEOMETRY])
def test_a_surfel_that_is_not_finite_changes_nothing(isa: str, bad: float, name: str):
    scene = native_trace_scene(61, 300)
    without = scene.rows(torch.arange(1, 61))
    tensor = dict(scene.items())[name].clone()
    tensor.view(61, -1)[0, 0] = bad
    found, expected = everything(replace(scene, **{name: tensor})), everything(without)
    for label, a, b in zip(LABELS, found, expected, strict=True):
        if len(a) == 61:
            assert not a[0].any(), label
            a = a[1:]
        assert torch.equal(a, b), label


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["origins", "directions"])
def test_a_ray_that_is_not_finite_changes_no_other(isa: str, bad: float, name: str):
    """Wherever it is in its packet, and whichever of its components it is."""
    scene = native_trace_scene(200, 96)
    tensor = dict(scene.items())[name].clone()
    rows = torch.tensor([3, 15, 31, 36, 95])
    tensor[rows, torch.tensor([0, 2, 1, 2, 2])] = bad
    found, expected = everything(replace(scene, **{name: tensor})), everything(scene)
    others = torch.ones(96, dtype=torch.bool).index_fill(0, rows, False)
    for label, a, b in zip(OUTPUTS, found, expected, strict=False):
        assert torch.equal(a[others], b[others]), label
        assert not a[rows].any(), label


@pytest.mark.parametrize("length", [2.0**-100, 2.0**-66, 2.0**-33, 2.0**33, 2.0**66])
def test_directions_of_any_length_meet_the_same(isa: str, length: float):
    """Rays along the axes to small surfels: what their components of zero count as grows with the others."""
    scene = native_trace_scene(300, 300, size=0.002)
    axis = torch.arange(300) % 3
    along = torch.nn.functional.one_hot(axis, 3).float()
    scene = replace(scene, origins=scene.means - 4 * along, directions=along)
    unit, scaled = everything(scene), everything(replace(scene, directions=length * along))
    for label, a, b in zip(OUTPUTS, unit, scaled, strict=False):
        b = b * length if label == "depth" else b
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5, msg=label)
    assert (unit[OUTPUTS.index("alpha")] > 0).float().mean() > 0.9


def test_boxes_whose_area_overflows_make_a_tree(isa: str):
    """Flat ones: infinity times zero."""
    u = torch.tensor([[0.8, 0.6, 0.0]]).expand(60, 3)
    v = torch.tensor([[0.6, -0.8, 0.0]]).expand(60, 3)
    tree = SurfelTree().build(torch.zeros(60, 3), u, v, torch.full((60, 2), 2e38), torch.full((60,), 0.9))
    assert tree.surfels == 60


@pytest.mark.parametrize("seed", range(6))
def test_any_finite_input_gives_finite_results(isa: str, seed: int):
    """A share of all values, those of the rays included, becomes +-1e-30 to 1e30."""
    generator = torch.Generator().manual_seed(seed)
    scene = native_trace_scene(80, 200, seed=seed, size=0.5)

    def wild(tensor: Tensor) -> Tensor:
        chosen = torch.rand(tensor.shape, generator=generator) < 0.05
        extreme = 10.0 ** (60 * torch.rand(tensor.shape, generator=generator) - 30)
        return torch.where(chosen, extreme * tensor.sign(), tensor)

    kept = ("opacities", "probe")  # an opacity is at most 1
    changed = {name: wild(tensor) for name, tensor in scene.items() if name not in kept}
    found = everything(replace(scene, **changed))
    for label, tensor in zip(LABELS, found, strict=True):
        assert not tensor.isnan().any(), label
        assert label in OUTPUTS or tensor.isfinite().all(), label
    assert found[2].any()


def test_a_trace_alive_at_exit_ends_quietly():
    script = (
        "import torch\nfrom rtgs.render.trace import trace_surfels\n"
        "from tests.render.native_trace_scene import native_trace_scene\n"
        "positional, named = native_trace_scene(60, 30).leaves(torch.float32).arguments()\n"
        "buffers = trace_surfels(*positional, **named)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_only_wanted_gradients_and_outputs_are_made():
    scene = native_trace_scene(60, 50)
    plain = trace_surfels(*scene.all()[:7])
    assert (plain.colors, plain.features, plain.depth, plain.normal, plain.weight_sum) == (None,) * 5
    assert not plain.alpha.requires_grad
    directions = scene.directions.clone().requires_grad_()
    positional, named = replace(scene, directions=directions).arguments()
    found = trace_surfels(*positional, **named, options=TraceOptions(weight_sum=True))  # type: ignore[misc]
    assert not output(found, "weight_sum").requires_grad
    output(found, "colors").sum().backward()
    assert directions.grad is not None
    assert directions.grad.any()
    assert torch.equal(found.alpha.detach(), plain.alpha)


def test_nan_upstream_reaches_the_gradient(isa: str):
    """The trainer's guard must see it: nothing replaces it on the way."""
    leaves = native_trace_scene(60, 50, size=1.0).leaves(torch.float32)
    positional, named = leaves.arguments()
    alpha = trace_surfels(*positional, **named).alpha  # type: ignore[misc]
    upstream = torch.where(torch.arange(50) == 7, torch.nan, 0.0)
    assert torch.autograd.grad(alpha, leaves.means, upstream)[0].isnan().any()


BROKEN = {
    "means must have shape": ("means", lambda t: t[:, :2]),
    "tangent_u must have shape": ("tangent_u", lambda t: t[1:]),
    "directions must have shape": ("directions", lambda t: t[1:]),
    "features must be": ("features", lambda t: t[:, :0]),
    "sh_rest must have shape": ("sh_rest", lambda t: t[:, :4]),
    "tangent_v must be float32": ("tangent_v", lambda t: t.double()),
    "origins must be float32": ("origins", lambda t: t.double()),
}


@pytest.mark.parametrize("message", BROKEN)
def test_wrong_tensors_are_named(message: str):
    name, change = BROKEN[message]
    scene = native_trace_scene(10, 20)
    positional, named = replace(scene, **{name: change(dict(scene.items())[name])}).arguments()
    with pytest.raises(ValueError, match=message):
        trace_surfels(*positional, **named)  # type: ignore[misc]


def test_wrong_trees_and_bounds_are_named():
    scene = native_trace_scene(10, 20)
    geometry = scene.all()[:GEOMETRY]
    tree = SurfelTree().build(*geometry)
    assert (tree.surfels, tree.nodes > 0) == (10, True)
    with pytest.raises(ValueError, match="tree holds 10 surfels, means 9"):
        trace_surfels(*scene.rows(torch.arange(9)).all()[:7], tree=tree)
    with pytest.raises(ValueError, match=r"tree was built for alpha_cutoff=0\.1"):
        trace_surfels(*scene.all()[:7], tree=SurfelTree().build(*geometry, alpha_cutoff=0.1))
    with pytest.raises(ValueError, match="refit got 9 surfels"):
        tree.refit(*scene.rows(torch.arange(9)).all()[:GEOMETRY])
    with pytest.raises(ValueError, match="t_min must be float32"):
        trace_surfels(*scene.all()[:7], options=TraceOptions(t_min=torch.zeros(20, dtype=torch.float64)))
    with pytest.raises(ValueError, match="t_max must be one number"):
        trace_surfels(*scene.all()[:7], options=TraceOptions(t_max=torch.zeros(19)))


def test_an_empty_tree_is_free_and_says_so():
    tree = SurfelTree()
    assert (tree.surfels, tree.surface_cost, tree.alpha_cutoff) == (0, 0, 0)
    far = join(surfel(opacity=1e-3), surfel(opacity=1e-3)).rows(torch.arange(2))
    far = TraceTensors(*(t.float() for t in far.all()))
    assert not trace_surfels(*far.all()[:7]).alpha.any()
