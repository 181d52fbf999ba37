"""Density control: where Gaussians are cloned, split and pruned, and how a change of N reaches all that has rows.

The rules are those of 3DGS, 2DGS and EnvGS (method.md 6.1, 12), their differences are settings; ellipsoids meet the
same ones as surfels. Each Gaussian meets at most one of them in a call, in this order: transparent -> pruned; too large
-> pruned or split into 5; high signal and large -> split into 2; high signal and small -> cloned. The cap on N comes
last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.channels import logit
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings

Kind = TypeVar("Kind", bound=Gaussians)


@dataclass(frozen=True)
class DensityReport:
    """What one call did, in Gaussians."""

    cloned: int  # that got a copy
    split: int  # replaced by children
    pruned: int  # removed without children, those of the cap included
    total: int  # N afterwards


@dataclass(frozen=True)
class RowPlan:
    """A change of N: rows ``keep`` of the old Gaussians in this order, then the rows of ``added``."""

    keep: Tensor  # (M,) int64
    added: Gaussians  # raw parameters and channels of new rows, no gradient


class HasRows(Protocol):
    """Anything with one row a Gaussian: an optimiser's moments, statistics."""

    def keep(self, index: Tensor) -> None: ...

    def append(self, count: int) -> None: ...


def apply_plan(plan: RowPlan, gaussians: Gaussians, *followers: HasRows) -> None:
    """Change N of the Gaussians (in place: new leaf tensors, gradients dropped) and of all that has a row for each.

    The only way N ever changes, so that parameters, moments and statistics cannot get out of step. Followers give new
    rows zeros.
    """
    for name, values in gaussians.items():
        merged = torch.cat((values.detach()[plan.keep], plan.added[name].detach()))
        gaussians[name] = merged.requires_grad_(values.requires_grad)
    for follower in followers:
        follower.keep(plan.keep)
        follower.append(len(plan.added))


def select_rows(gaussians: Kind, index: Tensor) -> Kind:
    """A copy of rows ``index`` (int64 or bool), without gradient."""
    return gaussians.like({name: values.detach()[index] for name, values in gaussians.items()})


def split_gaussians(gaussians: Kind, count: int, shrink: float, generator: torch.Generator) -> Kind:
    """``count`` children of each Gaussian, drawn from it (a surfel: in its plane), with scales divided by ``shrink``.

    Returns:
        N * count Gaussians; the children of one parent are neighbours. All else is inherited, channels too.
    """
    children = select_rows(gaussians, torch.arange(len(gaussians)).repeat_interleave(count))
    normal = torch.randn(*children.log_scales.shape, generator=generator)
    children.means = children.means + (normal[..., None] * children.deviations()).sum(dim=1)
    children.log_scales = children.log_scales - math.log(shrink)
    return children


@dataclass(frozen=True)
class Beyond:
    """What is far away, and may be as large as it is far."""

    center: Tensor  # (3,) world
    distance: float  # world units

    def holds(self, means: Tensor) -> Tensor:
        """(N,) bool: which of the (N, 3) means are that far from the centre."""
        return (means - self.center).norm(dim=1) > self.distance


class DensityControl:
    """Statistics of the steps since the last change of N, and the rules that use them.

    A Gaussian is visible in a step if its weight sum is positive or its signal is not zero; means are over those steps.

    Attributes:
        beyond: Gaussians there are never too large; None: nothing is spared.
    """

    needs_signal = True  # of every training view
    resets_opacity = True

    def __init__(self, settings: DensitySettings, extent: float) -> None:
        """``extent`` of the scene in world units, which the size thresholds are relative to."""
        if not (math.isfinite(extent) and extent > 0):
            raise ValueError(f"scene extent {extent} must be positive; are all training cameras at one place?")
        for name in ("min_opacity", "reset_opacity"):
            if not 0 < getattr(settings, name) < 1:
                raise ValueError(f"density.{name} {getattr(settings, name)} must be between 0 and 1")
        if settings.cap_turnover is not None and not settings.cap_turnover >= 0:
            raise ValueError(
                f"density.cap_turnover {settings.cap_turnover} must be at least 0, or null for the published rule"
            )
        if settings.split_shrink <= 0 or settings.too_large_shrink <= 0:
            raise ValueError("density.split_shrink and density.too_large_shrink must be positive")
        self.settings = settings
        self.extent = extent
        self.beyond: Beyond | None = None
        self._clear(0)

    def _clear(self, count: int) -> None:  # 0: as many as the next step observes
        self.signal_sum = torch.zeros(count)
        self.weight_sum = torch.zeros(count)
        self.visible_steps = torch.zeros(count, dtype=torch.int64)

    def observe(self, signal: Tensor, weight_sum: Tensor) -> None:
        """Record one step, after its backward pass.

        Args:
            signal: (N, 2) densification signal, NDC units (docs/rasterizer.md); (N, 3) of the tracer (docs/tracer.md).
            weight_sum: (N,) sum of blending weights over the pixels of the view.

        Raises:
            ValueError: N changed without :func:`apply_plan`, or shapes do not match.
            FloatingPointError: a value is NaN or inf.
        """
        count = len(signal)
        if signal.shape not in ((count, 2), (count, 3)) or weight_sum.shape != (count,):
            raise ValueError(
                f"signal must be (N, 2) or (N, 3) and weight_sum (N,), got {tuple(signal.shape)} and "
                f"{tuple(weight_sum.shape)}"
            )
        if not len(self.visible_steps):
            self._clear(count)
        if len(self.visible_steps) != count:
            raise ValueError(
                f"{count} Gaussians observed, but the statistics are of {len(self.visible_steps)}; "
                "change N through rtgs.gaussians.density.apply_plan"
            )
        norm = torch.hypot(*signal.detach().unbind(1)) if signal.shape[1] == 2 else signal.detach().norm(dim=1)
        weight = weight_sum.detach()
        either = norm + weight  # both are >= 0
        if not math.isfinite(float(either.sum())):
            bad = (~torch.isfinite(either)).nonzero().flatten().tolist()
            if bad:
                raise FloatingPointError(
                    f"densification signal or weight sum of {len(bad)} Gaussians is NaN or inf (first ids {bad[:8]})"
                )
        self.signal_sum += norm
        self.weight_sum += weight
        self.visible_steps += either > 0

    @property
    def mean_signal(self) -> Tensor:
        """(N,) mean norm of the signal over the steps a Gaussian was visible in; 0 if none."""
        return self.signal_sum / self.visible_steps.clamp_min(1)

    @property
    def mean_weight(self) -> Tensor:
        """(N,) mean weight sum over the steps a Gaussian was visible in; 0 if none."""
        return self.weight_sum / self.visible_steps.clamp_min(1)

    @torch.no_grad()
    def densify(
        self, gaussians: Gaussians, optimizer: GaussianAdam, generator: torch.Generator, *, after_reset: bool = True
    ) -> DensityReport:
        """Clone, split and prune; the statistics start afresh. Without an observed step only pruning and splitting by
        opacity and size happen.

        ``after_reset``: opacities have been reset before (``settings.too_large_after_reset`` waits for that).
        """
        if not len(self.visible_steps):
            self._clear(len(gaussians))
        s = self.settings
        size = gaussians.log_scales.detach().exp().amax(dim=1)
        high_signal = (self.visible_steps > 0) & (self.mean_signal >= s.gradient_threshold)
        transparent = gaussians.opacity_logits.detach() < logit(s.min_opacity)
        too_large = torch.zeros_like(transparent)
        if s.too_large > 0 and (after_reset or not s.too_large_after_reset):
            too_large = ~transparent & (size > s.too_large * self.extent)
            if self.beyond is not None:
                too_large &= ~self.beyond.holds(gaussians.means.detach())
        too_large_pruned = too_large if s.too_large_pruned else too_large & self._lowest_weights(s.low_weight_share)
        too_large_split = too_large & ~too_large_pruned
        rest = high_signal & ~transparent & ~too_large
        if s.cap_turnover is not None:
            room = int((1 + s.cap_turnover) * self.cap) - int((~transparent & ~too_large_pruned).sum())
            rest = highest(rest, self.mean_signal, room)
        split = rest & (size > s.size_border * self.extent)
        clone = rest & ~split

        keep = (~(transparent | too_large | split)).nonzero().flatten()
        parts = (
            select_rows(gaussians, clone),
            split_gaussians(select_rows(gaussians, split), s.split_count, s.split_shrink, generator),
            split_gaussians(
                select_rows(gaussians, too_large_split), s.too_large_split_count, s.too_large_shrink, generator
            ),
        )
        weight = self.mean_weight
        weights = torch.cat(
            (
                weight[keep],
                weight[clone],
                weight[split].repeat_interleave(s.split_count),
                weight[too_large_split].repeat_interleave(s.too_large_split_count),
            )
        )
        plan, capped = self._capped(RowPlan(keep, concatenate(parts)), weights)
        apply_plan(plan, gaussians, optimizer, self)
        self._clear(0)
        return DensityReport(
            cloned=int(clone.sum()),
            split=int(split.sum() + too_large_split.sum()),
            pruned=int(transparent.sum() + too_large_pruned.sum()) + capped,
            total=len(gaussians),
        )

    @property
    def cap(self) -> int:
        """N that a call never leaves exceeded."""
        return int(self.settings.cap_share * self.settings.max_surfels)

    def _lowest_weights(self, share: float) -> Tensor:
        """(N,) bool: mean weight below that quantile (as in EnvGS: where that many are 0, none is below)."""
        weight = self.mean_weight
        return weight < weight.quantile(share) if len(weight) else torch.zeros(0, dtype=torch.bool)

    def _capped(self, plan: RowPlan, weights: Tensor) -> tuple[RowPlan, int]:
        """The plan without the rows of lowest weight above the cap, and how many (children weigh as the parent)."""
        excess = len(weights) - self.cap
        if excess <= 0:
            return plan, 0
        stays = torch.ones(len(weights), dtype=torch.bool)
        stays[weights.argsort(stable=True)[:excess]] = False
        kept = len(plan.keep)
        return RowPlan(plan.keep[stays[:kept]], select_rows(plan.added, stays[kept:])), excess

    def perturb(self, gaussians: Gaussians, means_rate: float, generator: torch.Generator) -> None:
        """What happens to the means after a step of Adam at ``means_rate``, world units: nothing."""

    @torch.no_grad()
    def reset_opacity(self, gaussians: Gaussians, optimizer: GaussianAdam) -> None:
        """Opacity becomes min(opacity, ``settings.reset_opacity``); its moments become 0."""
        gaussians.opacity_logits.clamp_(max=logit(self.settings.reset_opacity))
        optimizer.zero_moments("opacity_logits")

    def keep(self, index: Tensor) -> None:
        """Rows ``index`` become the new rows (see :func:`apply_plan`)."""
        if not len(self.visible_steps):  # nothing observed since the last change: zeros for any N
            return
        self.signal_sum = self.signal_sum[index]
        self.weight_sum = self.weight_sum[index]
        self.visible_steps = self.visible_steps[index]

    def append(self, count: int) -> None:
        """``count`` rows of zeros at the end (see :func:`apply_plan`)."""
        if not len(self.visible_steps):
            return
        self.signal_sum = torch.cat((self.signal_sum, self.signal_sum.new_zeros(count)))
        self.weight_sum = torch.cat((self.weight_sum, self.weight_sum.new_zeros(count)))
        self.visible_steps = torch.cat((self.visible_steps, self.visible_steps.new_zeros(count)))

    def state(self) -> dict[str, Tensor]:
        """All that a checkpoint needs (the live tensors, not copies)."""
        return {"signal_sum": self.signal_sum, "weight_sum": self.weight_sum, "visible_steps": self.visible_steps}

    def load(self, state: dict[str, Tensor]) -> None:
        """Take over a :meth:`state` (copied).

        Raises:
            ValueError: an entry is missing, or lengths differ.
        """
        if missing := sorted(self.state().keys() - state.keys()):
            raise ValueError(f"density state lacks {', '.join(missing)}; the checkpoint is incomplete")
        lengths = {name: tuple(state[name].shape) for name in self.state()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"density state has rows of different number: {lengths}")
        self.signal_sum = state["signal_sum"].detach().float().clone()
        self.weight_sum = state["weight_sum"].detach().float().clone()
        self.visible_steps = state["visible_steps"].detach().long().clone()


def highest(chosen: Tensor, values: Tensor, count: int) -> Tensor:
    """The ``count`` rows of ``chosen`` (N,) bool with the highest values (N,); all of them where they are fewer."""
    index = chosen.nonzero().flatten()
    if len(index) <= count:
        return chosen
    order = values[index].argsort(descending=True, stable=True)
    limited = torch.zeros_like(chosen)
    limited[index[order[: max(count, 0)]]] = True
    return limited


def concatenate(parts: tuple[Kind, ...]) -> Kind:
    """The rows of all parts, in order."""
    return parts[0].like({name: torch.cat([part[name] for part in parts]) for name in parts[0].names})
