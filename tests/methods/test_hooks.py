"""What a part may do to a view: aim it, finish it, add maps that loss terms read."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from training_cases import named, small_method, small_scene, small_schedule

from rtgs.gaussians.channels import Channel
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods import MethodSpec, Mode, RenderedView, RenderOptions, Setup
from rtgs.methods.family import DIFFUSE
from rtgs.methods.model import Model
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.kinds import SURFELS
from rtgs.methods.parts.part import Frame, Part
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.seeds import generator_for
from rtgs.train.terms import LossTerm
from rtgs.train.trainer import Trainer

SHIFT = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)


class Aside(Part):
    """Every view from a little beside its camera."""

    name = "aside"

    def aim(self, frame: Frame) -> Frame:
        return replace(frame, camera=replace(frame.camera, translation=frame.camera.translation + SHIFT))


class PerView(Part):
    """One gain for each training view, others have the mean; the gain becomes a map."""

    name = "per_view"

    def __init__(self, names: list[str]) -> None:
        self.rows = {name: row for row, name in enumerate(names)}
        self.group = ParameterGroup("gains", {"gain": torch.ones(len(names))}, Rate(0.05))

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return (self.group,)

    def needs(self, frame: Frame) -> RenderOptions:
        return RenderOptions(depth=True)

    def finish(self, frame: Frame, shaded: RenderedView) -> RenderedView:
        row = self.rows.get(frame.camera.name)
        gain = self.group["gain"].mean() if row is None else self.group["gain"][row]
        assert shaded.buffers.depth is not None
        return replace(shaded, image=gain * shaded.image, maps={**shaded.maps, "gain": gain})


def model(make_parts, terms=()) -> Model:
    scene, settings, schedule = named(small_scene()), small_method("2dgs"), small_schedule(40)

    def build(setup: Setup) -> Model:
        return Model(setup, (BaseSet(setup, SURFELS), *make_parts(scene)), terms)

    spec = MethodSpec("hooked", (DIFFUSE,), build)
    stages = spec.timeline(settings, schedule)
    return build(Setup(spec, settings, scene, schedule, generator_for(0, "initialise"), stages=stages))


def test_a_part_may_aim_the_view():
    plain, aside = model(lambda scene: ()), model(lambda scene: (Aside(),))
    camera = small_scene().train[0].camera
    moved = replace(camera, translation=camera.translation + SHIFT)
    found = aside.render(camera, 0, Mode.EVALUATE)
    assert torch.equal(found.image, plain.render(moved, 0, Mode.EVALUATE).image)
    assert not torch.equal(found.image, plain.render(camera, 0, Mode.EVALUATE).image)
    assert torch.equal(found.camera.translation, moved.translation)


def test_a_part_may_finish_a_view_by_its_name_and_train_it():
    seen: list[float] = []

    def bright(rendered: RenderedView, view: object) -> Tensor:
        seen.append(float(rendered.maps["gain"].detach()))
        return (rendered.maps["gain"] - 2).square()

    def parts(scene) -> tuple[Part, ...]:
        return (PerView([view.camera.name for view in scene.train]),)

    method = model(parts, (LossTerm("gain", 1.0, bright),))
    scene = named(small_scene())
    Trainer(method, scene, seed=1).run()
    (group,) = method.groups
    gains = group["gain"].detach()  # type: ignore[index]
    assert len(seen) == 40
    assert len({view.camera.name for view in scene.train}) == len(gains) > 1
    assert bool((gains > 1).all())
    first, stranger = scene.train[0].camera, replace(scene.train[0].camera, name="nobody")
    by_name, by_mean = (method.render(camera, 40, Mode.EVALUATE) for camera in (first, stranger))
    assert float(by_name.maps["gain"]) == float(gains[0])
    assert float(by_mean.maps["gain"]) == pytest.approx(float(gains.mean()))
    torch.testing.assert_close(by_name.image / gains[0], by_mean.image / gains.mean())


def test_a_part_may_say_what_is_composited_of_the_base_set():
    """Half of every colour, and a fourth column that a channel which is no column of its own makes."""

    class Half(Part):
        name = "half"

        def __init__(self, base: BaseSet) -> None:
            self.base = base

        def paint(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
            glow = self.base.set.gaussians.activated("glow").mean(1, keepdim=True)
            return torch.cat((0.5 * rows.colors, glow), dim=1)

    plain = model(lambda scene: ())
    painted = model(lambda scene: ())
    glow = Channel("glow", 0.7, "identity", shape=(48,), rate=0.1, bounds=(-9.0, 9.0), composited=False)
    painted.base.set.adopt(painted.base.set.gaussians.with_channels(glow))
    painted.base.painter = Half(painted.base)
    camera = small_scene().train[0].camera
    found, expected = (each.render(camera, 0, Mode.EVALUATE) for each in (painted, plain))
    assert found.buffers.features.shape[0] == 4
    torch.testing.assert_close(found.image, 0.5 * expected.image)
    torch.testing.assert_close(found.buffers.features[3], 0.7 * found.buffers.alpha)
    painted.base.painter = None
    assert torch.equal(painted.render(camera, 0, Mode.EVALUATE).image, expected.image), "no column of its own"
