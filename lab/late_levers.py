"""Levers on the last part of a training, put on a model from outside: see ``lab.late_training``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.density import DensityControl, DensityReport, RowPlan, apply_plan, select_rows
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods.model import Model
from rtgs.methods.parts.kinds import RasterRequest
from rtgs.train.guard import check_loss
from rtgs.train.method import Method, Mode, RenderOptions
from rtgs.train.schedule import densify_ahead
from rtgs.train.trainer import Trainer

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

BAD_SHARE = 0.2  # of the pixels of a view: those of the largest error
CONTRIBUTES = 0.5  # summed weight on them, in pixels, from which on a Gaussian contributes


class SeveralViewsTrainer(Trainer):
    """A trainer whose every step of Adam has the mean gradient of several views, once density control is over.

    Attributes:
        views: how many.
        advance: by how much the schedule moves a step; ``views``: as many views as without, in fewer steps of Adam.
    """

    views = 1
    advance = 1

    def _train_step(self) -> None:
        if self.views == 1:
            return super()._train_step()
        if densify_ahead(self.schedule, self._step):  # it would learn of one view only
            raise ValueError(f"density control still runs after step {self._step}: several views come after it")
        for k in range(self.views):
            step = self._step + min(k, self.advance - 1)
            view = self._growing.at(self._order.next(), step)
            terms = self.method.losses(self.method.render(view.camera, step, Mode.TRAIN, mask=view.mask), view, step)
            self._averages.add_loss(check_loss(terms, self.method, step, view.name))
            (terms.total / self.views).backward()
        self.method.after_step(self._step + self.advance - 1, ())
        self._step += self.advance
        return None


class Averages:
    """Running means of all raw parameters, each from a step of its own on; an observer of the trainer.

    Parameters
    ----------
    starts : mapping of str to int
        First step of each uniform mean by its name.
    decays : mapping of str to (int, float)
        First step of each exponential mean, and what is left of it after another look.
    every : int
        Steps between looks.
    """

    def __init__(
        self, starts: Mapping[str, int], decays: Mapping[str, tuple[int, float]] | None = None, every: int = 5
    ) -> None:
        self._starts = dict(starts)
        self._decays = dict(decays or {})
        self._every = every
        self._looks: dict[str, int] = {}
        self.means: dict[str, list[Tensor]] = {}

    @torch.no_grad()
    def look(self, method: Method, step: int) -> None:
        """Take the parameters after ``step`` steps into every mean that has begun."""
        if step % self._every:
            return
        begun = [name for name, start in self._starts.items() if step > start]
        begun += [name for name, (start, _) in self._decays.items() if step > start]
        for name in begun:
            count = self._looks[name] = self._looks.get(name, 0) + 1
            decay = self._decays[name][1] if name in self._decays else 1.0
            fresh = max(1 / count, 1 - decay)  # an exponential mean begins as a uniform one
            values = parameters(method)
            if count == 1:
                self.means[name] = [tensor.detach().clone() for tensor in values]
                continue
            for mean, value in zip(self.means[name], values, strict=True):
                mean.lerp_(value, fresh)


class RandomBackground:
    """Another colour behind the Gaussians in every step, so that what should be opaque cannot count on one; an
    observer of the trainer."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def look(self, method: Method, step: int) -> None:
        """Draw the colour of the step after ``step``."""
        assert isinstance(method, Model)
        method.base._background = torch.rand(3, generator=self._generator)


def parameters(method: Method) -> list[Tensor]:
    """Every tensor in training."""
    return [tensor for part in (*method.sets, *method.groups) for _, tensor in part.tensors()]


@contextmanager
@torch.no_grad()
def swapped(method: Method, values: Sequence[Tensor]) -> Iterator[None]:
    """The method with these parameters; with its own again afterwards."""
    own = [tensor.detach().clone() for tensor in parameters(method)]
    for tensor, value in zip(parameters(method), values, strict=True):
        tensor.copy_(value)
    try:
        yield
    finally:
        for tensor, value in zip(parameters(method), own, strict=True):
            tensor.copy_(value)


def weights_on(model: Model, view: View, step: int, chosen: Callable[[Tensor], Tensor]) -> Tensor:
    """(N,) summed blending weights of the base set's Gaussians on chosen pixels of a view.

    ``chosen`` is given the image (3, H, W) and returns (H, W) bool. A weight is the derivative of a pixel's colour by
    that of the Gaussian, so one backward pass from the first colour gives the sums.
    """
    base, camera = model.base, view.camera
    with torch.no_grad():
        rows = base.set.activated(camera.center.float(), base.sh_degree(step))
    rows = ActivatedGaussians(**{field.name: getattr(rows, field.name).detach() for field in fields(rows)})
    colors = rows.colors.clone().requires_grad_()
    background = torch.tensor(base.settings.render.background)
    request = RasterRequest(camera, RenderOptions(), False, None, background, base.settings.render, base.extent)
    image = base.kind.rasterize(rows, colors, request).features
    wanted = chosen(image.detach())
    (found,) = torch.autograd.grad((image[0] * wanted).sum(), colors)
    return found[:, 0]


def bad_pixels(image: Tensor, photo: Tensor, share: float = BAD_SHARE) -> Tensor:
    """(H, W) bool: the ``share`` of pixels whose mean absolute error is largest."""
    error = (image - photo).abs().mean(0)
    return error > error.flatten().quantile(1 - share)


def votes(model: Model, views: Sequence[View], step: int) -> Tensor:
    """(N,) int64: in how many of the views each Gaussian contributes to pixels of high error."""
    total = torch.zeros(len(model.base.set), dtype=torch.int64)
    for view in views:
        total += weights_on(model, view, step, lambda image, photo=view.image: bad_pixels(image, photo)) >= CONTRIBUTES
    return total


class VotedDensity(DensityControl):
    """Density control that clones and splits by signal only what at least ``least`` views voted for."""

    def __init__(self, settings: DensitySettings, extent: float, ask: Callable[[], Tensor], least: int) -> None:
        super().__init__(settings, extent)
        self._ask = ask
        self.least = least

    def densify(
        self, gaussians: Gaussians, optimizer: GaussianAdam, generator: torch.Generator, *, after_reset: bool = True
    ) -> DensityReport:
        """The rules of :class:`DensityControl`, where Gaussians without the votes have no signal."""
        if len(self.visible_steps):
            self.signal_sum[self._ask() < self.least] = 0
        return super().densify(gaussians, optimizer, generator, after_reset=after_reset)


def let_vote(model: Model, views: Sequence[View], *, count: int, least: int, seed: int) -> None:
    """From now on the base set's density control asks ``count`` random views, of which ``least`` must agree."""
    generator = torch.Generator().manual_seed(seed)

    def ask() -> Tensor:
        some = torch.randperm(len(views), generator=generator)[:count].tolist()
        return votes(model, [views[index] for index in some], model.schedule.densify_until)

    base = model.base
    base.set.density = VotedDensity(base.settings.density, base.extent, ask, least)


def consolidate(model: Model, views: Sequence[View], step: int, share: float) -> int:
    """Prune this share of the base set, those of the lowest mean blending weight over the views; how many went."""
    weight = torch.zeros(len(model.base.set))
    for view in views:
        weight += weights_on(model, view, step, lambda image: torch.ones_like(image[0], dtype=torch.bool))
    return keep_heaviest(model, weight, share)


def keep_heaviest(model: Model, weight: Tensor, share: float) -> int:
    """Prune this share of the base set, the rows of lowest ``weight`` (N,); how many went."""
    part = model.base.set
    gone = round(share * len(part))
    keep = weight.argsort(stable=True)[gone:].sort().values
    nothing = select_rows(part.gaussians, torch.zeros(0, dtype=torch.int64))
    apply_plan(RowPlan(keep, nothing), part.gaussians, part.optimizer, part.density)
    if part.smoothing is not None:
        part.smoothing.refresh(part.gaussians.means)
    return gone
