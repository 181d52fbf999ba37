"""Vertices of the object's mesh that learn from the photos: what moves, what holds them, and that a run goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glass_cases import GlassScene, ball_mesh, begun, fresnel, glass_scene, new_glass_method, randomised, train_stages
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode
from rtgs.methods.model import Model
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.vertices import LearnedVertices
from rtgs.methods.settings import MethodSettings, VertexSettings, WallSettings
from rtgs.train.trainer import Trainer

STEP = 40
LEARNED = VertexSettings(rate=0.1, start=0.0, spacing=20.0, rebuilds=3)


def learning(vertices: VertexSettings = LEARNED, **walls: object) -> MethodSettings:
    base = fresnel(**walls)
    return replace(base, transmittance=replace(base.transmittance, vertices=vertices))


def part_of(method: Model) -> tuple[Glass, LearnedVertices]:
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    assert glass.vertices is not None
    return glass, glass.vertices


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


@pytest.fixture(scope="module")
def fine() -> GlassScene:
    """Pictures large enough to have outlines."""
    return replace(glass_scene(8, 96, 72), mesh=ball_mesh(24, 48))


def shown(method: Model, made: GlassScene, step: int = STEP) -> Tensor:
    view = made.scene.train[0]
    with torch.no_grad():
        return method.render(view.camera, step, Mode.EVALUATE, mask=view.mask).image


def test_the_picture_teaches_them_through_reflections_and_the_light_inside(made: GlassScene):
    found = {}
    for bounces in (0, 1):
        method = begun(learning(bounces=bounces), made)
        randomised(method)
        _, vertices = part_of(method)
        view = made.scene.train[0]
        image = method.render(view.camera, STEP, Mode.TRAIN, mask=view.mask).image
        (found[bounces],) = torch.autograd.grad(image.square().mean(), vertices.group["heights"])
        assert int((found[bounces] != 0).sum()) > 5
    assert not torch.allclose(found[0], found[1]), "what is mirrored inside teaches as well"


def test_a_view_that_looks_past_the_object_teaches_them_nothing(made: GlassScene):
    method = begun(learning(), made)
    randomised(method)
    _, vertices = part_of(method)
    camera = made.scene.train[0].camera
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    away = replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
    rendered = method.render(away, STEP, Mode.TRAIN)
    assert not bool(rendered.maps["transparent"].any())
    heights, colors = vertices.group["heights"], method["base"].gaussians["sh_dc"]
    of_vertices, of_base = torch.autograd.grad(rendered.image.sum(), (heights, colors), allow_unused=True)
    assert of_vertices is None or not bool(of_vertices.any())
    assert bool(of_base.any())


def test_before_their_start_they_stand_still(made: GlassScene):
    method = begun(learning(replace(LEARNED, start=0.5)), made)
    _, vertices = part_of(method)
    assert vertices.group.rate.start == 45
    assert vertices.bend(44) is None
    assert vertices.bend(45) is not None


def test_outlines_bring_a_ball_that_is_too_large_back(fine: GlassScene):
    mesh = fine.mesh.mesh
    centre = mesh.vertices.mean(0)
    large = TriangleMesh(centre + 1.04 * (mesh.vertices - centre), mesh.faces)
    wrong = replace(fine, mesh=ObjectMesh(large, "given", fine.mesh.voxel, flat=False))
    method = begun(learning(replace(LEARNED, rate=0.2, spacing=10.0, outline=1.0)), wrong)
    _, vertices = part_of(method)
    terms = []
    for step in range(80):
        term = vertices.outlined()
        assert term is not None
        (term + 1e-4 * vertices.held()).backward()
        vertices.group.step(40)
        terms.append(float(term))
        if step % 20 == 19:
            assert vertices.rebuild()
    radius = [np.median(np.linalg.norm(m.vertices - centre, axis=1)) for m in (large, vertices.guide.mesh.mesh)]
    true = float(np.median(np.linalg.norm(mesh.vertices - centre, axis=1)))
    assert abs(radius[1] - true) < 0.35 * abs(radius[0] - true)
    assert terms[-1] < 0.3 * terms[0]


def test_the_hold_is_the_mean_square_of_the_heights_in_voxels(made: GlassScene):
    _, vertices = part_of(begun(learning(), made))
    with torch.no_grad():
        vertices.group["heights"].fill_(1.5)
    torch.testing.assert_close(vertices.held().detach(), torch.tensor(2.25))


def test_a_mesh_made_anew_shows_what_the_moved_walls_showed(made: GlassScene):
    method = begun(learning(), made)
    randomised(method)
    glass, vertices = part_of(method)
    before, first = shown(method, made), glass.guide
    assert vertices.rebuild() == "", "nothing has moved"
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        vertices.group["heights"].add_(1.5 * torch.randn(len(vertices.group), generator=generator))
    moved = shown(method, made)
    events = list(glass.control(method.schedule.total))
    assert any(event.kind == "mesh" and "voxels" in event.detail for event in events)
    assert glass.guide is vertices.guide is not first
    anew = shown(method, made)
    mask = made.scene.train[0].mask
    assert mask is not None
    change = float((moved - before).abs().mean(0)[mask].median())  # at the outline other pixels see the object
    assert change > 1e-3
    assert float((anew - moved).abs().mean(0)[mask].median()) < 0.15 * change
    assert "they moved by median" in vertices.decisions[0].why
    assert vertices.decisions[0] in method.decisions


def test_a_run_that_was_killed_goes_on_bit_for_bit_and_ends_with_its_mesh(made: GlassScene, tmp_path: Path):
    settings = learning()
    whole = new_glass_method(settings, made)
    train_stages(whole, made.scene, folder=tmp_path)
    glass, vertices = part_of(whole)
    state = whole.state()
    assert torch.equal(state["vertices.built"], vertices.group["heights"].detach()), "made anew at the end"
    assert bool(state["vertices.built"].any())
    assert any(decision.what.startswith("vertices") for decision in whole.decisions)
    (tmp_path / "step_00000060" / "record.json").unlink()  # as if killed after step 50
    again = new_glass_method(settings, made)
    assert Trainer(again, made.scene, seed=3, stage=whole.stages[-1], checkpoint_dir=tmp_path).run().resumed_from == 50
    for name, tensor in again.state().items():
        assert torch.equal(tensor, state[name]), name
    loaded = new_glass_method(settings, made)
    loaded.load({name: tensor.clone() for name, tensor in state.items()})
    other, _ = part_of(loaded)
    assert glass.guide is not None
    assert other.guide is not None
    np.testing.assert_array_equal(other.guide.mesh.mesh.vertices, glass.guide.mesh.mesh.vertices)
    assert torch.equal(shown(loaded, made, 60), shown(whole, made, 60))


def test_what_is_exact_is_not_learned(made: GlassScene):
    for mesh, why in (
        (replace(made.mesh, surface="planes"), "made of planes"),
        (replace(made.mesh, flat=True), "a pane"),
    ):
        method = new_glass_method(learning(), replace(made, mesh=mesh))
        events = [event for stage in method.stages for event in method.begin(stage)]
        said = [event.detail for event in events if "not learned" in event.detail]
        assert len(said) == 1
        assert why in said[0]
        glass = method.parts["glass"]
        assert isinstance(glass, Glass)
        assert glass.vertices is None
        assert "vertices.built" not in method.state()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": -0.1}, r"vertices\.rate"),
        ({"start": 1.0}, r"vertices\.start=1\.0 .*below 1"),
        ({"spacing": 0.5}, r"vertices\.spacing=0\.5 "),
        ({"rebuilds": 0}, r"vertices\.rebuilds=0 "),
    ],
)
def test_settings_that_do_not_fit_are_refused(changes: dict, message: str):
    with pytest.raises(RtgsError, match=message):
        VertexSettings(**changes)


def test_normals_that_show_nothing_of_the_mesh_are_refused():
    base = fresnel()
    with pytest.raises(RtgsError, match=r"vertices\.rate=0\.1 moves .* set it to mesh"):
        replace(base, transmittance=replace(base.transmittance, normal="base", vertices=LEARNED))


def test_walls_that_scatter_and_samples_of_a_mesh_that_stays_are_refused():
    with pytest.raises(RtgsError, match=r"vertices\.rate=0\.1 moves .*roughness=0\.05 .*set one of them to 0"):
        learning(roughness=0.05)
    base = learning()
    with pytest.raises(RtgsError, match=r"vertices\.rate=0\.1 moves .*rim_samples=16 .*set one of them to 0"):
        replace(base, transmittance=replace(base.transmittance, rim_samples=16))
    learned = replace(base.transmittance, rim_samples=16, wall=WallSettings())
    assert replace(base, transmittance=learned).transmittance.rim_samples == 16  # which learned weights do not read
    still = replace(LEARNED, rate=0.0)
    base = learning(still, roughness=0.05)
    assert replace(base, transmittance=replace(base.transmittance, rim_samples=16)).transmittance.vertices == still
