"""What a method is: the protocol between a recipe and the one training loop that trains them all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from rtgs.core.decisions import Decision
from rtgs.train.settings import MethodSettings, ScheduleSettings

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.methods.surfel_set import SurfelSet
    from rtgs.render.buffers import RasterBuffers
    from rtgs.scenes.scene import View


@dataclass(frozen=True)
class Stage:
    """A stretch of training that is one pipeline step of its own (the artifact in between is cached)."""

    name: str
    from_step: int  # first step of the stage
    until: int  # first step that no longer belongs to it


@dataclass(frozen=True)
class RenderOptions:
    """Optional maps of one rendered view. Training leaves this to the method: what its losses need at this step."""

    depth: bool = False
    median_depth: bool = False
    normal: bool = False
    distortion: bool = False
    layers: bool = False  # what reflection and transmission add, of methods that have them
    masks: str = ""  # which pixels show a transparent object: "given", "silhouette"; "": as the settings say


@dataclass(frozen=True)
class SpecularLayers:
    """What a view with reflection is made of: image = diffuse part (1 - k_s) C_d + reflection + transmission."""

    diffuse: Tensor  # (3, H, W) C_d
    reflection: Tensor  # (3, H, W) k_s w_r C_r; 0 where no ray was traced
    reflected_color: Tensor  # (3, H, W) C_r; 0 where no ray was traced
    specular: Tensor  # (H, W) k_s as composited
    roughness: Tensor  # (H, W) in 0..1
    f0: Tensor  # (H, W), or (3, H, W) for rgb
    traced: Tensor  # (H, W) bool
    transmission: Tensor | None = None  # (3, H, W) k_s w_t C_t; 0 outside transparent objects; None: no third stage
    transmitted_color: Tensor | None = None  # (3, H, W) C_t


@dataclass(frozen=True)
class FirstBounce:
    """What the first straight rays met, for the loss on their depth (method.md 5.1); R rays that have a back surface.

    Depths count from the first surface, in z-depth units.
    """

    depth: Tensor  # (R,) Z_1 = sum of w t, with its graph
    alpha: Tensor  # (R,) A_1, with its graph
    thickness: Tensor  # (R,) z_2 - z_s, no graph
    beyond: Tensor | None = None  # (R,) sum of w (t - thickness) over the hits behind the back surface, if asked for


@dataclass(frozen=True)
class RenderedView:
    """What a method shows from one camera."""

    camera: Camera
    image: Tensor  # (3, H, W) sRGB, not clamped
    buffers: RasterBuffers  # of the base set; maps that were not asked for are None
    layers: SpecularLayers | None = None  # of methods with reflection, when asked for
    specular: Tensor | None = None  # (H, W) k_s as composited, with its graph
    first_bounce: FirstBounce | None = None  # of the third stage, in training
    transparent: Tensor | None = None  # (H, W) bool: pixels that got straight rays; None: no third stage


@dataclass(frozen=True)
class LossTerm:
    """One weighted term of the loss, for the log and for the guard."""

    name: str
    value: float  # before the weight
    weight: float


@dataclass(frozen=True)
class LossTerms:
    """The loss of one step."""

    total: Tensor  # scalar with its graph: the weighted sum of the terms
    terms: tuple[LossTerm, ...]

    def plus(self, name: str, value: Tensor, weight: float) -> LossTerms:
        """With one more term: ``value`` (scalar, unweighted, with its graph)."""
        term = LossTerm(name, float(value.detach()), weight)
        return LossTerms(self.total + weight * value, (*self.terms, term))


@dataclass(frozen=True)
class StepEvent:
    """A change of a set between two steps worth a line in the log: density control, an opacity reset."""

    kind: str  # "density", "opacity_reset", "propagation", "begin" or "decision"
    set_name: str
    detail: str


class Method(Protocol):
    """A composition of sets, shading, losses and schedule. The trainer knows no method by name.

    ``state`` is a flat mapping from dotted names to tensors, as safetensors wants it: everything :meth:`load` needs to
    go on bit for bit.
    """

    settings: MethodSettings
    schedule: ScheduleSettings
    stages: tuple[Stage, ...]
    maps: tuple[str, ...]  # of RenderOptions, those that render() can give
    decisions: tuple[Decision, ...]

    @property
    def sets(self) -> tuple[SurfelSet, ...]:
        """The sets of surfels in training, each with its optimiser and density control."""
        ...

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """Called once when a stage starts afresh (not when it goes on from a checkpoint of its own)."""
        ...

    def render(
        self, camera: Camera, step: int, options: RenderOptions | None = None, mask: Tensor | None = None
    ) -> RenderedView:
        """Render one view as of ``step``. ``options=None``: the outputs that the losses of this step need.

        ``mask`` (H, W) bool, the view's own of its transparent objects: for methods with a third stage.
        """
        ...

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossTerms:
        """The loss of a view rendered with ``options=None`` at the same step."""
        ...

    def after_step(self, step: int) -> tuple[StepEvent, ...]:
        """After the backward pass: Adam, then density control as the schedule asks before step ``step + 1``."""
        ...

    def state(self) -> dict[str, Tensor]: ...

    def load(self, state: dict[str, Tensor]) -> None: ...
