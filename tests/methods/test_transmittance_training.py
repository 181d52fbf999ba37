"""Training of the third stage: what learns, when its losses start, and how it goes on after a kill."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from glass_cases import GlassScene, begun, glass_recipe, glass_scene, held, new_glass_method, train_stages
from reflective_cases import schedule

from rtgs.gaussians.density import logit
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode, RenderOptions
from rtgs.train.trainer import Trainer

LAYERS = RenderOptions(layers=True)


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def test_every_parameter_learns_and_nothing_resets_the_base(made: GlassScene):
    method = new_glass_method(glass_recipe(), made)
    train_stages(method, made.scene)
    assert {part.name for part in method.sets} == {"base", "reflection", "transmittance", "interface"}
    interface = method.find("interface")
    assert interface is not None
    assert float(interface.gaussians.opacity_logits.detach().min()) >= logit(0.9) - 1e-6
    assert int(method["base"].gaussians.means.shape[0]) > 0
    for part in method.sets:
        for name, moment in part.optimizer.second.items():
            assert float(moment.max()) > 0, f"{part.name}.{name}"
    events = [event for step in range(30, 59) for event in _events_of(method, step)]
    assert not [event for event in events if event.set_name == "base"]
    assert {event.kind for event in events if event.set_name == "transmittance"} == {"density", "opacity_reset"}
    assert not [event for event in events if event.set_name == "interface"]


def test_the_losses_of_glass_start_at_their_steps(made: GlassScene):
    recipe = glass_recipe()
    method = begun(replace(recipe, loss=replace(recipe.loss, specular_start=0.6)), made)
    view = made.scene.train[0]

    def names(step: int) -> set[str]:
        rendered = method.render(view.camera, step, Mode.TRAIN, mask=view.mask)
        return {term.name for term in method.losses(rendered, view, step).terms}

    found = [names(step) & {"specular", "transmission_depth"} for step in (35, 36, 44, 45)]
    assert found == [set(), {"specular"}, {"specular"}, {"specular", "transmission_depth"}]
    assert "interface_normal" in names(35)


def test_a_mesh_with_a_hole_trains(made: GlassScene):
    """Rays through it meet the far wall first: one surface, a thin sheet there."""
    whole = made.mesh.mesh
    faces = whole.faces[(whole.vertices[whole.faces][:, :, 2] > whole.vertices[:, 2].min() + 0.4).any(1)]
    assert 0 < len(faces) < len(whole.faces)
    holed = GlassScene(made.scene, replace(made.mesh, mesh=TriangleMesh(whole.vertices, faces)))
    method = new_glass_method(glass_recipe(), holed, schedule(total=24, checkpoint_every=100))
    train_stages(method, made.scene)
    assert method.parts["glass"].guide is not None
    assert method.parts["glass"].guide.counts()["one_hit"] > 0
    for part in method.sets:
        assert all(bool(torch.isfinite(tensor).all()) for _, tensor in part.gaussians.items()), part.name


def _events_of(method, step: int):
    """What the plan asks of the sets before ``step + 1``, without training."""
    for part in method.sets:
        part.optimizer.zero_grad()
    return method.after_step(step, ())


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_killed_stage_goes_on_bit_for_bit(made: GlassScene, tmp_path: Path, share: float):
    settings = held(5.0)
    settings = replace(settings, transmittance=replace(settings.transmittance, drawn_share=share))
    whole = new_glass_method(settings, made)
    train_stages(whole, made.scene, folder=tmp_path / "whole")
    halves = new_glass_method(settings, made)
    train_stages(halves, made.scene, folder=tmp_path / "halves")
    for step in (60, 50):  # as if killed after step 40: what came later is gone
        folder = tmp_path / "halves" / f"step_{step:08d}"
        if step == 60:
            (folder / "record.json").unlink()
    stage = whole.stages[-1]
    resumed = new_glass_method(settings, made)
    summary = Trainer(resumed, made.scene, seed=3, stage=stage, checkpoint_dir=tmp_path / "halves").run()
    assert summary.resumed_from == 50
    first, second = whole.state(), resumed.state()
    assert first.keys() == second.keys()
    assert "third_stage" in first
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name
    del second["interface.normals"]
    with pytest.raises(ValueError, match=r"no interface.normals: .* train again"):
        resumed.load(second)


@pytest.mark.parametrize(
    "changes",
    [
        {"first_bounce": "base"},
        {"first_bounce": "none"},
        {"second_bounce": "none", "normal": "mesh"},
        {"second_bounce": "first_bounce", "freeze_base": False},
        {"compositing": "sum", "box": "scene", "split": False, "test_masks": "given"},
        {"first_bounce_end": "clip", "second_bounce_gradient": False, "second_offset": 0.0},
        {"contents": "rasterized"},
        {"contents": "rasterized", "second_bounce": "first_bounce"},
    ],
)
def test_every_choice_trains(made: GlassScene, changes: dict[str, object]):
    method = new_glass_method(glass_recipe(**changes), made, schedule(total=24, checkpoint_every=100))
    train_stages(method, made.scene)
    for part in method.sets:
        for name, tensor in part.gaussians.items():
            assert bool(torch.isfinite(tensor).all()), f"{part.name}.{name}"
    view = made.scene.test[0]
    again = new_glass_method(glass_recipe(**changes), made, schedule(total=24, checkpoint_every=100))
    again.load({name: tensor.clone() for name, tensor in method.state().items()})
    with torch.no_grad():
        images = [m.render(view.camera, 24, Mode.EVALUATE, RenderOptions(), view.mask).image for m in (method, again)]
    assert torch.equal(*images)


def test_wild_learning_rates_stay_finite(made: GlassScene):
    settings = glass_recipe()
    wild = replace(
        settings.optimizer, means_initial=0.05, log_scales=0.5, opacity_logits=2.0, quaternions=1.0, sh_dc=1.0
    )
    method = new_glass_method(replace(settings, optimizer=wild), made, schedule(total=40, checkpoint_every=100))
    train_stages(method, made.scene)
    view = made.scene.test[0]
    with torch.no_grad():
        assert bool(
            torch.isfinite(method.render(view.camera, 40, Mode.EVALUATE, RenderOptions(), view.mask).image).all()
        )


def test_the_noise_of_density_control_is_put_on_the_set_behind_glass(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    method = begun(glass_recipe(), made)
    steps: list[int] = []
    monkeypatch.setattr(method["transmittance"], "perturb", lambda step, generator: steps.append(step))
    _events_of(method, 33)
    assert steps == [3], "on its own clock, which is 0 at step 30"
