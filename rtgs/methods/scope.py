"""Where a method may reflect: a sphere in the world, typed by hand as published, around what the masks show, or around
the pixels that turn out specular in training."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rtgs.core.decisions import Decision
from rtgs.core.refuse import refuse_bad_point, refuse_outside, refuse_unknown_words, refuse_unless
from rtgs.train.schedule import opacity_reset_due

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.scenes.scene import Scene
    from rtgs.train.settings import ScheduleSettings

_STATE = "scope"  # (4,) float64 centre and radius


@dataclass(frozen=True)
class ScopeSettings:
    """Keys ``method.own.<name>`` of methods with a scope."""

    # masks: around what they show, none where the scene has none
    # specular: around the pixels that turn out specular in training, none where they are too few
    scope: Literal["sphere", "masks", "specular"] = "sphere"
    scope_radius: float = 0.0  # world units, of the sphere; 0: no scope
    scope_center: tuple[float, ...] = (0.0, 0.0, 0.0)  # world
    # of scope=specular: the share of the second stage after which the training views are looked at, once
    # where opacities are reset, right before the next reset
    scope_at: float = 0.3
    scope_specular: float = 0.3  # of scope=specular: from this on a pixel is specular
    scope_share: float = 0.002  # of the training views' pixels must be, as of method.reflection.matte
    scope_margin: float = 1.1  # times the radius of what is found

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.own")
        refuse_outside(self, "method.own", 0, math.inf, "scope_radius")
        refuse_bad_point(self.scope_center, "method.own.scope_center")
        refuse_outside(self, "method.own", 0, 1, "scope_at", "scope_specular", "scope_share", open_low=True)
        refuse_outside(self, "method.own", 0, math.inf, "scope_margin", open_low=True)
        if self.scope != "sphere":
            typed = "method.own.scope_radius=0 'method.own.scope_center=[0,0,0]' take away one that a scene's file has"
            beside = f"with method.own.scope={self.scope}, which finds the sphere; {typed}"
            refuse_unless(self.scope_radius == 0, "method.own.scope_radius", self.scope_radius, f"0 {beside}")
            center = list(self.scope_center)
            refuse_unless(not any(center), "method.own.scope_center", center, f"[0, 0, 0] {beside}")

    @property
    def scoped(self) -> bool:
        """There may be a scope: masks are looked for when the model is made, specular pixels in training."""
        return self.scope != "sphere" or self.scope_radius > 0

    def looked_at(self, start: int, schedule: ScheduleSettings) -> int:
        """The step before which specular pixels are looked for, of a second stage from ``start`` on.

        From the end of the run on: never, the stage is too short.
        """
        step = start + max(1, round(self.scope_at * (schedule.total - start)))
        every = schedule.opacity_reset_every
        following = -(-step // every) * every if every > 0 else step
        # What is seen right after a reset is transparent; that of this very step has not happened yet.
        return following if opacity_reset_due(schedule, following) else min(step, max(schedule.total - 1, start + 1))


@dataclass(frozen=True)
class Scope:
    """A sphere."""

    center: tuple[float, ...]
    radius: float

    def holds(self, points: Tensor) -> Tensor:
        """(N,) bool of points (N, 3), world."""
        from rtgs.gaussians.primitives import in_sphere

        return in_sphere(points, self.center, self.radius)

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint: pictures are made from other views than were trained on, whose masks are others, and what
        turned out specular is looked for once."""
        import torch

        return {_STATE: torch.tensor([*self.center, self.radius], dtype=torch.float64)}

    @staticmethod
    def of(state: Mapping[str, Tensor]) -> Scope | None:
        """That of :meth:`state`."""
        if _STATE not in state:
            return None
        *center, radius = state[_STATE].tolist()
        return Scope(tuple(center), radius)

    def __str__(self) -> str:
        x, y, z = self.center
        return f"a sphere of {self.radius:.3g} around ({x:.3g}, {y:.3g}, {z:.3g})"


def scope_of(settings: ScopeSettings, scene: Scene) -> tuple[Scope | None, tuple[Decision, ...]]:
    """The scope of a scene's training views, None: there is none, or none yet where specular pixels are to give it; and
    what is said of it where masks were to give it.

    Raises:
        RtgsError: a mask does not fit its picture.
    """
    if settings.scope != "masks":
        return Scope(settings.scope_center, settings.scope_radius) if settings.scope_radius > 0 else None, ()
    from rtgs.mesh.silhouettes import crossing, enclosing_sphere, mask_set, why_unbounded

    key, masks = "method.own.scope=masks", [view.mask for view in scene.train]
    why = why_unbounded(masks)
    if not why:
        views = mask_set([view.camera for view in scene.train], masks).views
        if crossing(views):
            center, radius = enclosing_sphere(views)
            found = Scope(tuple(center.tolist()), radius)
            return found, (Decision(f"reflection in {found}", key),)
        why = "all masks are seen from one side: they do not say how far away the object is"
    return None, (Decision("no scope, all may reflect", f"{why} ({key})"),)
