"""Nothing mirrors beside a transparent object: no ray is sent from there, and surfaces show their own colours."""

from __future__ import annotations

import pytest
import torch
from glass_cases import begun, glass_recipe, glass_scene, randomised
from torch import Tensor

from rtgs.evaluate.layers import added_by_base
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.render.buffers import TraceOptions
from rtgs.train.method import RenderedView

WHAT = "nothing mirrors beside the transparent object"
made = glass_scene(4)
view = made.scene.train[0]
WIDTH = view.camera.width


def left(columns: int) -> Tensor:
    """The mask of so many columns."""
    return (torch.arange(WIDTH) < columns).expand(view.camera.height, WIDTH)


def shown(
    method: Model, mode: Mode, monkeypatch: pytest.MonkeyPatch, mask: Tensor | None = view.mask
) -> tuple[RenderedView, int]:
    """The first view, and how many mirror rays were traced for it."""
    traced = []
    mirror = method["reflection"].trace

    def count(origins: Tensor, directions: Tensor, options: TraceOptions, *, watched: bool):
        traced.append(len(origins))
        return mirror(origins, directions, options, watched=watched)

    monkeypatch.setattr(method["reflection"], "trace", count)
    rendered = method.render(view.camera, 40, mode, options=RenderOptions(layers=True), mask=mask)
    return rendered, sum(traced)


@pytest.mark.parametrize("mode", [Mode.TRAIN, Mode.EVALUATE])
def test_pixels_beside_the_object_show_their_own_colours(mode: Mode, monkeypatch: pytest.MonkeyPatch):
    method = begun(glass_recipe(mirrors_beside=False), made)
    randomised(method)
    rendered, rays = shown(method, mode, monkeypatch)
    glass = rendered.maps["transparent"]
    assert glass is not None
    assert rendered.layers is not None
    assert 0 < int(glass.sum()) < glass.numel()
    assert rays == int(glass.sum())
    diffuse = rendered.layers["diffuse"]
    assert torch.equal(rendered.image[:, ~glass], diffuse[:, ~glass])
    assert float((rendered.image - diffuse)[:, glass].detach().abs().max()) > 1e-3
    assert torch.equal(added_by_base(rendered.layers)[:, ~glass], diffuse[:, ~glass])  # as the report shows it
    assert [each.what for each in method.decisions].count(WHAT) == 1


@pytest.mark.parametrize(
    "changes", [{}, {"mirrors_beside": False, "first_bounce": "none"}], ids=["as it is", "no rays in glass at all"]
)
def test_a_scene_with_mirrors_keeps_them(changes: dict[str, object], monkeypatch: pytest.MonkeyPatch):
    method = begun(glass_recipe(**changes), made)
    randomised(method)
    rendered, rays = shown(method, Mode.EVALUATE, monkeypatch)
    glass = view.mask
    assert glass is not None
    assert rendered.layers is not None
    assert rays > int(glass.sum())
    assert float((rendered.image - rendered.layers["diffuse"])[:, ~glass].detach().abs().max()) > 1e-3
    assert WHAT not in [each.what for each in method.decisions]


def test_a_view_without_the_object_sends_no_ray_and_still_teaches(monkeypatch: pytest.MonkeyPatch):
    method = begun(glass_recipe(mirrors_beside=False), made)
    randomised(method)
    rendered, rays = shown(method, Mode.TRAIN, monkeypatch, left(0))
    assert rendered.layers is not None
    assert rays == 0
    assert torch.equal(rendered.image, rendered.layers["diffuse"])
    (gradient,) = torch.autograd.grad(rendered.image.sum(), method["base"].gaussians["sh_dc"])
    assert bool(gradient.isfinite().all())
    assert bool(gradient.any())


def test_masked_pixels_mirror_where_the_mesh_does_not_reach(monkeypatch: pytest.MonkeyPatch):
    method = begun(glass_recipe(mirrors_beside=False), made)
    randomised(method)
    rendered, rays = shown(method, Mode.TRAIN, monkeypatch, left(WIDTH // 2))
    glass = rendered.maps["transparent"]
    assert glass is not None
    assert int((left(WIDTH // 2) & ~view.mask).sum()) > 50
    assert bool(glass[left(WIDTH // 2)].all())
    assert rays == int(glass.sum())


def test_where_nothing_was_met_nothing_is_traced(monkeypatch: pytest.MonkeyPatch):
    """Masked or not."""
    method = begun(glass_recipe(mirrors_beside=False), made)
    randomised(method)
    with torch.no_grad():
        for part in method.sets:
            part.gaussians.opacity_logits.fill_(-20.0)
    rendered, rays = shown(method, Mode.EVALUATE, monkeypatch)
    assert bool(rendered.maps["transparent"].any())
    assert rays == 0


def test_how_specular_they_are_learns_nothing_from_them():
    """The gradient of k_s comes from the object's pixels alone."""
    method = begun(glass_recipe(mirrors_beside=False), made)
    randomised(method)
    rendered = method.render(view.camera, 40, Mode.TRAIN, mask=view.mask)
    specular = method["base"].gaussians["specular_logits"]
    glass = rendered.maps["transparent"]
    assert glass is not None
    outside, inside = (
        torch.autograd.grad(rendered.image[:, where].sum(), specular, retain_graph=True, allow_unused=True)[0]
        for where in (~glass, glass)
    )
    assert outside is None or not bool(outside.any())
    assert inside is not None
    assert bool(inside.any())
