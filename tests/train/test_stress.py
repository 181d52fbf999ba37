"""Learning rates x30 on noise: nothing becomes non-finite (the clamps of method.md 14 see to it)."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from training_cases import small_method, small_scene, small_schedule

from rtgs.config import compose
from rtgs.gaussians.settings import OptimizerSettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.mesh.container import ObjectMesh
from rtgs.methods import create_method
from rtgs.methods.model import Model
from rtgs.methods.settings import MatteSettings, MethodSettings
from rtgs.optics.settings import OpticsSettings
from rtgs.scenes.scene import Scene
from rtgs.train.method import Mode
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer
from tests.mesh.shapes import sphere

NO_RATES = ("beta1", "beta2", "eps", "opacity_logit_limit", "smallest_scale", "largest_scale", "decay_from", "decay_to")
STEPS = [500, pytest.param(2000, marks=pytest.mark.slow)]


def violent(factor: float, base: OptimizerSettings | None = None) -> OptimizerSettings:
    """Every learning rate times ``factor``."""
    base = base or OptimizerSettings()
    rates = [field.name for field in fields(base) if field.name not in NO_RATES]
    return replace(base, **{name: factor * getattr(base, name) for name in rates})


def noise(*, masked: bool) -> Scene:
    """Noise before which stands a sphere of glass."""
    scene = small_scene(noise=True, normals=True, points=150)
    if not masked:
        return scene
    rows, columns = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    disc = ((rows - 14.5).square() + (columns - 19.5).square()).sqrt() < 11
    return replace(scene, train=tuple(replace(view, mask=disc) for view in scene.train))


def method_of(name: str, variant: str = "") -> MethodSettings:
    """Its stages begin at 5 % and a third of the run, and none is left out.

    ``variant``: "surfels" of 3dgs_dr, or "cubemap" behind the traced set of envgs.
    """
    settings = replace(small_method(name), optimizer=violent(30))
    if name in ("2dgs", "3dgs"):
        return settings
    if name == "3dgs_dr":
        fast = EnvironmentSettings(side=32, rate=30 * EnvironmentSettings().rate)
        own = {"primitive": variant or "ellipsoids", "scope_radius": 0.8}
        settings = replace(settings, environment=fast, own=own)
    if name == "ref_gaussian":  # three levels, a mesh every tenth of the run
        cubemap = EnvironmentSettings(side=32, mips="ggx", levels=(32, 16, 16), rate=0.3)
        settings = replace(settings, environment=cubemap, own={"mesh_cells": 64, "smooth": 0.45})
    if name == "ref_gs":
        fast = replace(settings.environment, rate=0.06)
        settings = replace(settings, environment=fast, own={"network_rate": 0.015, "scope_radius": 0.8})
    reflection = replace(settings.reflection, matte=MatteSettings(probation=0.0), cells=6)
    if name == "3dgs_dr":
        reflection = replace(reflection, propagation=replace(reflection.propagation, every=200))
    if variant == "cubemap":
        reflection = replace(reflection, background="cubemap")
        settings = replace(settings, environment=EnvironmentSettings(side=32, rate=30 * EnvironmentSettings().rate))
    if name == "gaussian_shader":
        fast = replace(settings.environment, rate=0.5)
        return replace(settings, environment=fast, own={"shared_rate": True})
    optics = OpticsSettings(weight="envgs") if name == "envgs" else OpticsSettings(max_gain=0.0)
    glass = replace(settings.transmittance, opaque_share=1.0, cells=6)
    loss = replace(settings.loss, specular=0.2, transmission_depth=0.2)
    return replace(settings, reflection=reflection, optics=optics, transmittance=glass, loss=loss)


def shipped(name: str) -> MethodSettings:
    """A method as its YAML files have it, with caps for small pictures."""
    config, _ = compose(["scene=demo", f"method={name}", "preset=quick", "judge=none"])
    method = config.method
    few = replace(method.density, max_surfels=1200)
    matte = MatteSettings(probation=0.0)
    return replace(
        method,
        density=few,
        optimizer=violent(30, method.optimizer),
        loss=replace(method.loss, perceptual=0.0),  # its weights are not here
        reflection=replace(method.reflection, matte=matte, cells=6, start=0.05),
        transmittance=replace(method.transmittance, opaque_share=1.0, cells=6, start=1 / 3),
    )


def test_every_rate_is_one_of_those_that_are_raised():
    assert violent(2).f0_logits == 2 * OptimizerSettings().f0_logits
    plain = OptimizerSettings()
    raised = {field.name for field in fields(plain) if getattr(violent(2), field.name) != getattr(plain, field.name)}
    assert raised == {field.name for field in fields(plain)} - set(NO_RATES)
    assert {"specular_logits", "roughness_logits", "f0_logits"} < raised


SMALL = ("2dgs", "3dgs", "3dgs_dr", "gaussian_shader", "ref_gaussian", "ref_gs", "envgs", "rtgs", "rtgs_printed")
VARIANTS = ("3dgs_dr, surfels", "envgs, cubemap")
SHIPPED = ("rtgs, as shipped", "rtgs_printed, as shipped")


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("name", [*SMALL, *VARIANTS, *SHIPPED])
def test_steps_at_30_times_the_learning_rates_on_noise_stay_finite(name: str, steps: int):
    """All stages of a method: glass with an interface and a bounded weight in rtgs, without either as printed."""
    name, _, variant = name.partition(", ")
    three_stages, files = name.startswith("rtgs"), variant == "as shipped"
    settings, scene = shipped(name) if files else method_of(name, variant), noise(masked=three_stages)
    if files:
        light = settings.transmittance.wall.light
        assert light == {"rtgs": "fresnel", "rtgs_printed": "learned"}[name]
    elif name == "rtgs_printed":
        bare = replace(settings.transmittance, split=False, max_gain=None)
        bare = replace(bare, interface=replace(bare.interface, count=0), first_surface="base")
        settings = replace(settings, transmittance=bare)
    density = dict(densify_from=100, densify_until=3 * steps // 4, densify_every=100)
    plan = small_schedule(steps, **density, opacity_reset_every=steps // 4)
    mesh = ObjectMesh(sphere(1.0, 16), "given", voxel=0.05, flat=False) if three_stages else None
    method = create_method(settings, scene, plan, generator_for(3, "initialise"), mesh)
    assert isinstance(method, Model)
    for stage in method.stages:
        trainer = Trainer(method, scene, seed=3, stage=stage)
        trainer.run()  # the guard stops at any non-finite loss or gradient
    assert method.stages[-1].until == steps
    assert [stage.name for stage in method.stages][1:] == ["reflection", "transmittance"][: len(method.stages) - 1]
    counts = {"2dgs": 1, "3dgs": 1, "3dgs_dr": 2, "gaussian_shader": 1, "ref_gaussian": 2, "ref_gs": 2, "envgs": 2}
    assert len(method.stages) == counts.get(name, 3)
    assert (method.find("transmittance") is not None) == three_stages
    for part in method.sets:
        _within_limits(part.gaussians, settings.optimizer, scene.extent, part.name)
    for group in method.groups:
        assert all(bool(torch.isfinite(tensor).all()) for _, tensor in group.tensors()), group.name
    if name == "3dgs_dr" or variant == "cubemap":
        (texels,) = (group["texels"] for group in method.groups if group.name == "environment")
        assert float(texels.detach().abs().max()) > 4 * EnvironmentSettings().noise, "the cubemap's rate is raised"
    for view in (*scene.train, *scene.test):
        with torch.no_grad():
            assert bool(torch.isfinite(method.render(view.camera, steps, Mode.TRAIN).image).all())


def _within_limits(gaussians, limits: OptimizerSettings, extent: float, name: str) -> None:
    assert len(gaussians) > 0, name
    for key, tensor in gaussians.items():
        assert bool(torch.isfinite(tensor).all()), f"{name}.{key}"
    assert float(gaussians.opacity_logits.detach().abs().max()) <= limits.opacity_logit_limit + 1e-5
    scales = gaussians.log_scales.detach().exp()
    assert float(scales.max()) <= limits.largest_scale * extent * 1.001
    assert float(scales.min()) >= limits.smallest_scale * extent * 0.999
