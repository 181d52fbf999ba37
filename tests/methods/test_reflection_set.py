"""The reflection set: where it starts, how many of it a ray meets there, what its density control learns from."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_step

from rtgs.config import compose
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.settings import DensitySettings, InitSettings
from rtgs.gaussians.surfels import activate
from rtgs.methods import Mode, Stage
from rtgs.methods.parts.propagation import propagate_normals
from rtgs.methods.parts.reflection_init import copied_surfels, reflection_surfels
from rtgs.methods.parts.traced_set import FollowingTree, trace_set
from rtgs.methods.settings import PropagationSettings, ReflectionSettings
from rtgs.render.buffers import TraceOptions
from rtgs.render.reference.trace import find_hits, traced_rays, traced_surfels

MOST_HITS = 80  # of a ray at the start (the published 32^3 x 5 whole surfels cost 161)


def test_every_cell_of_the_box_gets_its_points():
    settings = ReflectionSettings(cells=4, per_cell=3, box_half=2.0)
    surfels = reflection_surfels(settings, torch.empty(0, 3), 1.0, torch.Generator().manual_seed(0))
    cell = surfels.means.detach() + 2
    assert float(cell.min()) >= 0
    assert float(cell.max()) <= 4
    number = (cell.floor().long() * torch.tensor([16, 4, 1])).sum(1)
    assert torch.equal(number.bincount(minlength=64), torch.full((64,), 3))
    within = (cell - cell.floor()).std(dim=0)
    assert bool((within > 0.25).all()), "anywhere in its cell: 0.29 for uniform points"
    colors = 0.5 + 0.28209479 * surfels.sh_dc.detach()
    assert 0 <= float(colors.min()) < 0.1
    assert 0.9 < float(colors.max()) <= 1
    torch.testing.assert_close(surfels.opacity_logits.detach().sigmoid(), torch.full((192,), 0.1))


def hits_a_ray(settings: ReflectionSettings) -> float:
    """Mean over rays from the middle of the box, where the surfaces are, to everywhere."""
    generator = torch.Generator().manual_seed(1)
    surfels = reflection_surfels(replace(settings, box_half=1.0), torch.empty(0, 3), 1.0, generator)
    active = activate(surfels, torch.zeros(3), 0)
    geometry = {name: getattr(active, name).detach() for name in ("means", "tangent_u", "tangent_v", "scales")}
    geometry["opacities"] = active.opacities.detach()
    options = TraceOptions(alpha_cutoff=settings.alpha_cutoff, transmittance_cutoff=settings.transmittance_cutoff)
    origins = 0.3 * (2 * torch.rand(60, 3, generator=generator) - 1)
    rays = traced_rays(origins, torch.randn(60, 3, generator=generator), options)
    met = traced_surfels(geometry, None, None, None, None, options.alpha_cutoff)
    hits = find_hits(met, rays, options.alpha_cutoff, options.transmittance_cutoff)
    return float(hits.contributes.sum(1).double().mean())


@pytest.mark.parametrize("preset", ["smoke", "quick", "standard"])
def test_rays_meet_few_surfels_at_the_start(preset: str):
    config, _ = compose(["scene=demo", "method=rtgs", f"preset={preset}"])
    assert 1 < hits_a_ray(config.method.reflection) < MOST_HITS


def test_density_control_learns_from_the_tracers_signal():
    """Sum over hits of dL/dmean * 0.5 * t, by its norm per set and step; nothing is cloned where it stays below."""
    grown = []
    for threshold in (1e-9, 1e9):
        density = DensitySettings(gradient_threshold=threshold, min_opacity=1e-4, too_large=0)
        quiet = PropagationSettings(every=0)
        method = new_method(recipe(density=density, propagation=quiet), made := tiny(), schedule())
        method.begin(Stage("reflection", 15, 60))
        assert method.find("reflection") is not None
        before = len(method.find("reflection"))
        for step in range(15, 20):
            view = made.scene.train[step % len(made.scene.train)]
            rendered = method.render(view.camera, step, Mode.TRAIN)
            method.losses(rendered, view, step).total.backward()
            if step == 15:
                (observed,) = [each for each in rendered.observations if each.set_name == "reflection"]
                signal, moved = observed.probe.grad, method.find("reflection").gaussians.means.grad
                assert signal is not None
                assert moved is not None
                assert torch.equal(signal.any(1), moved.any(1))
                met = moved.any(1)
                along = torch.nn.functional.cosine_similarity(signal[met], moved[met])
                assert float(along.median()) > 0.9, "half t times the gradient of the mean, hit by hit"
            method.after_step(step, rendered.observations)
        grown.append(len(method.find("reflection")) - before)
    assert grown[0] > 0
    assert grown[1] == 0


def test_the_tree_follows_every_change_of_the_set():
    method = new_method(recipe(), tiny(), schedule())
    method.begin(Stage("reflection", 15, 60))
    part, options = method.find("reflection"), method.parts["mirror"].trace_options(15, False)
    assert part is not None
    with torch.no_grad():
        part.gaussians.log_scales -= 1  # boxes that a stale tree cannot hit by luck
    generator = torch.Generator().manual_seed(0)
    beams = torch.randn(2, 40, 3, generator=generator).repeat_interleave(16, dim=1)  # narrow: a packet meets few boxes
    rays = [beam + 0.01 * torch.randn(640, 3, generator=generator) for beam in beams]

    def seen() -> torch.Tensor:
        """Through the set's own tree, which must be as good as a new one."""
        alpha = part.trace(*rays, options, watched=False)[0].alpha.detach()
        fresh = trace_set(part.gaussians, FollowingTree(1), *rays, options)  # type: ignore[arg-type]
        assert torch.equal(alpha, fresh.alpha.detach())
        return alpha

    start = part.gaussians.means.detach().clone()

    def shifted() -> None:
        """As a whole: neighbours stay neighbours, so that old boxes are tight."""
        with torch.no_grad():
            part.gaussians.means.copy_(start + 3 * torch.randn(1, 3, generator=generator))

    pictures, state = [seen()], {name: tensor.clone() for name, tensor in part.state().items()}
    for change in (
        lambda: part.step(15, 0),
        lambda: part.perturb(15, generator),
        lambda: part.load(state),
        part.reset_opacity,
        lambda: part.densify(generator),
    ):
        shifted()
        change()
        pictures.append(seen())
    different = [not torch.equal(one, other) for one, other in itertools.pairwise(pictures)]
    assert all(different)
    assert torch.equal(pictures[3], pictures[0]), "as it was when the state was taken"


def test_a_propagation_disturbs_the_colours_of_matte_surfels_alone():
    method = new_method(recipe(), tiny(), schedule())
    method.begin(Stage("reflection", 15, 60))
    base, settings = method["base"], PropagationSettings()
    with torch.no_grad():
        base.gaussians["specular_logits"].copy_(torch.linspace(-7, 1, len(base)))  # type: ignore[union-attr]
        base.gaussians.opacity_logits.copy_(torch.linspace(-3, 5, len(base)))
    before = base.gaussians.detached()
    specular = before["specular_logits"].sigmoid()  # type: ignore[union-attr]
    propagate_normals(base, settings, torch.Generator().manual_seed(0))
    after = base.gaussians.detached()
    noise = (after.sh_dc - before.sh_dc)[specular <= settings.sabotage_border]
    assert float(noise.abs().max()) <= settings.sabotage + 1e-6
    assert float(noise.std()) == pytest.approx(2 * settings.sabotage / 12**0.5, rel=0.1)
    assert torch.equal(
        after.sh_dc[specular > settings.sabotage_border], before.sh_dc[specular > settings.sabotage_border]
    )
    grown = (after.log_scales - before.log_scales).exp()
    expected = torch.where(specular >= settings.grow_border, settings.grow, 1.0)[:, None].expand_as(grown)
    torch.testing.assert_close(grown, expected)
    opaque = before.opacity_logits.sigmoid().clamp_min(settings.opacity)
    torch.testing.assert_close(after.opacity_logits.sigmoid(), opaque)


@pytest.mark.parametrize("name", ["envgs", "rtgs"])
def test_it_may_begin_as_a_copy_of_the_base_set(name: str):
    """Then it goes its own way: nothing of one is the other, and a resumed run ends the same."""
    made = tiny()
    method, other = (new_method(recipe(name, init_from="base"), made, schedule()) for _ in range(2))
    (event,) = [each for each in method.begin(Stage("reflection", 15, 60)) if each.kind == "begin"]
    base, reflection = method["base"].gaussians, method["reflection"].gaussians
    assert event.detail == f"{len(base)} surfels of the base set"
    assert reflection.channels == ()
    for each in reflection.names:
        assert torch.equal(reflection[each], base[each]), each
        assert reflection[each].data_ptr() != base[each].data_ptr(), each
    for step in range(15, 24):
        train_step(method, made, step)
    assert not torch.equal(method["reflection"].gaussians.opacity_logits, method["base"].gaussians.opacity_logits)
    other.load({key: tensor.clone() for key, tensor in method.state().items()})
    for step in range(24, 36):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert [key for key in expected if not torch.equal(found[key], expected[key])] == []


def test_a_copy_is_of_the_most_opaque_and_of_the_sets_own_degree():
    made = tiny()
    base = new_method(recipe(), made, schedule())["base"].gaussians
    with torch.no_grad():
        base.opacity_logits[:] = torch.arange(float(len(base))) / 100
        base.opacity_logits[7] = 9.0
    copied = copied_surfels(base, 20, 1)
    assert torch.equal(copied.means, base.means.detach()[[7, *range(len(base) - 19, len(base))]])
    assert (copied.sh_degree, copied.sh_rest.shape) == (1, (20, 3, 3))
    wider = copied_surfels(copied, 20, 3)
    assert wider.sh_degree == 3
    assert torch.equal(wider.sh_rest[:, :3], copied.sh_rest)
    assert not wider.sh_rest[:, 3:].any()
    few = DensitySettings(max_surfels=30)
    method = new_method(recipe(init_from="base", init=InitSettings(sh_degree=0), density=few), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    assert len(method["reflection"]) == 30
    assert method["reflection"].gaussians.sh_degree == 0
    thick = Ellipsoids(*(torch.zeros(2, *shape) for shape in ((3,), (3,), (4,), (), (3,), (0, 3))))
    with pytest.raises(TypeError, match="init_from=base"):
        copied_surfels(thick, 5, 0)
