"""Short recipes with a second stage, on the mirror ball."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.common.mirror_scene import MirrorScene, mirror_scene
from rtgs.core.cameras import Camera
from rtgs.gaussians.settings import DensitySettings, InitSettings, OptimizerSettings
from rtgs.methods import Mode, RenderOptions, create_method
from rtgs.methods.model import Model
from rtgs.methods.parts.part import Frame
from rtgs.methods.settings import (
    MatteSettings,
    MethodSettings,
    PropagationSettings,
    ReflectionSettings,
    TracedShareSettings,
)
from rtgs.optics.settings import OpticsSettings
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings, ScheduleSettings
from rtgs.train.trainer import Trainer

NEVER_MATTE = MatteSettings(probation=0.0)


def schedule(total: int = 60, **changes: int) -> ScheduleSettings:
    values = dict(
        total=total, sh_every=20, densify_from=5, densify_until=45, densify_every=10, opacity_reset_every=40,
        means_lr_steps=total, checkpoint_every=10,
    )  # fmt: skip
    return ScheduleSettings(**(values | changes))


def recipe(name: str = "rtgs", **reflection) -> MethodSettings:
    """Every mechanism of the second stage within 60 steps: propagation, resets, both density controls."""
    default = ReflectionSettings(
        start=0.25,
        cells=3,
        per_cell=4,
        densify_every=10,
        densify_until=0.8,
        sh_every=10,
        opacity_reset_every=30,
        init=InitSettings(scale=0.5),
        density=DensitySettings(gradient_threshold=1e-6, max_surfels=600, min_opacity=0.005),
        propagation=PropagationSettings(every=12, until=0.9, hold_every=4, densify_every=20),
        matte=NEVER_MATTE,
    )
    return MethodSettings(
        name=name,
        loss=LossSettings(normal=0.04, normal_start=0, normal_inverse_depth=True),
        optimizer=OptimizerSettings(specular_logits=0.1, sh_dc=0.01, log_scales=0.02),
        density=DensitySettings(gradient_threshold=5e-5, max_surfels=800, min_opacity=0.005),
        optics=OpticsSettings(weight="envgs" if name == "envgs" else "microfacet"),
        reflection=replace(default, **reflection),
    )


SAMPLED = TracedShareSettings(threshold=0.05, share=0.5, tile=4)


def tiny(strength: float = 0.8) -> MirrorScene:
    return mirror_scene(8, 24, 18, strength=strength, points=250, test_every=8)


def new_method(settings: MethodSettings, made: MirrorScene, plan: ScheduleSettings, seed: int = 3) -> Model:
    method = create_method(settings, made.scene, plan, generator_for(seed, "initialise"))
    assert isinstance(method, Model)
    return method


def train_all(
    settings: MethodSettings, made: MirrorScene, plan: ScheduleSettings, *, folder: Path | None = None, seed: int = 3
) -> Model:
    """Both stages in one process."""
    method = new_method(settings, made, plan, seed)
    before = None
    for stage in method.stages:
        trainer = Trainer(method, made.scene, seed=seed, stage=stage, checkpoint_dir=folder)
        if before is not None:
            trainer._order = before._order
        trainer.run()
        before = trainer
    return method


def training_maps(method: Model, camera: Camera, step: int) -> RenderOptions:
    """The maps of the base set that a training view of this step is rendered with."""
    frame = Frame(camera, step, Mode.TRAIN, RenderOptions())
    wanted = method.loss.needs(step)
    for part in method.parts.values():
        wanted = wanted.plus(part.needs(frame))
    return wanted


def use(method: Model, settings: MethodSettings) -> None:
    """From now on the method renders with these settings."""
    for part in method.parts.values():
        part.settings = settings


def train_step(method: Model, made, step: int):
    view = made.scene.train[step % len(made.scene.train)]
    rendered = method.render(view.camera, step, Mode.TRAIN)
    terms = method.losses(rendered, view, step)
    terms.total.backward()
    return terms, method.after_step(step, rendered.observations)
