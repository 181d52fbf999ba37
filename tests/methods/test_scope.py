"""Where a method may reflect: the sphere typed by hand, and that around the masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.gaussians.density import logit
from rtgs.mesh.silhouettes import MaskView, enclosing_sphere
from rtgs.methods import Mode
from rtgs.methods.gs3d_dr import DeferredSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.cubemap_mirror import WEIGHT, CubemapMirror
from rtgs.methods.ref_gs import FeatureSettings
from rtgs.methods.scope import Scope, ScopeSettings, scope_of
from rtgs.methods.settings import MethodSettings
from tests.methods.reflective_cases import MirrorScene, new_method, recipe, schedule, tiny, train_all, train_step

MIDDLE, RADIUS = (0.1, -0.05, 0.0), 0.4
MASKS = {"scope": "masks"}
WIDE = 0.8  # radius of a scope with many Gaussians inside and outside
TYPED = {"scope_radius": WIDE, "scope_center": list(MIDDLE)}
FLOOR = 0.3  # of m at resets


def mask_of(camera, center=MIDDLE, radius=RADIUS) -> torch.Tensor:
    """(H, W) bool: pixels whose ray passes the sphere."""
    rays = camera.rays(torch.float64)
    offset = torch.tensor(center, dtype=torch.float64) - rays.origin
    along = rays.directions / rays.directions.norm(dim=-1, keepdim=True)
    return (offset - (along @ offset)[..., None] * along).norm(dim=-1) <= radius


def masked(made: MirrorScene | None = None, every: int = 1, radius: float = RADIUS) -> MirrorScene:
    made = made or tiny()
    train = [
        replace(view, mask=mask_of(view.camera, radius=radius) if k % every == 0 else None)
        for k, view in enumerate(made.scene.train)
    ]
    return replace(made, scene=replace(made.scene, train=type(made.scene.train)(train)))


def test_the_sphere_around_masks_is_the_one_that_they_show():
    views = [MaskView(view.camera, mask_of(view.camera)) for view in tiny().scene.train]
    center, radius = enclosing_sphere(views)
    pixel = float(np.median([np.linalg.norm(v.camera.center.numpy() - MIDDLE) / v.camera.fx for v in views]))
    assert np.linalg.norm(center - MIDDLE) < pixel
    assert radius == pytest.approx(RADIUS, abs=1.5 * pixel)


def test_a_broken_mask_does_not_blow_it_up():
    views = [MaskView(view.camera, mask_of(view.camera)) for view in tiny().scene.train] * 2
    _, radius = enclosing_sphere(views)
    broken = views[0].mask.clone()
    broken[2, 2] = True
    _, found = enclosing_sphere([MaskView(views[0].camera, broken), *views[1:]])
    assert found < 1.3 * radius


def test_views_that_cut_the_object_count_only_where_all_do():
    views = [MaskView(view.camera, mask_of(view.camera)) for view in tiny().scene.train]
    _, radius = enclosing_sphere(views)
    cut = views[0].mask.clone()
    cut[:, 0] = True
    assert enclosing_sphere([MaskView(views[0].camera, cut), *views[1:]])[1] == pytest.approx(radius, rel=0.3)
    every = [MaskView(view.camera, torch.cat((view.mask[:, 4:], view.mask[:, :4] | True), 1)) for view in views]
    assert enclosing_sphere(every)[1] > 0


def test_a_scene_without_masks_has_no_scope_and_a_typed_one_needs_none():
    made = tiny()
    assert scope_of(ScopeSettings(scope="masks"), made.scene)[0] is None
    assert scope_of(ScopeSettings(), masked(made).scene) == (None, ())
    typed, _ = scope_of(ScopeSettings(scope_radius=0.5, scope_center=(1.0, 0.0, 0.0)), made.scene)
    assert typed is not None
    assert typed == Scope((1.0, 0.0, 0.0), 0.5)
    assert typed.holds(torch.tensor([[1.4, 0.0, 0.0], [0.4, 0.0, 0.0]])).tolist() == [True, False]


@pytest.mark.parametrize("name", ["ref_gs", "3dgs_dr"])
def test_masks_from_one_side_give_no_scope_and_that_is_said(name):
    made = tiny()
    plain = replace(recipe(name), own=MASKS, loss=replace(recipe().loss, normal=0.0))
    (first, *_) = masked(made).scene.train
    one_place = replace(made, scene=replace(made.scene, train=type(made.scene.train)([first] * 3)))
    for seen, why in (
        (masked(every=100), "seen from one side"),
        (one_place, "seen from one side"),
        (made, "there are no masks"),
    ):
        assert scope_of(ScopeSettings(scope="masks"), seen.scene)[0] is None
        (said,) = (each for each in new_method(plain, seen, schedule()).decisions if "scope" in each.what)
        assert why in said.why
    assert "no scope" not in str(new_method(plain, masked(), schedule()).decisions)


@pytest.mark.parametrize("settings", [DeferredSettings, FeatureSettings])
def test_masks_and_a_typed_sphere_exclude_each_other(settings):
    assert not settings().scoped
    with pytest.raises(RtgsError, match=r"method\.own\.scope_radius.*scope=masks"):
        settings(scope="masks", scope_radius=0.5)
    with pytest.raises(RtgsError, match=r"method\.own\.scope_center=\[0\.0, 0\.0, 0\.3\].*scope=masks"):
        settings(scope="masks", scope_center=[0.0, 0.0, 0.3])
    with pytest.raises(RtgsError, match=r"method\.own\.scope"):
        settings(scope="auto")


def test_ref_gs_shades_what_the_masks_enclose():
    made = masked()
    method = train_all(replace(recipe("ref_gs"), own=MASKS), made, schedule(opacity_reset_every=0))
    state = method.state()
    *center, radius = state["scope"].tolist()
    assert np.linalg.norm(np.array(center) - MIDDLE) < 0.1
    # Pictures are made with other training views, some of whose masks are missing, and must be the same.
    again = new_method(method.settings, masked(every=3), schedule(opacity_reset_every=0))
    again.load(state)
    typed_own = {"scope_radius": radius, "scope_center": center}
    typed = new_method(replace(method.settings, own=typed_own), tiny(), schedule(opacity_reset_every=0))
    typed.load({name: value for name, value in state.items() if name != "scope"})
    camera = made.scene.test[0].camera
    with torch.no_grad():
        shown = [each.render(camera, 60, Mode.EVALUATE).image for each in (method, again, typed)]
    assert torch.equal(shown[0], shown[1])
    assert torch.equal(shown[0], shown[2])


def test_trained_without_masks_it_has_no_scope_where_there_are_some():
    method = train_all(replace(recipe("ref_gs"), own=MASKS), tiny(), schedule(opacity_reset_every=0))
    assert "scope" not in method.state()
    again = new_method(method.settings, masked(), schedule(opacity_reset_every=0))
    again.load(method.state())
    camera = tiny().scene.test[0].camera
    with torch.no_grad():
        shown = [each.render(camera, 60, Mode.EVALUATE).image for each in (method, again)]
    assert torch.equal(*shown)


def test_3dgs_dr_pulls_down_what_the_masks_do_not_enclose():
    made = masked()
    plain = replace(recipe("3dgs_dr"), loss=replace(recipe().loss, normal=0.0))
    method = train_all(replace(plain, own=MASKS), made, schedule(opacity_reset_every=0))
    scope, _ = scope_of(ScopeSettings(scope="masks"), made.scene)
    assert scope is not None
    view, gaussians = made.scene.train[0], method["base"].gaussians
    far = ~scope.holds(gaussians.means.detach())
    assert 0 < int(far.sum()) < len(far)
    assert f"reflection in {scope}" in [each.what for each in method.decisions]
    terms = method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).terms
    (outside,) = [term for term in terms if term.name == "outside"]
    expected = gaussians[WEIGHT].detach()[far].sigmoid().mean()
    assert outside.value == pytest.approx(float(expected), rel=1e-5)
    bare = train_all(replace(plain, own=MASKS), tiny(), schedule(opacity_reset_every=0))
    terms = bare.losses(bare.render(view.camera, 59, Mode.TRAIN), view, 59).terms
    assert "outside" not in [term.name for term in terms]


# ---- 3DGS-DR acts inside alone: what is published leaves everything outside as it is


def deferred(own: dict) -> MethodSettings:
    plain = replace(recipe("3dgs_dr"), loss=replace(recipe().loss, normal=0.0))
    return replace(plain, own={**own, "weight_floor": FLOOR})


def begun(settings: MethodSettings, made: MirrorScene) -> Model:
    """In its second stage; of any m and opacity there are Gaussians inside and outside."""
    method = new_method(settings, made, schedule())
    for stage in method.stages:
        method.begin(stage)
    gaussians = method["base"].gaussians
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        gaussians[WEIGHT].copy_(8 * torch.rand(len(gaussians), generator=generator) - 7)
        gaussians.opacity_logits.copy_(8 * torch.rand(len(gaussians), generator=generator) - 3)
    return method


def changed(before: dict[str, torch.Tensor], method: Model) -> dict[str, torch.Tensor]:
    """(N,) bool by name: the rows of which some bit is another."""
    rows = {name: (before[name] != value.detach()) for name, value in method["base"].gaussians.items()}
    return {name: each.flatten(1).any(1) if each.ndim > 1 else each for name, each in rows.items()}


@pytest.mark.parametrize("own", [TYPED, MASKS], ids=["typed", "masks"])
@pytest.mark.parametrize("primitive", ["ellipsoids", "surfels"])
def test_3dgs_dr_propagates_and_resets_inside_alone(own: dict, primitive: str):
    made = masked(radius=WIDE)
    method = begun(deferred({**own, "primitive": primitive}), made)
    scope, _ = scope_of(ScopeSettings(**own), made.scene)
    mirror, gaussians = method.parts["mirror"], method["base"].gaussians
    assert scope is not None
    assert isinstance(mirror, CubemapMirror)
    inside = scope.holds(gaussians.means.detach())
    assert 20 < int(inside.sum()) < len(inside) - 20
    before = {name: value.detach().clone() for name, value in gaussians.items()}
    value, opacity = before[WEIGHT].sigmoid(), before["opacity_logits"]
    (event,) = mirror.control(24)
    expected = {"opacity_logits": opacity < logit(0.9), "log_scales": value >= 0.02, "sh_dc": value <= 0.05}
    found = changed(before, method)
    for name, rows in found.items():
        assert torch.equal(rows, inside & expected[name] if name in expected else torch.zeros_like(inside)), name
        assert name not in expected or bool((expected[name] & ~inside).any()), f"{name}: outside it would have changed"
    grown, disturbed = (int((inside & expected[name]).sum()) for name in ("log_scales", "sh_dc"))
    assert event.detail == f"normals propagated: {grown} surfels grown, colours of {disturbed} disturbed"
    before = {name: each.detach().clone() for name, each in gaussians.items()}
    mirror.after_reset()
    found = changed(before, method)
    assert torch.equal(found.pop(WEIGHT), inside & (value < FLOOR))
    assert not any(bool(rows.any()) for rows in found.values())


def test_without_a_scope_3dgs_dr_propagates_everywhere():
    method = begun(deferred({}), tiny())
    gaussians = method["base"].gaussians
    before = {name: value.detach().clone() for name, value in gaussians.items()}
    mirror = method.parts["mirror"]
    assert isinstance(mirror, CubemapMirror)
    list(mirror.control(24))
    assert torch.equal(changed(before, method)["opacity_logits"], before["opacity_logits"] < logit(0.9))
    mirror.after_reset()
    assert torch.equal(changed(before, method)[WEIGHT], before[WEIGHT].sigmoid() < FLOOR)


@pytest.mark.parametrize("own", [TYPED, MASKS], ids=["typed", "masks"])
def test_a_resumed_3dgs_dr_propagates_and_resets_inside_bit_for_bit(own: dict):
    """Propagations before steps 36 and 48 and a reset before 40 follow; masks are those of the first training."""
    made = masked(radius=WIDE)
    method = new_method(deferred(own), made, schedule())
    other = new_method(method.settings, masked(every=3, radius=WIDE), schedule())
    for stage in method.stages:
        method.begin(stage)
    for step in range(15, 33):
        train_step(method, made, step)
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    kinds = []
    for step in range(33, 50):
        kinds += [event.kind for event in train_step(method, made, step)[1]]
        train_step(other, made, step)
    assert (kinds.count("propagation"), kinds.count("opacity_reset")) == (2, 1)
    expected, found = method.state(), other.state()
    assert found.keys() == expected.keys()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
