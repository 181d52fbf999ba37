"""The scope found in training: when it is looked for, around what, what is done with it, resume, refusals."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_step
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.common.mirror_scene import BALL, RADIUS, MirrorScene, ball_hit, mirror_scene
from rtgs.core.errors import RtgsError
from rtgs.gaussians.density import logit
from rtgs.gaussians.settings import MaterialSettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode
from rtgs.methods.gs3d_dr import DeferredSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.cubemap_mirror import WEIGHT
from rtgs.methods.parts.feature_mirror import OUTSIDE, ROUGHNESS, SH_IMAGE
from rtgs.methods.parts.scope import ScopeHolder
from rtgs.methods.ref_gs import FeatureSettings
from rtgs.methods.scope import Scope, ScopeSettings
from rtgs.methods.settings import MethodSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.settings import LossSettings, ScheduleSettings

BOTH = pytest.mark.parametrize("name", ["3dgs_dr", "ref_gs"])
LOOKED_AT = 29  # of 60 steps, the second stage from 15 on


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


# ---- when


def test_the_step_is_a_share_of_the_stage_or_right_before_the_next_reset():
    own = ScopeSettings(scope="specular")
    quiet = ScheduleSettings(total=2000, opacity_reset_every=0)
    assert own.looked_at(600, quiet) == 1020
    paper = ScheduleSettings(total=97_000, opacity_reset_every=3_000, densify_until=66_000)
    assert own.looked_at(3_000, paper) == 33_000  # 31,200 would be soon after the reset of 30,000
    late = replace(own, scope_at=0.7)
    assert late.looked_at(3_000, paper) == 68_800, "no reset comes any more"
    assert replace(own, scope_at=1.0).looked_at(600, quiet) == 1999, "the last that trains with it"
    assert own.looked_at(1999, quiet) == 2000, "a stage of one step: never"


# ---- in training


def settings(name: str, **own) -> MethodSettings:
    """The family's short recipe with small maps."""
    light = EnvironmentSettings(side=16, initial=0.0, noise=0.0, rate=0.02)
    found = replace(recipe(name), environment=light, own={"scope": "specular", **own})
    return replace(found, loss=LossSettings(normal=0.0)) if name == "3dgs_dr" else found


def plan(**changes: int) -> ScheduleSettings:
    return schedule(**({"opacity_reset_every": 0} | changes))


def begun(asked: MethodSettings, made: MirrorScene, when: ScheduleSettings | None = None) -> Model:
    method = new_method(asked, made, when or plan())
    for stage in method.stages:
        method.begin(stage)
    return method


def polished(method: Model) -> None:
    """What is near the ball mirrors, the rest is rough and does not."""
    gaussians = method["base"].gaussians
    near = (gaussians.means.detach() - BALL).norm(dim=1) < 1.1 * RADIUS
    with torch.no_grad():
        if WEIGHT in gaussians:
            gaussians[WEIGHT][:] = torch.where(near, logit(0.9), logit(0.01))
        else:
            gaussians[ROUGHNESS][:] = torch.where(near, logit(0.1), logit(0.9))
        gaussians.opacity_logits[:] = logit(0.95)


def run(method: Model, made: MirrorScene, start: int, end: int) -> list[tuple[int, str]]:
    """Steps from ``start`` to before ``end``; what was decided about the scope, with the step that follows."""
    told = []
    for step in range(start, end):
        _, events = train_step(method, made, step)
        told += [(step + 1, each.detail) for each in events if each.kind == "decision" and each.set_name == "scope"]
    return told


def holder(method: Model) -> ScopeHolder:
    part = method.parts["scope"]
    assert isinstance(part, ScopeHolder)
    return part


def unequal(one: dict[str, Tensor], other: dict[str, Tensor]) -> list[str]:
    assert one.keys() == other.keys()
    return [name for name in one if not torch.equal(one[name], other[name])]


@BOTH
def test_it_is_found_around_what_mirrors_and_holds_from_then_on(name: str):
    made = mirror_scene(8, 48, 36, points=800, test_every=8)
    method = begun(settings(name), made)
    assert run(method, made, 15, LOOKED_AT - 1) == []
    assert (holder(method).scope, holder(method).decisions) == (None, ())
    polished(method)
    ((step, detail),) = run(method, made, LOOKED_AT - 1, LOOKED_AT)
    scope = holder(method).scope
    assert step == holder(method).looked_at == LOOKED_AT
    assert scope is not None
    np.testing.assert_allclose(scope.center, BALL.numpy(), atol=0.3)
    assert scope.radius == pytest.approx(1.1 * RADIUS, rel=0.25)
    (said,) = holder(method).decisions
    assert said.what == f"reflection in {scope}"
    assert "% of the training views' pixels are specular before step 29 (method.own.scope=specular)" in said.why
    assert detail == f"{said.what}: {said.why}"
    assert said in method.decisions
    assert run(method, made, LOOKED_AT, LOOKED_AT + 4) == [], "it is decided once"
    assert holder(method).scope == scope


def test_3dgs_dr_has_no_loss_before_and_that_of_the_sphere_after():
    made = mirror_scene(8, 48, 36, points=800, test_every=8)
    method = begun(settings("3dgs_dr"), made)
    run(method, made, 15, LOOKED_AT - 1)
    polished(method)
    view = made.scene.train[0]

    def terms(step: int) -> dict[str, float]:
        shown = method.render(view.camera, step, Mode.TRAIN)
        return {term.name: term.value for term in method.losses(shown, view, step).terms}

    assert "outside" not in terms(LOOKED_AT - 1)
    run(method, made, LOOKED_AT - 1, LOOKED_AT)
    scope, gaussians = holder(method).scope, method["base"].gaussians
    assert scope is not None
    far = ~scope.holds(gaussians.means.detach())
    assert 0 < int(far.sum()) < len(far)
    assert terms(LOOKED_AT)["outside"] == pytest.approx(float(gaussians[WEIGHT].detach()[far].sigmoid().mean()), 1e-5)


def test_colours_of_ref_gs_learn_everywhere_until_it_is_known_what_lies_outside():
    made = mirror_scene(8, 48, 36, points=800, test_every=8)
    method = begun(settings("ref_gs"), made)
    polished(method)
    view = made.scene.train[0]
    before = method.render(view.camera, LOOKED_AT - 1, Mode.TRAIN)
    torch.testing.assert_close(before.maps[OUTSIDE], before.buffers.alpha.detach())
    method.losses(before, view, LOOKED_AT - 1).total.backward()
    gradient = method["base"].gaussians.sh_dc.grad
    assert gradient is not None
    assert gradient.abs().sum() > 0
    method.after_step(LOOKED_AT - 1, before.observations)
    scope, rendered = holder(method).scope, method.render(view.camera, LOOKED_AT, Mode.TRAIN)
    assert scope is not None
    far = ~scope.holds(method["base"].gaussians.means.detach())
    weight, _ = method.base.weight_of(far, view.camera, LOOKED_AT)
    torch.testing.assert_close(rendered.maps[OUTSIDE], weight, atol=1e-5, rtol=0)
    assert not rendered.maps[OUTSIDE].requires_grad
    assert SH_IMAGE in rendered.maps


@BOTH
def test_too_few_specular_pixels_give_none_and_that_is_said(name: str):
    made = tiny()
    method = begun(settings(name, scope_specular=1.0), made)
    ((step, detail),) = run(method, made, 15, 40)
    assert step == LOOKED_AT
    (said,) = holder(method).decisions
    assert said.what == "no scope, all may reflect"
    assert said.why == (
        "0 % of the training views' pixels are specular before step 29, and 0.2 % must be (method.own.scope=specular)"
    )
    assert detail == f"{said.what}: {said.why}"
    assert holder(method).scope is None
    state = method.state()
    assert "scope" not in state
    assert float(state["scope_share"]) == 0
    again = new_method(method.settings, made, plan())
    again.load(state)
    assert said in again.decisions
    assert run(again, made, 40, 42) == []


def test_to_look_changes_nothing():
    made = tiny()
    found = []
    for own in ({"scope": "specular", "scope_specular": 1.0}, {}):
        method = begun(replace(settings("3dgs_dr"), own=own), made)
        run(method, made, 15, 40)
        found.append({name: value for name, value in method.state().items() if name != "scope_share"})
    assert unequal(*found) == []


@BOTH
@pytest.mark.parametrize("killed", [LOOKED_AT - 3, LOOKED_AT, LOOKED_AT + 3], ids=["before", "at", "after"])
def test_resume_is_bit_for_bit(name: str, killed: int):
    made = tiny()
    low = {"scope_specular": 0.002 if name == "3dgs_dr" else 0.5}
    method = begun(settings(name, **low), made)
    told = run(method, made, 15, killed)
    other = new_method(method.settings, made, plan())
    other.load({key: value.clone() for key, value in method.state().items()})
    assert holder(other).decisions == holder(method).decisions
    for each in (method, other):
        rest = run(each, made, killed, LOOKED_AT + 12)
        assert [step for step, _ in (*told, *rest)] == [LOOKED_AT]
    assert {"scope", "scope_share"} <= method.state().keys()
    assert unequal(method.state(), other.state()) == []
    camera = made.scene.test[0].camera
    again = new_method(method.settings, made, plan())
    again.load(method.state())
    with torch.no_grad():
        assert torch.equal(*(each.render(camera, 41, Mode.EVALUATE).image for each in (method, again)))


@BOTH
def test_a_state_of_the_first_stage_leaves_it_open_again(name: str):
    made = tiny()
    method = begun(settings(name, scope_specular=0.002), made)
    run(method, made, 15, LOOKED_AT)
    assert not holder(method).pending
    method.load(new_method(method.settings, made, plan()).state())
    assert holder(method).pending
    assert (holder(method).scope, holder(method).decisions) == (None, ())


@BOTH
def test_no_bit_depends_on_the_threads(name: str):
    made = mirror_scene(3, 120, 90, points=1000, test_every=3)
    states = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        method = begun(settings(name), made)
        polished(method)
        run(method, made, LOOKED_AT - 1, LOOKED_AT + 2)
        states.append({key: value.clone() for key, value in method.state().items()})
    assert "scope" in states[0]
    assert unequal(states[0], states[1]) == unequal(states[0], states[2]) == []


def test_a_stage_that_is_too_short_to_look_says_so():
    short = replace(settings("3dgs_dr"), reflection=replace(recipe().reflection, start=0.99))
    (said,) = holder(new_method(short, tiny(), plan())).decisions
    assert said.what == "no scope, all may reflect"
    assert "too short" in said.why


def test_without_its_loss_the_scope_still_bounds_propagation_and_resets_and_that_is_said():
    method = new_method(settings("3dgs_dr", outside=0.0), tiny(), plan())
    assert "scope" in method.parts
    assert "outside" not in {term.name for term in method.loss.terms}
    assert "no loss of the weights outside of the scope: method.own.outside=0" in "; ".join(map(str, method.decisions))


# ---- a training that finds the ball


def far_ball(views: int = 10, width: int = 40, height: int = 30, points: int = 2000) -> Scene:
    """A mirror ball under a sky of smooth colours, with points on both."""

    def sky(directions: Tensor) -> Tensor:
        return 0.5 + 0.4 * torch.sin(4 * directions + torch.tensor([0.0, 1.3, 2.6]))

    train = []
    for view in mirror_scene(views, width, height, points=5, test_every=views + 1).scene.train:
        rays = view.camera.rays()
        direction = normalize(rays.directions.reshape(-1, 3), dim=1)
        hit, along = ball_hit(rays.origin.expand_as(direction), direction)
        normal = (rays.origin + along[:, None] * direction - BALL) / RADIUS
        mirrored = direction - 2 * (direction * normal).sum(1, keepdim=True) * normal
        color = torch.where(hit[:, None], sky(mirrored), sky(direction))
        train.append(View(view.camera, color.T.reshape(3, height, width).contiguous(), None, None, view.name))
    generator = torch.Generator().manual_seed(5)
    away, around = (normalize(torch.randn(n, 3, generator=generator), dim=1) for n in (points, points // 4))
    position = torch.cat((30 * away, BALL + RADIUS * around))
    colors = torch.cat((sky(away), torch.full((points // 4, 3), 0.5)))
    return Scene("far_ball", tuple(train), (), position, colors, 2.4, "made")


@pytest.mark.parametrize("primitive", ["ellipsoids", "surfels"])
def test_training_finds_the_mirror_ball(primitive: str):
    scene = far_ball()
    made = MirrorScene(scene, {})
    asked = settings("3dgs_dr", primitive=primitive, scope_at=0.8, scope_specular=0.2)
    asked = replace(
        asked,
        environment=replace(asked.environment, rate=0.1),
        materials=MaterialSettings(specular=0.01),
        optimizer=replace(asked.optimizer, specular_logits=0.05),
        reflection=replace(asked.reflection, start=0.3, propagation=replace(asked.reflection.propagation, every=0)),
    )
    method = new_method(asked, made, plan(total=300, sh_every=10_000, densify_until=0))
    for stage in method.stages:
        method.begin(stage)
        run(method, made, stage.from_step, min(stage.until, 259))
    scope = holder(method).scope
    assert holder(method).looked_at == 258
    assert scope is not None, str(method.decisions)
    assert math.dist(scope.center, BALL.tolist()) < 0.3, str(scope)
    assert RADIUS < scope.radius < 1.7 * RADIUS, f"the sky is 30 away: {scope}"


# ---- what is refused


@pytest.mark.parametrize("kind", [DeferredSettings, FeatureSettings])
def test_a_typed_sphere_and_shares_that_make_no_sense_are_refused(kind: type[ScopeSettings]):
    assert kind(scope="specular").scoped
    with pytest.raises(RtgsError, match=r"method\.own\.scope_radius=0\.5 must be 0 with method\.own\.scope=specular"):
        kind(scope="specular", scope_radius=0.5)
    with pytest.raises(RtgsError, match=r"method\.own\.scope_center=\[0\.0, 0\.0, 0\.3\].*scope=specular"):
        kind(scope="specular", scope_center=(0.0, 0.0, 0.3))
    for key, value in (("scope_at", 0.0), ("scope_at", 1.5), ("scope_specular", 0.0), ("scope_share", -0.1)):
        with pytest.raises(RtgsError, match=rf"method\.own\.{key}"):
            kind(scope="specular", **{key: value})
    with pytest.raises(RtgsError, match=r"method\.own\.scope_margin"):
        kind(scope="specular", scope_margin=0.0)


def test_the_sphere_is_written_with_its_numbers():
    assert str(Scope((0.123456, -1.0, 0.0), 2.0)) == "a sphere of 2 around (0.123, -1, 0)"
