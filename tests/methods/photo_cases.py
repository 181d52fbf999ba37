"""A scene whose photos are pictures of known Gaussians, for what is learned of each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from training_cases import HEIGHT, WIDTH, named, small_method, small_scene, small_schedule, small_trainer

from rtgs.gaussians.settings import InitSettings
from rtgs.methods import MethodSettings, Mode, create_method
from rtgs.render.pose import NUMBERS, moved
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.seeds import generator_for
from rtgs.train.settings import ScheduleSettings
from rtgs.train.trainer import TrainSummary

GREY = (0.3, 0.3, 0.3)
COUNT = 120


def plain(kind: str) -> MethodSettings:
    """Photometric losses alone, before the grey of the photos."""
    settings = small_method(kind)
    loss = replace(settings.loss, normal=0.0, mono_normal=0.0)
    return replace(settings, loss=loss, render=RenderSettings(background=GREY))


def photographed(kind: str, views: int = 13) -> Scene:
    """``views`` photos (the last one for test) of 120 Gaussians; points and their colours are off a little."""
    generator = torch.Generator().manual_seed(5)
    points = 0.55 * torch.randn(COUNT, 3, generator=generator)
    colors = torch.rand(COUNT, 3, generator=generator)
    scene = replace(named(small_scene(views)), points=points, point_colors=colors)
    settings = replace(plain(kind), init=InitSettings(opacity=0.8, scale=0.8))
    truth = create_method(settings, scene, small_schedule(10), generator_for(0, "initialise"))

    def photo(view: View) -> View:
        with torch.no_grad():
            image = truth.render(view.camera, 0, Mode.EVALUATE).image
        return replace(view, image=image.clamp(0, 1).contiguous())

    off = points + 0.03 * torch.randn(COUNT, 3, generator=generator)
    train, test = (tuple(map(photo, each)) for each in (scene.train, scene.test))
    return replace(scene, train=train, test=test, points=off, point_colors=0.5 * colors + 0.25)


def grey_photos(stops: Sequence[float], **changes: object) -> Scene:
    """A sphere of one grey, each of whose training photos is brighter by its stops; one more photo is for test."""
    scene = named(small_scene(len(stops) + 1))
    train = (
        replace(view, image=torch.full((3, HEIGHT, WIDTH), 0.4) * 2**each)
        for view, each in zip(scene.train, stops, strict=True)
    )
    return replace(scene, train=tuple(train), **changes)  # type: ignore[arg-type]


def misplaced(scene: Scene, size: float) -> Scene:
    """The training cameras moved at random, by ``size`` radians and shares of the extent in each number."""
    deltas = size * torch.randn(len(scene.train), NUMBERS, generator=torch.Generator().manual_seed(1))
    deltas = deltas - deltas.mean(0)

    def put(view: View, delta: torch.Tensor) -> View:
        return replace(view, camera=moved(view.camera, delta, scene.extent).of(view.camera))

    return replace(scene, train=tuple(put(view, delta) for view, delta in zip(scene.train, deltas, strict=True)))


def steady(total: int) -> ScheduleSettings:
    """No density control, no resets."""
    return small_schedule(total, densify_until=0, opacity_reset_every=0)


def trained(scene: Scene, settings: MethodSettings, total: int):
    """The trainer after its run, and what it did."""
    trainer = small_trainer(scene, settings, steady(total))
    summary: TrainSummary = trainer.run()
    return trainer, summary
