"""The model of a method: parts that are rendered and trained together. The one class that every method's spec composes.

A part is a set of Gaussians with what belongs to it (:mod:`rtgs.methods.parts`). Parts know those they are given, never
the method they are in; the model asks them in order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.exposure import Exposure
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.parts.part import Frame, Part, Raster
from rtgs.methods.parts.poses import Poses
from rtgs.methods.spec import Setup
from rtgs.train.method import (
    LossValues,
    Mode,
    Observation,
    RenderedView,
    RenderOptions,
    Stage,
    StepEvent,
)
from rtgs.train.parameters import ParameterGroup
from rtgs.train.terms import LossTerm, table_of

if TYPE_CHECKING:
    from rtgs.light.cubemap import DirectionalLight
    from rtgs.methods.settings import MethodSettings
    from rtgs.render.buffers import RasterBuffers
    from rtgs.scenes.scene import View

NO_OPTIONS = RenderOptions()


class Model:
    """What trains (:class:`rtgs.train.method.Method`): the parts of a method and its loss.

    ``model["base"]`` is the set of that name; its ``gaussians`` are the Gaussians. ``model.loss`` is the table of loss
    terms.

    Parameters
    ----------
    setup : Setup
        What the method is composed from.
    parts : sequence of Part
        In the order in which they join, the base set first.
    terms : iterable of LossTerm or Decision, optional
        In the order of the log, and in the place of those that this run is without, why.

    Raises
    ------
    TypeError
        The first part is no base set.
    """

    def __init__(self, setup: Setup, parts: Sequence[Part], terms: Iterable[LossTerm | Decision] = ()) -> None:
        first, *_ = parts
        if not isinstance(first, BaseSet):
            raise TypeError(f"the first part of method {setup.spec.name} is a {type(first).__name__}, not a BaseSet")
        self.spec = setup.spec
        self.settings = setup.settings
        self.schedule = setup.schedule
        self.stages = setup.stages
        self.generator = setup.generator
        self.extent = setup.scene.extent
        learned = photo_parts(setup)
        parts = (*parts, *learned)
        self.parts = {part.name: part for part in parts}
        if len(self.parts) < len(parts):
            names = ", ".join(part.name for part in parts)
            raise ValueError(f"method {setup.spec.name} has two parts of one name: {names}")
        self.base = first
        found = (*terms, *(term for part in learned for term in part.terms()))
        self.loss = table_of(setup.settings.loss, (term for term in found if isinstance(term, LossTerm)))
        self._decisions = (*(term for term in found if isinstance(term, Decision)), *setup.decisions)

    # ---- what there is

    @property
    def name(self) -> str:
        """The method's name."""
        return self.spec.name

    @property
    def maps(self) -> tuple[str, ...]:
        """Of :class:`RenderOptions`, those that :meth:`render` can give."""
        return self.base.kind.maps

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What this run does without or differently, as far as it is known by now."""
        return (*self._decisions, *(each for part in self.parts.values() for each in part.decisions))

    @property
    def sets(self) -> tuple[GaussianSet, ...]:
        """The sets of Gaussians in training."""
        return tuple(each for part in self.parts.values() for each in part.sets)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        """The groups of tensors in training that are no rows of Gaussians."""
        return tuple(each for part in self.parts.values() for each in part.groups)

    @property
    def light(self) -> DirectionalLight | None:
        """The far light that surfaces mirror, where a part has one at present."""
        return next((light for part in self.parts.values() if (light := part.light) is not None), None)

    def find(self, name: str) -> GaussianSet | None:
        """The set of this name; None while there is none."""
        return next((each for each in self.sets if each.name == name), None)

    def __getitem__(self, name: str) -> GaussianSet:
        """The set of this name.

        Raises:
            KeyError: there is none, at present.
        """
        found = self.find(name)
        if found is None:
            raise KeyError(f"method {self.spec.name} has no set {name!r} now: it has {[s.name for s in self.sets]}")
        return found

    def recipe(self, stage: str) -> MethodSettings:
        """The settings as the stage of this name reads them."""
        return self.spec.stage(stage).reads(self.settings)

    # ---- training

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """Every part takes up its work of the stage."""
        return tuple(event for part in self.parts.values() for event in part.begin(stage))

    def render(
        self,
        camera: Camera,
        step: int,
        mode: Mode,
        options: RenderOptions = NO_OPTIONS,
        mask: Tensor | None = None,
    ) -> RenderedView:
        """Render one view as of ``step``; the model stays as it is, but for draws of its generator in training.

        Parameters
        ----------
        camera : Camera
            Where it is seen from.
        step : int
            Of the training; after it, the number of steps that were trained.
        mode : Mode
            ``Mode.TRAIN`` adds the maps that the losses of this step need, and the observations of density control.
        options : RenderOptions, optional
            More maps.
        mask : (H, W) bool Tensor, optional
            The view's own mask of its transparent objects: for methods with a stage for them.

        Returns
        -------
        RenderedView
            The image and its maps.
        """
        return self.seen(self.aimed(Frame(camera, step, mode, options, mask)))

    @torch.no_grad()
    def surface(self, camera: Camera, step: int, options: RenderOptions = NO_OPTIONS) -> RasterBuffers:
        """The buffers of :meth:`render`, without what it makes of them; no gradients."""
        return self.rasterize(self.aimed(Frame(camera, step, Mode.EVALUATE, options))).buffers

    def aimed(self, frame: Frame) -> Frame:
        """As every part has it: with the camera as it is moved by now."""
        for part in self.parts.values():
            frame = part.aim(frame)
        return frame

    def seen(self, frame: Frame) -> RenderedView:
        """A view that has been aimed, rendered; :meth:`render` aims it first."""
        shaded = self._shade(frame)
        for part in self.parts.values():
            shaded = part.finish(frame, shaded)
        return shaded

    def _shade(self, frame: Frame) -> RenderedView:
        """By the last part that does."""
        raster = self.rasterize(frame)
        for part in reversed(self.parts.values()):
            if (shaded := part.shade(frame, raster)) is not None:
                return shaded
        raise RuntimeError(f"no part of method {self.spec.name} shades")  # the base set always does

    def rasterize(self, frame: Frame) -> Raster:
        """The base set's maps: those asked for, those the losses of this step need, those that parts shade with."""
        wanted = frame.options.plus(self.loss.needs(frame.step)) if frame.training else frame.options
        for part in self.parts.values():
            wanted = wanted.plus(part.needs(frame))
        appended = [rows for part in self.parts.values() if (rows := part.appended(frame)) is not None]
        return self.base.rasterize(frame, wanted, appended)

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossValues:
        """L1 and D-SSIM always, the other terms while they act (method.md 5)."""
        for part in self.parts.values():
            part.saw(rendered, view)
        return self.loss.evaluate(rendered, view, step)

    def after_step(self, step: int, observations: tuple[Observation, ...]) -> tuple[StepEvent, ...]:
        """Adam on all parts, then what they decide and change before step ``step + 1``.

        Raises
        ------
        NonFiniteGradientError
            A gradient held NaN or inf.
        RtgsError
            Density control left no Gaussian.
        """
        seen = {each.set_name: each for each in observations}
        for part in self.parts.values():
            part.step(step, seen)
            for group in part.groups:
                group.step(step)
        return tuple(self._between(step + 1))

    def _between(self, following: int) -> Iterator[StepEvent]:
        def look(view: View, options: RenderOptions) -> RenderedView:
            return self.render(view.camera, following, Mode.EVALUATE, options, view.mask)

        for part in self.parts.values():
            yield from part.judge(following, look)
        for part in self.parts.values():
            yield from part.control(following)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        """Flat mapping of every tensor that training needs to go on, generator included."""
        tensors = {"generator": self.generator.get_state()}
        for each in (*self.sets, *self.groups, *self.parts.values()):
            more = each.state()
            if twice := sorted(tensors.keys() & more.keys()):
                raise ValueError(f"two sets, groups or parts of method {self.name} write {twice[0]} into a checkpoint")
            tensors.update(more)
        return tensors

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from :meth:`state` of any stage."""
        for part in self.parts.values():
            part.restore(state)
        self.generator.set_state(state["generator"])
        for each in (*self.sets, *self.groups):
            each.load(state)


def photo_parts(setup: Setup) -> tuple[Poses | Exposure, ...]:
    """What any method learns of each training photo, where its settings ask for it.

    Raises:
        RtgsError: the method cannot learn it.
    """
    settings = setup.settings
    setup.spec.refuse_poses(settings)
    asked = ((settings.poses.enabled, Poses), (settings.appearance.enabled, Exposure))
    return tuple(kind(setup) for enabled, kind in asked if enabled)
