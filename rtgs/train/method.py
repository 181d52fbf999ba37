"""What training needs of a method: the contract between a recipe and the one loop that trains them all.

A method owns what trains, renders views of it, and says what changes between steps. The loop owns views, the backward
pass, checkpoints and progress; it knows no method by name. ``rtgs.methods`` composes methods, and any object with
these members can be trained.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.core.decisions import Decision
    from rtgs.render.buffers import RasterBuffers
    from rtgs.scenes.scene import View
    from rtgs.train.settings import ScheduleSettings


class Mode(Enum):
    """What a view is rendered for."""

    TRAIN = "train"  # for a loss: graphs, what density control learns from, pixels drawn at random
    EVALUATE = "evaluate"  # to be looked at or measured: every pixel, nothing observed


@dataclass(frozen=True)
class Stage:
    """A stretch of training that is one pipeline step of its own (the artifact in between is cached)."""

    name: str
    from_step: int  # first step of the stage
    until: int  # first step that no longer belongs to it
    joined: int = 0  # it is trained up to this step, and is gone on with on held-out views as well; 0: it is begun


@dataclass(frozen=True)
class RenderOptions:
    """Optional maps of one rendered view. In training a method adds what its losses need at the step."""

    depth: bool = False
    median_depth: bool = False
    normal: bool = False
    distortion: bool = False
    layers: bool = False  # what reflection and transmission add, of methods that have them
    weights: bool = False  # with ``layers``: how much each of them counts
    masks: str = ""  # which pixels show a transparent object: "given", "silhouette"; "": as the settings say

    def plus(self, other: RenderOptions) -> RenderOptions:
        """These maps and those of ``other``."""
        flags = [each.name for each in fields(self) if each.name != "masks"]
        return replace(self, **{name: getattr(self, name) or getattr(other, name) for name in flags})


@dataclass(frozen=True)
class Observation:
    """What density control of one set learns from one view rendered for training."""

    set_name: str
    probe: Tensor  # (N, 2 or 3); after the backward pass its gradient is the densification signal
    weight_sum: Tensor  # (N,) summed compositing weights


@dataclass(frozen=True)
class Drawn:
    """What a training step looks at, where it does not look at all of a view."""

    weight: Tensor  # (H, W) 1 / the probability with which a pixel is drawn; 0: this time it is not

    @property
    def pixels(self) -> Tensor:
        """(H, W) bool: those that are drawn. What the image shows in others means nothing."""
        return self.weight > 0


@dataclass(frozen=True)
class RenderedView:
    """What a method shows from one camera.

    Maps and layers go by name; each is (C, H, W) or (H, W). Names of this package's methods:

    - ``maps``, with their graph in training: ``specular``, k_s as composited, of methods with reflection;
      ``transparent``, bool, the pixels that got straight rays.
    - ``layers``, image = (1 - specular) diffuse + reflection + transmission where ``traced``: ``diffuse``
      C_d; ``reflection`` k_s w_r C_r and ``transmission`` k_s w_t C_t, 0 where no ray was traced; ``reflected_color``
      C_r and ``transmitted_color`` C_t; ``specular``, ``roughness``, ``f0`` as composited; ``traced``, bool. With
      ``weights`` also ``reflection_weight`` k_s w_r and ``transmission_weight`` k_s w_t, (H, W), means over colours:
      what ``reflected_color`` and ``transmitted_color`` are multiplied with.
      Methods that add the reflection without taking from C_d have ``base``, what is left of the image without it, and
      ``diffuse`` is the same.
    """

    camera: Camera
    image: Tensor  # (3, H, W) sRGB, not clamped
    buffers: RasterBuffers  # of the base set; maps that were not asked for are None
    layers: Mapping[str, Tensor] | None = None  # what the image is made of, when asked for; None: it has no layers
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    kept: object = None  # what the part that shaded keeps for loss terms of its own; None: nothing
    observations: tuple[Observation, ...] = ()  # in training, of the sets whose density control will run again
    drawn: Drawn | None = None  # in training; None: every pixel


@dataclass(frozen=True)
class LossValue:
    """One term of the loss of one step, for the log and for the guard."""

    name: str
    value: float  # before the weight
    weight: float


@dataclass(frozen=True)
class LossValues:
    """The loss of one step."""

    total: Tensor  # scalar with its graph: the weighted sum of the terms
    terms: tuple[LossValue, ...]

    def plus(self, name: str, value: Tensor, weight: float) -> LossValues:
        """With one more term: ``value`` (scalar, unweighted, with its graph)."""
        term = LossValue(name, float(value.detach()), weight)
        return LossValues(self.total + weight * value, (*self.terms, term))


@dataclass(frozen=True)
class StepEvent:
    """A change between two steps worth a line in the log: density control, an opacity reset."""

    kind: str  # "density", "opacity_reset", "propagation", "begin" or "decision"
    set_name: str
    detail: str


class Trained(Protocol):
    """Named tensors that one optimiser moves: a set of Gaussians, or a group of tensors that are no rows of them."""

    name: str

    def __len__(self) -> int: ...

    def tensors(self) -> Iterable[tuple[str, Tensor]]:
        """Every parameter by name, with its gradient in ``.grad`` between backward pass and step."""
        ...


class Method(Protocol):
    """What the trainer trains.

    ``state`` is a flat mapping from dotted names to tensors, as safetensors wants it: everything :meth:`load` needs to
    go on bit for bit.
    """

    schedule: ScheduleSettings
    stages: tuple[Stage, ...]

    @property
    def name(self) -> str:
        """What messages call it."""
        ...

    @property
    def maps(self) -> tuple[str, ...]:
        """Of :class:`RenderOptions`, those that :meth:`render` can give."""
        ...

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What this run does without or differently, as far as it is known by now."""
        ...

    @property
    def sets(self) -> tuple[Trained, ...]:
        """The sets of Gaussians in training."""
        ...

    @property
    def groups(self) -> tuple[Trained, ...]:
        """The named groups of tensors in training that are no rows of Gaussians."""
        ...

    def recipe(self, stage: str) -> object:
        """The settings as the stage of this name reads them: a checkpoint of it fits a run with equal ones."""
        ...

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """Called once when a stage starts afresh (not when it goes on from a checkpoint of its own)."""
        ...

    def render(
        self,
        camera: Camera,
        step: int,
        mode: Mode,
        options: RenderOptions = RenderOptions(),
        mask: Tensor | None = None,
    ) -> RenderedView:
        """Render one view as of ``step``; leaves the method as it is, but for draws of its generator in training.

        ``mode=TRAIN`` adds the maps that the losses of this step need, and the observations of density control.
        ``mask`` (H, W) bool, the view's own of its transparent objects: for methods with a stage for them.
        """
        ...

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossValues:
        """The loss of a view rendered with ``Mode.TRAIN`` at the same step."""
        ...

    def after_step(self, step: int, observations: tuple[Observation, ...]) -> tuple[StepEvent, ...]:
        """After the backward pass of the view that gave ``observations``: Adam, then what the schedule asks before
        step ``step + 1``."""
        ...

    def state(self) -> dict[str, Tensor]: ...

    def load(self, state: dict[str, Tensor]) -> None: ...
