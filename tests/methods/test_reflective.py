"""Methods with a second stage: gradients against the twins, schedule, exact resume, matte scenes, stress."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from reflective_cases import SAMPLED, new_method, recipe, schedule, tiny, train_all, train_step, use
from safetensors.torch import load_file

from rtgs.config import compose
from rtgs.gaussians.materials import MATERIAL_NAMES, has_materials
from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods import Mode, RenderOptions, Stage
from rtgs.methods.parts.reflection_init import reflection_box, reflection_surfels, scene_color
from rtgs.methods.settings import (
    MatteSettings,
    MethodSettings,
    PropagationSettings,
    ReflectionSettings,
    TracedShareSettings,
)
from rtgs.optics.microfacet import specular_weights
from rtgs.train.checkpoint import checkpoint_path
from rtgs.train.trainer import Trainer

TESTS = Path(__file__).parent


def in_second_stage(settings: MethodSettings | None = None, *, steps: int = 0, strength: float = 0.8):
    """A method at the start of its second stage, or ``steps`` later; its scene."""
    made = tiny(strength)
    method = new_method(settings or recipe(), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    for step in range(15, 15 + steps):
        train_step(method, made, step)
    return method, made


def test_the_first_stage_is_that_of_the_plain_method_and_the_second_adds_what_it_needs():
    made = tiny()
    method = new_method(recipe(), made, schedule())
    assert method.stages == (Stage("diffuse", 0, 15), Stage("reflection", 15, 60))
    assert method.begin(method.stages[0]) == ()
    view = made.scene.train[0]
    assert method.render(view.camera, 0, Mode.TRAIN).maps.get("specular") is None
    assert method.sets == (method["base"],)
    method.begin(method.stages[1])
    assert [part.name for part in method.sets] == ["base", "reflection"]
    assert has_materials(method["base"].gaussians)
    assert len(method.sets[1]) == 3**3 * 4
    with torch.no_grad():
        rendered = method.render(view.camera, 15, Mode.EVALUATE, RenderOptions(layers=True))
    layers = rendered.layers
    assert layers is not None
    blended = layers["diffuse"] * (1 - layers["specular"] * layers["traced"]) + layers["reflection"]
    torch.testing.assert_close(rendered.image, blended, atol=2e-6, rtol=0)
    assert bool(layers["traced"].any())
    assert float(layers["reflection"][:, ~layers["traced"]].abs().sum()) == 0


@pytest.mark.parametrize(("start", "stages"), [(1.0, ["diffuse"]), (0.0, ["reflection"])])
def test_a_share_of_one_leaves_the_stage_out_and_of_zero_the_first(start: float, stages: list[str]):
    method = new_method(recipe(start=start), tiny(), schedule())
    assert [stage.name for stage in method.stages] == stages


def test_the_reflection_set_surrounds_what_the_cameras_look_at():
    """Points end at the top of a ball that mirrors the sky: the box must not."""
    flat = torch.tensor([[-4.0, -4, 0], [4.0, 4, 1], [float("nan"), 0, 9]])
    own, reaching = (reflection_box(ReflectionSettings(box_reach=reach), flat, 3.0) for reach in (0.0, 1.0))
    torch.testing.assert_close(own, torch.tensor([[-3.96, -3.96, 0.005], [3.96, 3.96, 0.995]]))
    torch.testing.assert_close(reaching, torch.tensor([[-3.96, -3.96, -2.5], [3.96, 3.96, 3.5]]))
    cube = reflection_box(ReflectionSettings(box_half=20.0), flat, 3.0)
    assert cube.tolist() == [[-20.0] * 3, [20.0] * 3]
    settings = ReflectionSettings(cells=3, per_cell=2)
    means = reflection_surfels(settings, flat, 3.0, torch.Generator().manual_seed(0)).means.detach()
    assert len(means) == 54
    assert float(means[:, 2].max()) > 3


def test_the_reflection_set_can_start_in_a_colour_of_the_training_images():
    values = torch.linspace(0, 1, 4 * 5 * 370).reshape(4, 1, 5, 370)
    images = [torch.cat((image, image / 2, 0 * image)) for image in values]
    torch.testing.assert_close(scene_color("mean", images), torch.tensor([0.5, 0.25, 0]), atol=0.01, rtol=0)
    torch.testing.assert_close(scene_color("bright", images), torch.tensor([0.9, 0.45, 0]), atol=0.01, rtol=0)
    assert scene_color("random", images) is None
    assert scene_color("black", images) is None
    made = tiny()
    method = new_method(recipe(init_color="bright"), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    assert method.find("reflection") is not None
    expected = scene_color("bright", [view.image for view in made.scene.train])
    assert expected is not None
    found = 0.5 + 0.28209479 * method.find("reflection").gaussians.sh_dc.detach()
    torch.testing.assert_close(found, expected.expand_as(found), atol=1e-5, rtol=0)


def test_a_set_that_starts_late_can_learn_faster_than_the_base():
    method, _ = in_second_stage(recipe(rate_gain=3.0))
    assert method.find("reflection") is not None
    base, reflection = (part.optimizer.learning_rates(0) for part in (method["base"], method.find("reflection")))
    faster = {name for name in reflection if abs(reflection[name] - 3 * base[name]) < 1e-12}
    assert faster == {"sh_dc", "sh_rest", "log_scales"}
    assert all(reflection[name] == base[name] for name in reflection.keys() - faster)


def test_rtgs_starts_as_bright_as_the_mirror_ray_from_every_angle():
    """w_r near EnvGS's 1: a start that is darker than what it replaces teaches k_s to fall."""
    config, _ = compose(["scene=demo", "method=rtgs", "preset=quick"])
    materials, optics = config.method.materials, config.method.optics
    cosine = torch.linspace(0.2, 1, 9)
    start = torch.full_like(cosine, materials.roughness), torch.full_like(cosine, materials.f0)
    weight = specular_weights(cosine, *start, optics).reflection
    assert 0.8 < float(weight.min()) <= float(weight.max()) <= 1


@pytest.mark.parametrize("name", ["rtgs", "envgs"])
def test_the_reflection_set_alone_learns_what_the_mirror_shows(name: str):
    method, made = in_second_stage(recipe(name, propagation=PropagationSettings(every=0)))
    with torch.no_grad():
        method["base"].gaussians["specular_logits"].fill_(2.0)  # type: ignore[union-attr]
        method["base"].gaussians["f0_logits"].fill_(3.0)  # type: ignore[union-attr]
    held = method["base"].gaussians.names
    view = made.scene.train[0]
    losses = []
    for step in range(15, 115):
        terms = method.losses(method.render(view.camera, step, Mode.TRAIN), view, step)
        terms.total.backward()
        losses.append(terms.terms[0].value)
        method["base"].step(step, 0, held=held)
        method.sets[1].step(step, 0)
    assert losses[-1] < 0.6 * losses[0]


def test_every_parameter_of_both_sets_learns():
    method, made = in_second_stage(steps=12)
    before = {part.name: part.gaussians.detached() for part in method.sets}
    for step in range(27, 29):  # between two density controls
        train_step(method, made, step)
    for part in method.sets:
        for name, tensor in part.gaussians.items():
            moved = (tensor.detach() - before[part.name][name]).abs().amax()
            assert float(moved) > 0, f"{part.name}.{name}"


def test_the_normals_learn_from_reflection_alone():
    """A loss on the change that reflection makes reaches rotations and means of the base set."""
    method, made = in_second_stage(steps=5)
    rendered = method.render(made.scene.train[0].camera, 20, Mode.TRAIN)
    weight = torch.rand(rendered.image.shape, generator=torch.Generator().manual_seed(0))
    (weight * (rendered.image - rendered.buffers.features[:3])).sum().backward()
    for name in ("quaternions", "means", *MATERIAL_NAMES):
        gradient = method["base"].gaussians[name].grad
        assert float(gradient.abs().sum()) > 0, name


def test_sampled_pixels_leave_the_gradient_right_on_average():
    settings = recipe(traced=TracedShareSettings(threshold=0.5, share=0.3, tile=4))
    method, made = in_second_stage(settings)
    view = made.scene.train[0]
    weight = torch.rand(view.image.shape, generator=torch.Generator().manual_seed(1))

    def gradients() -> list[torch.Tensor]:
        (weight * method.render(view.camera, 15, Mode.TRAIN).image).sum().backward()
        found = [p.grad.clone() for part in method.sets for _, p in part.gaussians.items() if p.grad is not None]
        for part in method.sets:
            part.optimizer.zero_grad()
        return found

    draws = 150
    mean = gradients()
    for _ in range(draws - 1):
        mean = [total + one for total, one in zip(mean, gradients(), strict=True)]
    use(method, replace(method.settings, reflection=replace(settings.reflection, traced=TracedShareSettings())))
    for name, total, exact in zip(range(99), mean, gradients(), strict=False):
        error = (total / draws - exact).norm() / exact.norm().clamp_min(1e-12)
        assert float(error) < 0.3, name  # 1 / sqrt(150 * 0.3 / 0.7) = 0.12 for one tile


def test_what_is_not_traced_at_a_test_view_is_the_diffuse_colour():
    method, made = in_second_stage(recipe(traced=TracedShareSettings(threshold=0.5)))
    with torch.no_grad():
        rendered = method.render(made.scene.test[0].camera, 15, Mode.EVALUATE, RenderOptions(layers=True))
    assert rendered.layers is not None
    assert not bool(rendered.layers["traced"].any())  # k_s starts at 0.001
    assert torch.equal(rendered.image, rendered.layers["diffuse"])


def test_pixels_that_share_a_ray_show_the_colour_that_one_of_their_block_would():
    settings = replace(
        recipe("envgs", traced=TracedShareSettings(shared_below=2.0)), materials=MaterialSettings(specular=0.3)
    )
    method, made = in_second_stage(settings, steps=17)
    camera = made.scene.train[0].camera
    with torch.no_grad():
        shared = method.render(camera, 32, Mode.TRAIN).image
        layers = method.render(camera, 32, Mode.EVALUATE, RenderOptions(layers=True)).layers
    assert layers is not None

    def blocks(maps: torch.Tensor) -> torch.Tensor:  # (C, blocks, 4)
        return maps.unfold(1, 2, 2).unfold(2, 2, 2).flatten(3).flatten(1, 2)

    specular, diffuse, color = (
        blocks(m) for m in (layers["specular"][None], layers["diffuse"], layers["reflected_color"])
    )
    known = blocks(layers["traced"][None].float()).min(dim=2).values[0] == 1
    # (C, blocks, pixel, whose ray)
    each = diffuse[..., None] + specular[..., None] * (color[:, :, None, :] - diffuse[..., None])
    worst = (each - blocks(shared)[..., None]).abs().amax(dim=(0, 2))[known]  # of a block, by whose ray
    assert int(known.sum()) > 20
    assert float(worst.min(dim=1).values.max()) < 1e-5
    assert int((worst < 1e-5).sum(dim=1).ne(4).sum()) > 20  # the four would differ


@pytest.mark.parametrize("traced", [TracedShareSettings(), SAMPLED, TracedShareSettings(shared_below=0.5)])
def test_state_goes_round_in_the_middle_of_the_second_stage(traced: TracedShareSettings):
    method, made = in_second_stage(recipe(traced=traced), steps=17)
    state = {name: tensor.clone() for name, tensor in method.state().items()}
    other = new_method(recipe(traced=traced), made, schedule())
    other.load(state)
    for step in range(32, 55):  # both density controls, a propagation, resets
        train_step(method, made, step)
        train_step(other, made, step)
    assert method.state().keys() == other.state().keys()
    different = [name for name, tensor in method.state().items() if not torch.equal(tensor, other.state()[name])]
    assert different == []


SCRIPT = """
import sys
import time
from pathlib import Path
import torch
from reflective_cases import SAMPLED, new_method, recipe, schedule, tiny
from rtgs.train.trainer import Trainer
torch.set_num_threads(1)
made = tiny()
method = new_method(recipe(traced=SAMPLED), made, schedule())
for stage in method.stages:
    trainer = Trainer(method, made.scene, seed=3, stage=stage, checkpoint_dir=Path(sys.argv[1]))
    after_step = method.after_step
    def telling(step, observations, after_step=after_step):
        events = after_step(step, observations)
        print("step", step, flush=True)
        return events
    method.after_step = telling
    trainer.run()
    method.after_step = after_step
time.sleep(600)  # until it is killed
"""


def test_killed_in_the_second_stage_it_ends_with_the_same_bits(tmp_path: Path):
    settings, plan, made = recipe(traced=SAMPLED), schedule(), tiny()
    train_all(settings, made, plan, folder=tmp_path / "straight")
    path = os.pathsep.join([str(TESTS.parents[1]), str(TESTS), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "killed")]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line == "step 44\n":
            time.sleep(0.003)
            process.send_signal(signal.SIGKILL)
            break
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    method = new_method(settings, made, plan)
    stage = method.stages[1]
    resumed = Trainer(method, made.scene, seed=3, stage=stage, checkpoint_dir=tmp_path / "killed").run().resumed_from
    assert resumed in {40, 50, 60}
    ends = [load_file(checkpoint_path(tmp_path / name, 60) / "state.safetensors") for name in ("straight", "killed")]
    assert ends[0].keys() == ends[1].keys()
    assert [name for name in ends[0] if not torch.equal(ends[0][name], ends[1][name])] == []


def test_a_matte_scene_is_recognised_before_anything_can_hurt_it_and_goes_on_as_in_stage_one(tmp_path: Path):
    matte = MatteSettings(probation=0.05, views=3)
    made = tiny(strength=0.0)
    method = new_method(recipe(matte=matte), made, schedule())
    method.begin(method.stages[1])
    kinds = []
    for step in range(15, 40):
        _, events = train_step(method, made, step)
        kinds += [(step + 1, event.kind) for event in events if event.kind in ("decision", "propagation")]
    assert kinds == [(18, "decision")]
    assert method.sets == (method["base"],)
    assert not has_materials(method["base"].gaussians)
    assert method.decisions[-1].what == "the reflection stage ended early"
    assert "nothing specular in this scene" in method.decisions[-1].why
    other = new_method(recipe(matte=matte), made, schedule())
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    assert other.decisions[-1] == method.decisions[-1]
    for step in range(40, 45):
        train_step(method, made, step)
        train_step(other, made, step)
    assert all(torch.equal(tensor, other.state()[name]) for name, tensor in method.state().items())


def test_propagation_makes_opaque_grows_and_disturbs_as_envgs_does():
    quiet = PropagationSettings(every=20, until=0.9, hold_every=5)
    method, made = in_second_stage(recipe(propagation=quiet))
    with torch.no_grad():
        method["base"].gaussians["specular_logits"][:50] = 2.0
    for step in range(15, 19):
        train_step(method, made, step)
    before = method["base"].gaussians.detached()
    _, events = train_step(method, made, 19)
    assert "propagation" in [event.kind for event in events]
    assert float(method["base"].gaussians.opacity_logits.detach().sigmoid().min()) >= 0.9 - 1e-6
    if len(before) == len(method["base"].gaussians):
        grown = (method["base"].gaussians.log_scales - before.log_scales)[:50].detach()
        assert float(grown.median()) == pytest.approx(0.405, abs=0.05)
    held = method["base"].gaussians.opacity_logits.detach().clone()
    train_step(method, made, 20)
    assert torch.equal(method["base"].gaussians.opacity_logits.detach(), held)


def test_specular_resets_lower_the_weight_with_the_opacity():
    method, made = in_second_stage()
    with torch.no_grad():
        method["base"].gaussians["specular_logits"].fill_(3.0)
    for step in range(15, 40):
        train_step(method, made, step)
    assert float(method["base"].gaussians["specular_logits"].detach().sigmoid().max()) <= 1.0001e-3  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["rtgs", "envgs"])
@pytest.mark.parametrize("steps", [400, pytest.param(5000, marks=pytest.mark.slow)])
def test_learning_rates_times_ten_stay_finite(name: str, steps: int):
    settings = recipe(name)
    rates = {field.name: 10 * getattr(settings.optimizer, field.name) for field in fields(settings.optimizer)[:10]}
    settings = replace(settings, optimizer=replace(settings.optimizer, **rates))
    made = tiny()
    noise = torch.Generator().manual_seed(5)
    views = tuple(replace(v, image=torch.rand(v.image.shape, generator=noise)) for v in made.scene.train)
    made = replace(made, scene=replace(made.scene, train=views))
    plan = schedule(steps, densify_until=steps // 2, densify_every=50, opacity_reset_every=steps // 4)
    method = train_all(settings, made, plan)
    for part in method.sets:
        for key, tensor in part.gaussians.items():
            assert bool(torch.isfinite(tensor).all()), f"{part.name}.{key}"
    with torch.no_grad():
        image = method.render(made.scene.test[0].camera, steps, Mode.EVALUATE, RenderOptions()).image
    assert bool(torch.isfinite(image).all())
