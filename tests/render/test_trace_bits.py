"""What changes no bit of the native tracer's results: threads, the tree, other rays, earlier calls."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from rtgs.native import core
from rtgs.render.trace import SurfelTree, trace_surfels

from .native_trace_scene import BY_RAY, GEOMETRY, LABELS, assert_same_bits, everything, native_trace_scene
from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, output, trace


@pytest.mark.parametrize("size", [0.05, 0.5])
def test_bits_do_not_depend_on_the_number_of_threads(isa: str, size: float):
    scene = native_trace_scene(700, 2901, 5, size=size)  # several groups of packets
    expected = everything(scene)
    for threads in (2, 5):
        torch.set_num_threads(threads)
        assert_same_bits(expected, everything(scene))


def test_more_groups_of_packets_than_threads_take_at_once_give_the_same_bits(isa: str):
    scene = native_trace_scene(60, 40_000, 3, size=0.1)  # of 16 rays and 32 packets: 79 groups, 32 at once
    expected = everything(scene)
    torch.set_num_threads(2)
    assert_same_bits(expected, everything(scene))


def test_refit_and_rebuild_give_the_same_bits(isa: str):
    scene = native_trace_scene(1000, 600)
    tree = SurfelTree().build(*scene.all()[:GEOMETRY])
    cost = tree.surface_cost
    generator = torch.Generator().manual_seed(2)
    moved = replace(scene, means=scene.means + 0.5 * torch.randn(1000, 3, generator=generator), scales=2 * scene.scales)
    tree.refit(*moved.all()[:GEOMETRY])
    assert tree.surface_cost > 1.5 * cost
    rebuilt = SurfelTree().build(*moved.all()[:GEOMETRY])
    assert rebuilt.surface_cost < tree.surface_cost
    assert_same_bits(everything(moved, rebuilt), everything(moved, tree))
    assert_same_bits(everything(moved, rebuilt), everything(moved, None))


def test_coincident_surfels_are_ordered_by_row_in_any_tree(isa: str):
    scene = native_trace_scene(400, 300, size=0.4)
    group = torch.arange(400) % 40
    copies = {name: dict(scene.items())[name][group] for name in ("means", "tangent_u", "tangent_v")}
    scene = replace(scene, **copies)
    old = replace(scene, means=scene.means.roll(17, 0) * torch.linspace(0.2, 3, 400)[:, None])
    aged = SurfelTree().build(*old.all()[:GEOMETRY]).refit(*scene.all()[:GEOMETRY])
    assert_same_bits(everything(scene), everything(scene, aged))


def test_the_order_of_rays_in_the_kernel_changes_no_output_bit(isa: str):
    scene = native_trace_scene(600, 800)
    given, ordered = everything(scene, order="given"), everything(scene, order="sorted")
    for name, a, b in zip(LABELS, given, ordered, strict=True):
        if name in (*OUTPUTS, *BY_RAY):
            assert torch.equal(a, b), name
        else:  # sums over rays: another order, another rounding
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * a.abs().max().item(), msg=name)
    chosen = everything(scene, order="auto")
    assert any(all(torch.equal(x, y) for x, y in zip(chosen, some, strict=True)) for some in (given, ordered))


def test_rays_in_any_company_give_the_same_bits(isa: str):
    scene = native_trace_scene(1000, 400)
    whole = everything(scene)
    some = torch.arange(0, 400, 3)
    for name, a, b in zip(OUTPUTS, whole, everything(scene.rays(some)), strict=False):
        assert torch.equal(a[some], b), name


def rays_to_rims(scene: TraceTensors, share: float, each: int = 16) -> TraceTensors:
    """Thin cones of ``each`` rays, one a surfel, to points at ``share`` of how far the surfel reaches."""
    surfels = len(scene.means)
    generator = torch.Generator().manual_seed(3)
    angle = torch.arange(each, dtype=torch.float64) * (2 * torch.pi / each)
    reach = (2 * (scene.opacities.double() * 255).log().clamp_min(0)).sqrt() * share
    u = (reach * scene.scales[:, 0])[:, None, None] * angle.cos()[:, None] * scene.tangent_u[:, None, :]
    v = (reach * scene.scales[:, 1])[:, None, None] * angle.sin()[:, None] * scene.tangent_v[:, None, :]
    points = (scene.means[:, None, :] + u + v).reshape(-1, 3)
    eyes = 8 * torch.nn.functional.normalize(torch.randn(surfels, 3, generator=generator, dtype=torch.float64), dim=1)
    origins = eyes.repeat_interleave(each, 0)
    return replace(scene, origins=origins.float(), directions=(points - origins).float())


def test_surfels_are_met_up_to_their_rims_by_rays_that_run_alike(isa: str):
    """Of each cone and of the same rays one by one among others; a surfel's last rays are as faint as the cutoff."""
    scene = native_trace_scene(300, 1, 1, size=0.2)
    scene = rays_to_rims(replace(scene, opacities=0.02 + 0.1 * scene.opacities), 0.999)
    mixed = torch.randperm(len(scene.origins), generator=torch.Generator().manual_seed(4))
    alike, alone = everything(scene, order="given"), everything(scene.rays(mixed), order="given")
    for name, a, b in zip(OUTPUTS, alike, alone, strict=False):
        assert torch.equal(a[mixed], b), name
    alpha = output(trace(scene.leaves(torch.float64)), "alpha").detach()
    near = (alike[OUTPUTS.index("alpha")].double() - alpha).abs() < 1e-3  # a surfel that is missed costs 4e-3
    assert near.float().mean() > 0.999


def test_bits_do_not_depend_on_earlier_calls(isa: str):
    small, large = native_trace_scene(50, 33), native_trace_scene(900, 1500, 20, seed=1, size=0.4)
    core.release_trace_memory()
    first = everything(small)
    everything(large)
    assert_same_bits(first, everything(small))


def test_python_threads_do_not_disturb_each_other():
    scenes = [native_trace_scene(400 + 100 * k, 800, 3 + k, seed=k) for k in range(4)]
    expected = [everything(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            for a, b in zip(expected, pool.map(everything, scenes), strict=True):
                assert_same_bits(a, b)


def test_the_tree_may_change_between_forward_and_backward():
    scene = native_trace_scene(300, 200)
    expected = everything(scene)[len(OUTPUTS) + 1 :]
    tree = SurfelTree().build(*scene.all()[:GEOMETRY])
    leaves = scene.leaves(torch.float32)
    positional, named = leaves.arguments()
    buffers = trace_surfels(*positional, tree=tree, **named, options=all_outputs())  # type: ignore[misc]
    tree.build(*native_trace_scene(40, 1).all()[:GEOMETRY])
    generator = torch.Generator().manual_seed(1)
    outputs = [output(buffers, name) for name in OUTPUTS]
    upstream = [torch.randn(o.shape, generator=generator) for o in outputs]
    for name, a, b in zip(NAMES, expected, torch.autograd.grad(outputs, leaves.all(), upstream), strict=True):
        assert torch.equal(a, b), name


def test_a_second_backward_pass_gives_the_same_bits_and_second_derivatives_are_refused():
    leaves = native_trace_scene(200, 200).leaves(torch.float32)
    positional, named = leaves.arguments()
    loss = output(trace_surfels(*positional, **named), "colors").square().sum()  # type: ignore[misc]
    first = torch.autograd.grad(loss, leaves.means, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(loss, leaves.means, retain_graph=True)[0])
    (gradient,) = torch.autograd.grad(loss, leaves.means, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        (gradient.square().sum() + loss).backward()


def test_strided_inputs_and_upstream():
    scene = native_trace_scene(80, 60)
    wide = TraceTensors(*(torch.stack((t, t), -1)[..., 0] for t in scene.all()))
    assert not wide.means.is_contiguous()
    assert_same_bits(everything(scene), everything(wide))
