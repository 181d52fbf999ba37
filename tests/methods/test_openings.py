"""Openings of an object: what is judged, what an opening does to light, that a run goes on with it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_scene, new_glass_method, train_stages
from reflective_cases import schedule
from torch import Tensor

from benchmarks.common.mirror_scene import BALL, RADIUS
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.lathe import Axis, lathe
from rtgs.mesh.panels import parts_between_creases
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.parts import wall_light
from rtgs.methods.parts.exposure import Exposure
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.openings import Openings, judged_openings, upward_parts
from rtgs.methods.parts.part import Look
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.scenes.scene import View
from rtgs.train.method import RenderedView
from rtgs.train.trainer import Trainer

VOXEL = 0.02
STEP = 40
AXIS = Axis.along(BALL.double().numpy(), np.array([1.0, 0.3, 0.2]))  # lying: the cameras are all around


def cup() -> ObjectMesh:
    """A closed cylinder where the glass ball is: what a hull makes of a cup."""
    half, side = 0.6 * RADIUS, np.arange(-0.6 * RADIUS, 0.6 * RADIUS, 0.5 * VOXEL)
    radii = np.arange(0, half, 0.5 * VOXEL)
    profile = np.concatenate(
        [
            np.stack([radii, np.full_like(radii, -half)], axis=1),
            np.stack([np.full_like(side, half), side], axis=1),
            np.stack([np.append(half, radii[::-1]), np.full(len(radii) + 1, half)], axis=1),
        ]
    )
    return ObjectMesh(lathe(profile, AXIS, 64), "given", voxel=VOXEL, flat=False)


@pytest.fixture(scope="module")
def made() -> GlassScene:
    scene = glass_scene(8, 64, 48).scene
    mesh = cup()
    guide = ObjectGuide(mesh)
    views = tuple(replace(view, mask=guide.surfaces(view.camera).hit) for view in scene.train)
    return GlassScene(replace(scene, train=views), mesh)


def ends(mesh: ObjectMesh) -> tuple[Tensor, Tensor]:
    """(F,) bool: faces of the upper end, of the lower one."""
    normal = torch.from_numpy(mesh.mesh.face_normals())
    upright = normal @ torch.from_numpy(AXIS.frame[2]) / normal.norm(dim=1).clamp_min(1e-12)
    return upright > 0.9, upright < -0.9


def test_a_part_is_open_where_photos_are_met_better_without_a_wall(made: GlassScene):
    guide = ObjectGuide(made.mesh)
    up, down = ends(made.mesh)
    _, *parts = (torch.from_numpy(part) for part in parts_between_creases(made.mesh.mesh, VOXEL))
    assert len(parts) == 2

    def shown(view: View, opened: Tensor) -> Tensor:
        """Off by .1 where the upper end is a wall, and where the lower one is none."""
        surfaces = guide.surfaces(view.camera)
        first = surfaces.triangle.clamp_min(0).long()
        wrong = surfaces.hit & ((up & ~opened)[first] | (down & opened)[first])
        shift = torch.where(wrong, 0.1, 0.05)
        return view.image + torch.where(view.image > 0.5, -shift, shift)

    found = judged_openings(made.mesh, parts, made.scene.train, shown, 0.02)
    assert found is not None
    assert len(found.found) == 2
    assert bool((found.faces & up).any())
    assert not bool((found.faces & ~up).any())
    assert float(found.faces.sum()) > 0.8 * float(up.sum()), "all of it but its crease"
    gains = sorted(found.found[:, 1].tolist())
    assert gains == pytest.approx([-3.0, 0.75])
    (decision,) = found.decisions
    assert "error -75.0% without one" in decision.why
    again = Openings.of(found.state(), 0.02)
    assert again is not None
    assert torch.equal(again.faces, found.faces)
    assert not bool(Openings(found.part, found.found, 0.8).faces.any()), "a gain below what is asked for"


def looking_along(view: View, up: Tensor) -> View:
    """The view's camera turned so that ``up`` (3,) is upward in the picture."""
    across = torch.linalg.cross(up, torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    across /= across.norm()
    rotation = torch.stack([across, -up, torch.linalg.cross(across, -up)])
    return replace(view, camera=replace(view.camera, rotation=rotation))


def test_nothing_is_judged_that_has_no_part_or_no_view(made: GlassScene):
    def shown(view: View, opened: Tensor) -> Tensor:
        raise AssertionError("no picture is made in vain")

    assert judged_openings(made.mesh, [], made.scene.train, shown, 0.02) is None
    blind = [replace(view, mask=None) for view in made.scene.train]
    assert judged_openings(made.mesh, list(ends(made.mesh)), blind, shown, 0.02) is None


def test_what_looks_up_may_be_open(made: GlassScene):
    up, down = ends(made.mesh)
    assert upward_parts(made.mesh, made.scene.train) == [], "the cylinder lies"
    for end, sign in ((up, 1.0), (down, -1.0)):
        turned = [looking_along(view, sign * torch.from_numpy(AXIS.frame[2])) for view in made.scene.train]
        (part,) = upward_parts(made.mesh, turned)
        assert bool(part.any())
        assert not bool((part & ~end).any())
    assert upward_parts(glass_scene().mesh, turned) == [], "a ball is one part"


def turned_mesh(*corners: tuple[float, float]) -> ObjectMesh:
    """A profile through these corners (radius, height), a vertex every half voxel; its axis is z."""
    nodes = [np.array(corners[:1])]
    for start, end in itertools.pairwise(np.array(corners)):
        count = max(round(float(np.linalg.norm(end - start)) / (0.5 * VOXEL)), 1)
        nodes.append(start + (end - start) * (np.arange(count) + 1)[:, None] / count)
    axis = Axis.along(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return ObjectMesh(lathe(np.concatenate(nodes), axis), "given", voxel=VOXEL, flat=False)


def test_a_wide_lid_may_be_open_and_a_wall_that_leans_may_not(made: GlassScene):
    views = [looking_along(view, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)) for view in made.scene.train[:1]]
    dish = turned_mesh((0, 0), (0.5, 0), (0.5, 0.2), (0, 0.2))
    (lid,) = upward_parts(dish, views)
    assert float(dish.mesh.vertices[dish.mesh.faces[lid.numpy()]][..., 2].min()) == pytest.approx(0.2)
    stepped = turned_mesh((0, 0), (0.4, 0), (0.4, 0.3), (0.32, 0.3), (0.31, 0.7), (0, 0.7))
    parts = upward_parts(stepped, views)
    heights = [stepped.mesh.vertices[stepped.mesh.faces[part.numpy()]][..., 2] for part in parts]
    assert all(float(np.ptp(height)) < 1e-6 for height in heights), "no wall among them"
    assert any(float(height.max()) == pytest.approx(0.7) for height in heights)


def opened(method, faces: Tensor) -> Glass:
    """The method's glass with these faces as openings."""
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    assert glass.wall is not None
    glass.wall.restore(Openings(faces.to(torch.uint8), torch.tensor([[0.2, 0.5]]), 0.02).state())
    return glass


def test_an_opening_mirrors_nothing_on_either_side(made: GlassScene):
    method = begun(fresnel(), made)
    up, _ = ends(made.mesh)
    first, far = 0, 0
    for view in made.scene.train:
        with torch.no_grad():
            closed = method.render(view.camera, STEP, Mode.EVALUATE, RenderOptions(layers=True), view.mask)
        glass = opened(method, up)
        with torch.no_grad():
            open_ = method.render(view.camera, STEP, Mode.EVALUATE, RenderOptions(layers=True), view.mask)
        glass.wall.restore({})  # type: ignore[union-attr]
        assert glass.guide is not None
        assert closed.layers is not None
        assert open_.layers is not None
        surfaces = glass.guide.surfaces(view.camera)
        through = surfaces.hit & up[surfaces.triangle.clamp_min(0).long()]
        first += int(through.sum())
        if through.any():
            assert float(open_.layers["reflection"][:, through].abs().max()) == 0
            assert float(closed.layers["reflection"][:, through].max()) > 0.02
        sides = surfaces.hit & ~through
        torch.testing.assert_close(open_.layers["reflection"][:, sides], closed.layers["reflection"][:, sides])
        far += int((open_.layers["inner"] - closed.layers["inner"])[:, sides].abs().amax(0).gt(1e-4).sum())
    assert first > 100
    assert far > 20, "light leaves through the opening undimmed, and is not mirrored at it"


@pytest.fixture
def standing(made: GlassScene, monkeypatch: pytest.MonkeyPatch) -> GlassScene:
    """Where the cylinder's upper end looks up, as far as the judge knows."""
    up, _ = ends(made.mesh)
    parts = [torch.from_numpy(part) for part in parts_between_creases(made.mesh.mesh, VOXEL)[1:]]
    looking_up = [part for part in parts if bool((part & up).any())]
    monkeypatch.setattr(wall_light, "upward_parts", lambda mesh, views: looking_up)
    return made


def test_before_it_is_judged_a_part_is_open_by_turns_in_training_alone(standing: GlassScene):
    made = standing
    method = begun(fresnel(openings=0.5), made)
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    up, _ = ends(made.mesh)
    view = made.scene.train[0]
    index = torch.arange(view.camera.height * view.camera.width)
    known = []
    for step, mode in ((30, Mode.TRAIN), (31, Mode.TRAIN), (31, Mode.EVALUATE), (55, Mode.TRAIN)):
        with torch.no_grad():
            method.render(view.camera, step, mode, mask=view.mask)
        assert glass.wall is not None
        walls = glass.wall.walls(view.camera, index)
        known.append(walls is not None and bool((walls == 0).any()))
    sees = bool(up[glass.guide.surfaces(view.camera).triangle.clamp_min(0).long()].any())  # type: ignore[union-attr]
    assert sees
    assert known == [False, True, False, False]


def test_paths_behind_walls_stay_found_where_nothing_is_judged_open(standing: GlassScene):
    glass = begun(fresnel(openings=0.5), standing).parts["glass"]
    assert isinstance(glass, Glass)
    assert glass.wall is not None
    glass.wall.set_for(30)
    closed = glass.wall._inner
    glass.wall.set_for(31)
    assert glass.wall._inner is not closed
    glass.wall.restore({})
    assert glass.wall._inner is closed


def looked(method: Model, step: int) -> Look:
    """As the model looks at its training views between steps."""

    def look(view: View, options: RenderOptions) -> RenderedView:
        return method.render(view.camera, step, Mode.EVALUATE, options, view.mask)

    return look


def test_a_run_judges_once_and_goes_on_bit_for_bit(standing: GlassScene):
    made = standing
    method = begun(fresnel(openings=0.2), made)
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    assert glass.plan.start < glass.plan.judged < 60
    wall, while_looking = glass.wall, []
    assert wall is not None

    def noted(step: int) -> Look:
        look = looked(method, step)

        def noting(view: View, options: RenderOptions) -> RenderedView:
            while_looking.append(wall.judging)
            return look(view, options)

        return noting

    said = [event for step in range(glass.plan.start + 1, 60) for event in glass.judge(step, noted(step))]
    assert len(said) == 1
    assert while_looking
    assert all(while_looking)
    assert not wall.judging
    assert said[0].detail.startswith("openings of the object: ")
    state = {name: value.clone() for name, value in method.state().items()}
    assert "openings.part" in state
    other = begun(fresnel(openings=0.2), made)
    other.load(state)
    view = made.scene.train[0]
    for each in (method, other):
        assert each.decisions == method.decisions
    with torch.no_grad():
        images = [each.render(view.camera, STEP, Mode.EVALUATE, mask=view.mask).image for each in (method, other)]
    assert torch.equal(*images)
    never = begun(fresnel(), made)
    none = [event for step in range(60) for event in never.parts["glass"].judge(step, looked(never, step))]
    assert none == []


def test_photos_are_judged_as_they_were_exposed(standing: GlassScene, monkeypatch: pytest.MonkeyPatch):
    """A photo that is a stop brighter than the others says nothing about openings."""
    views = [replace(each, camera=replace(each.camera, name=each.name)) for each in standing.scene.train]
    made = replace(standing, scene=replace(standing.scene, train=tuple(views)))
    method = begun(replace(fresnel(openings=0.2), appearance=AppearanceSettings(enabled=True)), made)
    glass, exposure = method.parts["glass"], method.parts["exposure"]
    assert isinstance(glass, Glass)
    assert isinstance(exposure, Exposure)
    view = made.scene.train[0]
    with torch.no_grad():
        exposure.group["stops"][exposure.rows[view.name]] = 1.0
    seen: list[Tensor] = []

    def judged(look: Callable[[View], Tensor]) -> str:
        seen.append(look(view))
        return "none"

    monkeypatch.setattr(glass.wall, "judge", judged)
    following = glass.plan.judged
    with torch.no_grad():
        events = list(method._between(following))
        shown = method.render(view.camera, following, Mode.EVALUATE, RenderOptions(masks="given"), view.mask)
        exposure.group["stops"].zero_()
        plain = method.render(view.camera, following, Mode.EVALUATE, RenderOptions(masks="given"), view.mask)
    assert any("openings of the object: none" in event.detail for event in events)
    torch.testing.assert_close(seen[0], 2 * plain.image)
    torch.testing.assert_close(seen[0], shown.image)


@pytest.mark.parametrize("killed", [-1, 0, 1])
def test_a_run_that_is_killed_around_the_judging_ends_with_the_same_bits(
    standing: GlassScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: int
):
    judge = wall_light.judged_openings

    def opened(*given) -> Openings | None:
        found = judge(*given)
        return None if found is None else Openings(found.part, 0 * found.found + 0.5, found.least)

    monkeypatch.setattr(wall_light, "judged_openings", opened)
    settings, plan = fresnel(openings=0.2), replace(schedule(), checkpoint_every=1)
    whole = new_glass_method(settings, standing, plan)
    train_stages(whole, standing.scene)
    died = new_glass_method(settings, standing, plan)
    glass = died.parts["glass"]
    assert isinstance(glass, Glass)
    render, end = died.render, glass.plan.judged + killed

    def dying(camera: Camera, step: int, *given, **more):
        if step >= end:
            raise KeyboardInterrupt
        return render(camera, step, *given, **more)

    monkeypatch.setattr(died, "render", dying)
    with pytest.raises(KeyboardInterrupt):
        train_stages(died, standing.scene, folder=tmp_path)
    again = new_glass_method(settings, standing, plan)
    Trainer(again, standing.scene, seed=3, stage=again.stages[-1], checkpoint_dir=tmp_path).run()
    expected, found = whole.state(), again.state()
    assert expected.keys() == found.keys()
    assert "openings.part" in found
    assert [name for name, value in expected.items() if not torch.equal(value, found[name])] == []


def test_a_trained_run_says_what_was_open(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    up, _ = ends(made.mesh)
    found = Openings(up.to(torch.uint8), torch.tensor([[0.2, 0.5]]), 0.02)
    monkeypatch.setattr(wall_light, "judged_openings", lambda *given: found)
    method = begun(fresnel(openings=0.2), made)
    assert method.decisions == begun(fresnel(), made).decisions
    train_stages(method, made.scene)
    assert [each.why for each in method.decisions if each.what == "an opening"] == [
        "no wall in 20.0% of the object's mesh: error -50.0% without one"
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"openings": 1.0}, r"wall\.openings=1\.0 must be between 0 \(never\) and 1"),
        ({"openings": -0.1}, r"wall\.openings=-0\.1 must be"),
        ({"opening_gain": 1.0}, r"wall\.opening_gain=1\.0 must be below 1"),
    ],
)
def test_settings_that_do_not_fit_are_refused(changes: dict, message: str):
    with pytest.raises(RtgsError, match=message):
        fresnel(**changes)
