"""Loss terms: one idiom for all of them. A term is a value, a weight, when it acts, and the maps it needs.

A term of weight 0 is never made, so it costs nothing, and neither does a map that only it needs: the maps of a
training view are the union of what the terms of its step ask for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.core.decisions import Decision
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.train.losses import photometric_loss
from rtgs.train.method import Drawn, LossValue, LossValues, RenderedView, RenderOptions
from rtgs.train.schedule import loss_start

if TYPE_CHECKING:
    from rtgs.scenes.scene import View
    from rtgs.train.settings import LossSettings

NO_MAPS = RenderOptions()
BRIGHTEST = 254.5 / 255  # a photo's value from which on the light may have been more

TermValue = Callable[[RenderedView, "View"], Tensor | None]
"""From a rendered view and the photo to the unweighted scalar; None: this view gives the term nothing to act on."""


@dataclass(frozen=True)
class LossTerm:
    """One weighted term.

    Parameters
    ----------
    name : str
        In the log and in the guard's report.
    weight : float
        Above 0; a term of weight 0 is not made.
    value : callable
        From the rendered view and the photo to the unweighted scalar with its graph, or to None where the view has
        nothing for the term.
    start : int, optional
        First step at which the term acts.
    until : float, optional
        First step at which it no longer does.
    needs : RenderOptions, optional
        Maps of the base set that :attr:`value` reads.

    Raises
    ------
    ValueError
        The weight is not above 0.
    """

    name: str
    weight: float
    value: TermValue
    start: int = 0
    until: float = math.inf
    needs: RenderOptions = NO_MAPS

    def __post_init__(self) -> None:
        if not (math.isfinite(self.weight) and self.weight > 0):
            raise ValueError(f"loss term {self.name!r} has the weight {self.weight}: leave it out, or give one above 0")

    def acts(self, step: int) -> bool:
        """Whether the term is on at ``step``."""
        return self.start <= step < self.until


@dataclass(frozen=True)
class LossTable:
    """The loss of a method: L1 and D-SSIM of the image (one fused kernel), and its terms in the order of the log."""

    l1: float
    dssim: float
    terms: tuple[LossTerm, ...] = ()
    clipped: bool = False  # what a photo cannot show is no error: see :func:`as_the_sensor`

    def needs(self, step: int) -> RenderOptions:
        """The maps that the terms of ``step`` read, and no others."""
        wanted = NO_MAPS
        for term in self.terms:
            wanted = wanted.plus(term.needs) if term.acts(step) else wanted
        return wanted

    def evaluate(self, rendered: RenderedView, view: View, step: int) -> LossValues:
        """The weighted sum of what acts at ``step``."""
        if self.clipped:
            rendered = replace(rendered, image=as_the_sensor(rendered.image, view.image))
        if rendered.drawn is not None:
            rendered = replace(rendered, image=as_drawn(rendered.image, view.image, rendered.drawn))
        photometric = photometric_loss(rendered.image, view.image, self.l1, self.dssim)
        first = (LossValue("l1", photometric.l1, self.l1), LossValue("dssim", photometric.dssim, self.dssim))
        found = LossValues(photometric.total, first)
        for term in self.terms:
            if term.acts(step) and (value := term.value(rendered, view)) is not None:
                found = found.plus(term.name, value, term.weight)
        return found

    def plus(self, terms: Iterable[LossTerm]) -> LossTable:
        """With more terms behind those that are there."""
        return replace(self, terms=(*self.terms, *terms))


def as_the_sensor(image: Tensor, photo: Tensor) -> Tensor:
    """(3, H, W) the image, no brighter than 1 where the photo is at its brightest value; there is no gradient from what
    is cut off. float32 by a native kernel, any other dtype in plain torch."""
    if all(each.dtype == torch.float32 and each.device.type == "cpu" for each in (image, photo)):
        return _AsTheSensor.apply(image, photo)  # type: ignore[return-value]
    return as_the_sensor_twin(image, photo)


def as_the_sensor_twin(image: Tensor, photo: Tensor) -> Tensor:
    """:func:`as_the_sensor` in plain torch."""
    return image.masked_fill((photo >= BRIGHTEST) & (image > 1), 1.0)


class _AsTheSensor(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, photo: Tensor) -> Tensor:
        cut = torch.empty(image.shape)
        ctx.save_for_backward(image, photo)
        core.cut_light(*arrays_of(image, photo), BRIGHTEST, *arrays_of(cut), threads())
        return cut

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        gradient = torch.empty(upstream.shape)
        given = (*arrays_of(*ctx.saved_tensors), BRIGHTEST, *arrays_of(upstream, gradient))
        core.cut_light_backward(*given, threads())
        return gradient, None


def as_drawn(image: Tensor, photo: Tensor, drawn: Drawn) -> Tensor:
    """(3, H, W) the image, and the photo in pixels that were not drawn: there is no error and no gradient. The gradient
    of the others counts by their weight; values do not, so that a loss is that of what was drawn."""
    return _AsDrawn.apply(image, photo, drawn)  # type: ignore[return-value]


class _AsDrawn(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, photo: Tensor, drawn: Drawn) -> Tensor:
        ctx.weight = drawn.weight
        return torch.where(drawn.pixels, image, photo)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        return upstream * ctx.weight, None, None


def table_of(settings: LossSettings, terms: Iterable[LossTerm]) -> LossTable:
    """The table with the photometric weights of the settings."""
    return LossTable(settings.l1, settings.dssim, tuple(terms), settings.clipped)


def term_start(name: str, weight: float, share: float, total: int, method: str) -> int | Decision:
    """First step of a term that starts after ``share`` of a run of ``total`` steps, or why the run is without it."""
    if weight == 0:
        return Decision(f"no {name} loss", f"its weight is 0 in method {method}")
    first = loss_start(share, total)
    if first >= total:
        return Decision(f"no {name} loss", f"it starts after {share:g} of the run, beyond {total} steps")
    return first
