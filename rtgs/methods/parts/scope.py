"""The scope of reflection of a model: known when it is made, or found once in the second stage (scope=specular)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.gaussians.primitives import Gaussians
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.part import Look, Part
from rtgs.methods.parts.specular_pixels import SpecularMaps, SpecularShare, robust_sphere, specular_pixels
from rtgs.methods.plans import reflection_plan
from rtgs.methods.scope import Scope, ScopeSettings, scope_of
from rtgs.train.method import StepEvent

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup

KEY = "method.own.scope=specular"
LEAST_SEEN = 1e-4  # weight of specular Gaussians in a pixel with less of which they have no depth there

SpecularOf = Callable[[Gaussians], Tensor]
"""(N,) how specular Gaussians of the second stage are, 0..1."""


class ScopeHolder(Part):
    """The sphere outside of which nothing reflects, where there is one; parts and loss terms read it.

    Attributes:
        scope: the sphere; None: everything may reflect.
        looked_at: the step before which specular pixels are looked for, where they give the scope.
    """

    name = "scope"

    def __init__(self, setup: Setup, base: BaseSet, own: ScopeSettings, channel: str, specular_of: SpecularOf) -> None:
        """``channel``: one that the base set has from the second stage on.

        Raises:
            RtgsError: a mask does not fit its picture.
        """
        self.settings = setup.settings
        self.base = base
        self._own = own
        self._channel = channel
        self._specular_of = specular_of
        self._views = setup.scene.train
        self._total = setup.schedule.total
        self.scope, self._said = scope_of(own, setup.scene)
        self.looked_at = own.looked_at(reflection_plan(setup.settings.reflection, setup.schedule).start, setup.schedule)
        self._seen: SpecularShare | None = None

    @property
    def pending(self) -> bool:
        """Whether the scope is still to be found in this run."""
        return self._own.scope == "specular" and self._seen is None and self.looked_at < self._total

    @property
    def decisions(self) -> tuple[Decision, ...]:
        if self._own.scope != "specular":
            return self._said
        if self._seen is not None:
            few = f", and {100 * self._own.scope_share:g} % must be" if self.scope is None else ""
            return (_decision(self.scope, f"{self._seen} before step {self.looked_at}{few} ({KEY})"),)
        if self.pending:
            return ()
        return (_decision(None, f"the second stage is too short to look for what is specular ({KEY})"),)

    def judge(self, following: int, look: Look) -> Iterator[StepEvent]:
        """Look at the training views, once; the scope holds from step ``following`` on."""
        if not self.pending or following != self.looked_at:
            return
        own = self._own
        views = (self._maps(view.camera, following) for view in self._views)
        found = specular_pixels(views, own.scope_specular, len(self._views))
        self._seen = SpecularShare(found.share)
        if found.share >= own.scope_share:
            center, radius = robust_sphere(found.points)
            self.scope = Scope(tuple(center.tolist()), own.scope_margin * radius)
        (decision,) = self.decisions
        yield StepEvent("decision", self.name, f"{decision.what}: {decision.why}")

    @torch.no_grad()
    def _maps(self, camera: Camera, step: int) -> SpecularMaps:
        """Depths are of what is specular alone: elsewhere in the pixel the background shines through."""
        gaussians = self.base.set.gaussians
        value, axis = self._specular_of(gaussians), camera.rotation[2]
        depth = ((gaussians.means.double() * axis).sum(1) + camera.translation[2]).float()
        specular = (value >= self._own.scope_specular).float()
        sums, alpha = self.base.sums_of(torch.stack((value, specular, specular * depth), dim=1), camera, step)
        mean = sums[0] / alpha.clamp_min(LEAST_SEEN)
        depth = torch.where(sums[1] > LEAST_SEEN, sums[2] / sums[1].clamp_min(LEAST_SEEN), 0.0)
        return SpecularMaps(camera, mean, alpha, depth)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        """Of what was found: typed ones follow from the settings."""
        if self._own.scope == "sphere" or self._channel not in self.base.set.gaussians:
            return {}
        seen = {} if self._seen is None else self._seen.state()
        return seen if self.scope is None else {**seen, **self.scope.state()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """What was found, or that nothing was; before the second stage that is still open."""
        if self._own.scope == "sphere":
            return
        if self._own.scope == "specular" or f"{self.base.name}.surfels.{self._channel}" in state:
            self.scope = Scope.of(state)
        self._seen = SpecularShare.of(state)


def _decision(scope: Scope | None, why: str) -> Decision:
    return Decision("no scope, all may reflect" if scope is None else f"reflection in {scope}", why)
