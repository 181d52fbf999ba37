"""Without the guide nothing of a run depends on the object's mesh, with the settings exactly as they are shipped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch
from glass_cases import GlassScene, ball_mesh, begun, glass_scene, new_glass_method, train_stages
from reflective_cases import schedule
from test_paper_glass import smaller
from torch import Tensor

from rtgs.config import compose
from rtgs.mesh.container import ObjectGuide
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.settings import MethodSettings
from rtgs.scenes.scene import View

LAYERS = RenderOptions(layers=True)
SMALL = ("method.reflection.cells=3", "method.transmittance.cells=3", "method.transmittance.densify_from=2")
METHODS = ("rtgs", "rtgs_printed")


def shipped(method: str, *words: str) -> MethodSettings:
    """As a run of the ablation has them, the sets smaller."""
    return compose(["scene=ball_statue", f"method={method}", "preset=quick", *words, *SMALL])[0].method


def unguided(method: str, *words: str) -> MethodSettings:
    return shipped(method, "ablation=no_mesh_guide", *words)


@cache
def some_unmasked() -> GlassScene:
    """Two training views and the test view have no mask."""
    made = glass_scene(test_every=4)
    train = tuple(replace(view, mask=None) if index < 2 else view for index, view in enumerate(made.scene.train))
    test = (replace(made.scene.test[0], mask=None), *made.scene.test[1:])
    return replace(made, scene=replace(made.scene, train=train, test=test))


def with_smaller(made: GlassScene) -> GlassScene:
    return replace(made, mesh=smaller(made.mesh))


def with_pane(made: GlassScene) -> GlassScene:
    return replace(made, mesh=ball_mesh(flat=True))


def trained(settings: MethodSettings, made: GlassScene) -> Model:
    method = new_glass_method(settings, made, schedule(total=40, densify_from=4, densify_every=6))
    train_stages(method, made.scene)
    return method


def shown(method: Model, view: View) -> dict[str, Tensor]:
    with torch.no_grad():
        found = method.render(view.camera, 39, Mode.EVALUATE, LAYERS, view.mask)
    assert found.layers is not None
    layers = {name: layer for name, layer in found.layers.items() if layer is not None}
    return {"image": found.image, **found.maps, **layers}


@cache
def outcome(method: str, change: Callable[[GlassScene], GlassScene] | None) -> dict[str, Tensor]:
    """All that was trained, and all that test views show."""
    made = some_unmasked()
    model = trained(unguided(method), made if change is None else change(made))
    sets = {f"{part.name}.{name}": values for part in model.sets for name, values in part.gaussians.items()}
    assert {part.name for part in model.sets} == {"base", "reflection", "transmittance"}
    views = {f"{view.name}.{name}": map_ for view in made.scene.test for name, map_ in shown(model, view).items()}
    return {**sets, **views}


@pytest.mark.parametrize("change", [with_smaller, with_pane])
@pytest.mark.parametrize("method", METHODS)
def test_nothing_that_is_trained_or_shown_depends_on_the_mesh(method: str, change: Callable[[GlassScene], GlassScene]):
    found, other = outcome(method, None), outcome(method, change)
    assert found.keys() == other.keys()
    assert [name for name in found if not torch.equal(found[name], other[name])] == []


def test_the_settings_are_those_that_are_shipped():
    """The ones that another recipe of the tests does not have: what the test above was without."""
    ours = unguided("rtgs").transmittance
    assert (ours.contents, ours.start_opacity) == ("rasterized", 0.1)
    assert unguided("rtgs_printed").transmittance.contents == "traced"


@pytest.mark.parametrize("method", METHODS)
def test_a_view_without_a_mask_shows_no_glass_and_that_is_said(method: str):
    made = some_unmasked()
    model = begun(unguided(method), made)
    with_mask, without = made.scene.test[1], made.scene.test[0]
    assert with_mask.mask is not None
    assert torch.equal(shown(model, with_mask)["transparent"], with_mask.mask)
    assert not shown(model, without)["transparent"].any()
    (said,) = (each for each in model.decisions if "no glass" in each.what)
    total = len(made.scene.train) + len(made.scene.test)
    assert said.what == f"no glass in 3 of {total} views, {made.scene.train[0].name} first"
    assert "no glass" not in str(begun(unguided(method), glass_scene()).decisions)


def test_with_the_guide_a_view_without_a_mask_shows_the_silhouette():
    made = some_unmasked()
    model = begun(shipped("rtgs_printed"), made)
    found = shown(model, made.scene.test[0])["transparent"]
    assert torch.equal(found, ObjectGuide(made.mesh).surfaces(made.scene.test[0].camera).hit)
    assert "no glass" not in str(model.decisions)


@pytest.mark.parametrize("masks", ["given", "silhouette"])
def test_where_the_mesh_says_it_all_the_same_that_is_said(masks: str):
    settings = unguided("rtgs")
    asked = replace(settings, transmittance=replace(settings.transmittance, test_masks=masks))
    said = str(begun(asked, some_unmasked()).decisions)
    assert "the object's mesh says where glass is" in said
    assert f"test_masks={masks}" in said
    assert "mesh says" not in str(begun(settings, some_unmasked()).decisions)
