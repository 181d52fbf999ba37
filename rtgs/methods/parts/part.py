"""What a model is composed of, and what its parts hand each other for one view."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.render.buffers import RasterBuffers
from rtgs.render.pose import Pose
from rtgs.render.rays import RayTables, taken_rays
from rtgs.train.method import Mode, Observation, RenderedView, RenderOptions, Stage, StepEvent

if TYPE_CHECKING:
    from rtgs.light.cubemap import DirectionalLight
    from rtgs.methods.parts.gaussian_set import GaussianSet
    from rtgs.scenes.scene import View
    from rtgs.train.parameters import ParameterGroup


@dataclass(frozen=True)
class Frame:
    """One view that is being rendered."""

    camera: Camera
    step: int
    mode: Mode
    options: RenderOptions
    mask: Tensor | None = None  # (H, W) bool, the view's own of its transparent objects
    pose: Pose | None = None  # of ``camera``, with its graph, where this view teaches it

    @property
    def training(self) -> bool:
        """The view is rendered for a loss."""
        return self.mode is Mode.TRAIN

    @cached_property
    def rays(self) -> ViewRays:
        """The rays of all pixels.

        Raises:
            RtgsError: the view teaches the pose of its camera, which rays do not.
        """
        if self.pose is not None:
            raise RtgsError(
                f"the pose of view {self.camera.name!r} is learned (method.poses.enabled), but this method traces rays "
                "from its pixels, and they give no gradient of it: set it to false"
            )
        return ViewRays(self.camera)


@dataclass(frozen=True)
class ViewRays:
    """One ray for each of H * W pixels, row by row; float32."""

    camera: Camera

    @cached_property
    def center(self) -> Tensor:
        """(3,) world."""
        return self.camera.center.float()

    @cached_property
    def directions(self) -> Tensor:
        """(3, H * W) world, camera-z component 1."""
        return self.camera.rays().directions.reshape(-1, 3).T

    @cached_property
    def _tables(self) -> RayTables:
        return self.camera.ray_tables()

    def planes(self, pixels: Tensor) -> Tensor:
        """(3, P) directions of flattened pixels (P,)."""
        return taken_rays(self._tables, pixels, rows=False)

    def rows(self, pixels: Tensor) -> Tensor:
        """(P, 3) directions of flattened pixels (P,)."""
        return taken_rays(self._tables, pixels, rows=True)


@dataclass(frozen=True)
class Rows:
    """Gaussians to rasterise with the base set: M activated ones and what is composited of them."""

    shape: ActivatedGaussians
    features: Tensor  # (M, C), C as the base set's


@dataclass(frozen=True)
class Raster:
    """The rasterised base set."""

    buffers: RasterBuffers
    observations: tuple[Observation, ...] = ()
    shape: ActivatedGaussians | None = None  # of the base set's own rows, without what filters add; None: not kept


Look = Callable[["View", RenderOptions], RenderedView]


class Part:
    """A part of a model: its hooks, with nothing in them. A part overrides those in which it has something to do."""

    name: str

    @property
    def sets(self) -> tuple[GaussianSet, ...]:
        """Sets of Gaussians of this part that train at present."""
        return ()

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        """Groups of tensors of this part that train at present."""
        return ()

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What this part does without or differently, as far as it is known by now."""
        return ()

    @property
    def light(self) -> DirectionalLight | None:
        """The far light of this part, as it is at present; None: it has none."""
        return None

    def begin(self, stage: Stage) -> Iterable[StepEvent]:
        """A stage starts afresh."""
        return ()

    def aim(self, frame: Frame) -> Frame:
        """The view as this part has it: from another camera, for example."""
        return frame

    def needs(self, frame: Frame) -> RenderOptions:
        """Maps of the base set that :meth:`shade` and :meth:`finish` read."""
        return RenderOptions()

    def appended(self, frame: Frame) -> Rows | None:
        """What is rasterised with the base set."""
        return None

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """The view from the base set's maps; None: this part leaves it to those before it."""
        return None

    def finish(self, frame: Frame, shaded: RenderedView) -> RenderedView:
        """The view that some part shaded, changed: what happens in the camera, for example."""
        return shaded

    def saw(self, rendered: RenderedView, view: View) -> None:
        """A training view as it came out, before the backward pass."""

    def step(self, step: int, observations: Mapping[str, Observation]) -> None:
        """Adam on the sets after the backward pass; ``observations`` of the view by the name of the set. The model
        steps the groups."""

    def judge(self, following: int, look: Look) -> Iterable[StepEvent]:
        """Whether the part goes on, before anything changes ahead of step ``following``; ``look`` renders a training
        view as the whole model shows it now."""
        return ()

    def control(self, following: int) -> Iterable[StepEvent]:
        """Density control and resets before step ``following``."""
        return ()

    def state(self) -> dict[str, Tensor]:
        """Tensors beside those of :attr:`sets` and :attr:`groups`."""
        return {}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Take over :meth:`state`, and have the sets and groups that the state holds, with the channels it holds of
        them: their tensors follow."""
