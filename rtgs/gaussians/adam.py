"""Adam over all parameters of a set of Gaussians in one native call, and its moments through every change of N."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from rtgs.gaussians.harmonics import rest_count
from rtgs.gaussians.primitives import PARAMETERS, Gaussians
from rtgs.gaussians.settings import OptimizerSettings
from rtgs.native import core
from rtgs.native.threads import threads

REPORTED_ROWS = 8


@dataclass(frozen=True)
class NonFinite:
    """NaN or inf values of one named tensor."""

    name: str
    count: int  # values, not rows
    rows: tuple[int, ...]  # ids of the first Gaussians that hold one, at most 8

    def __str__(self) -> str:
        more = ", ..." if len(self.rows) == REPORTED_ROWS else ""
        return f"{self.name}: {self.count} NaN or inf, rows {', '.join(map(str, self.rows))}{more}"


class NonFiniteGradientError(FloatingPointError):
    """A gradient held NaN or inf; ``report`` says which parameters and rows."""

    def __init__(self, report: tuple[NonFinite, ...], step_index: int) -> None:
        self.report = report
        super().__init__(
            f"non-finite gradient at step {step_index}: {'; '.join(map(str, report))}. "
            "Go back to the last checkpoint; a lower learning rate or a look at these rows is the next thing to try"
        )


def find_nonfinite(tensors: Iterable[tuple[str, Tensor | None]]) -> tuple[NonFinite, ...]:
    """Search named float32 tensors (rows = Gaussians; None is skipped) for NaN and inf. Empty when all is finite."""
    found = []
    for name, tensor in tensors:
        if tensor is None:
            continue
        values = tensor.detach().contiguous().numpy()
        count = core.count_nonfinite(values, threads())
        if count:
            rows = np.flatnonzero(~np.isfinite(values.reshape(len(values) if values.ndim else 1, -1)).all(axis=1))
            found.append(NonFinite(name, count, tuple(rows[:REPORTED_ROWS].tolist())))
    return tuple(found)


@dataclass(frozen=True)
class Moving:
    """A float32 tensor with a gradient, and what Adam knows of it. Rows are those of its first dimension."""

    name: str
    values: Tensor
    first: Tensor  # moments, shaped as the values
    second: Tensor
    active: int  # floats of each row that are updated
    rate: float


def move(moving: Sequence[Moving], updates: int, betas: tuple[float, float], eps: float, step_index: int) -> None:
    """One bias-corrected step of Adam on all of them, in place, in one native call.

    ``updates``: how many there have been, this one included; ``step_index`` is for the message.

    Raises:
        NonFiniteGradientError: a gradient held NaN or inf. Such values counted as 0, all others were applied.
        RuntimeError: values or moments are not contiguous, so that the call could only move a copy of them.
    """
    entries = []
    for each in moving:
        assert each.values.grad is not None
        for what, tensor in (("values", each.values), ("first", each.first), ("second", each.second)):
            if not tensor.is_contiguous():
                raise RuntimeError(
                    f"{what} of {each.name} {tuple(tensor.shape)} have the strides {tensor.stride()}; Adam moves "
                    "contiguous tensors in place: call .contiguous() where they are made"
                )
        tensors = (each.values.detach(), each.values.grad.contiguous(), each.first, each.second)
        entries.append((*(t.numpy() for t in tensors), each.active, float(each.rate / (1 - betas[0] ** updates))))
        increment_version(each.values)  # a graph that still needs the old values refuses its backward pass
    second_scale = 1 / math.sqrt(1 - betas[1] ** updates)
    if core.adam_step(entries, *betas, eps, second_scale, threads()):
        raise NonFiniteGradientError(find_nonfinite((each.name, each.values.grad) for each in moving), step_index)


class GaussianAdam:
    """Adam (Kingma and Ba 2015, bias-corrected) with one learning rate per parameter (method.md 6.1).

    It matches ``torch.optim.Adam`` to float32 rounding, and differs in two stated ways: moments below 1e-30 (second:
    1.2e-38) become 0, and SH bands above the highest degree ever active are skipped, which changes nothing because
    their gradients and moments are 0.

    The rate of a channel is its own, or that of its name in the settings. Channels without either are refused.

    The moments have the rows of ``gaussians``: whoever changes N calls :meth:`keep`, :meth:`append` and
    :meth:`zero_moments` (``rtgs.gaussians.density.apply_plan`` does).
    """

    def __init__(
        self, gaussians: Gaussians, settings: OptimizerSettings, extent: float, *, means_lr_steps: int = 30_000
    ) -> None:
        """``extent``: of the scene, world units; ``means_lr_steps``: steps over which the means' rate decays."""
        if not (math.isfinite(extent) and extent > 0):
            raise ValueError(f"scene extent {extent} must be positive; are all training cameras at one place?")
        unset = [channel.name for channel in gaussians.channels if channel.rate is None]
        if lacking := [name for name in unset if not hasattr(settings, name)]:
            raise ValueError(f"channels without a learning rate: {', '.join(lacking)} (Channel.rate, method.optimizer)")
        if means_lr_steps < 1:
            raise ValueError(f"means_lr_steps {means_lr_steps} must be at least 1 (schedule.means_lr_steps)")
        self.gaussians = gaussians
        self.settings = settings
        self.extent = extent
        self.means_lr_steps = means_lr_steps
        self.scheduled: Mapping[
            str, Callable[[int], float]
        ] = {}  # rates by name, of a step, instead of those of the settings
        self.steps = 0  # updates done: the t of the bias correction
        self.sh_degree = 0  # highest degree ever active
        self.first = _zeros_like(gaussians)
        self.second = _zeros_like(gaussians)

    def learning_rates(self, step_index: int) -> dict[str, float]:
        """Rate of each parameter at a step (from 0); that of the means decays exponentially and is in world units.

        The others are constant, or fall as :meth:`OptimizerSettings.decay` says; those in :attr:`scheduled` are given.
        """
        s = self.settings
        share = min(max(step_index / self.means_lr_steps, 0.0), 1.0)
        means = math.exp((1 - share) * math.log(s.means_initial) + share * math.log(s.means_final))
        rates = {name: getattr(s, name) for name in PARAMETERS if name != "means"}
        rates |= {c.name: getattr(s, c.name) if c.rate is None else c.rate for c in self.gaussians.channels}
        factor = s.decay(share)
        found = {name: factor * rate for name, rate in rates.items()} | {"means": means * self.extent}
        return found | {name: rate(step_index) for name, rate in self.scheduled.items() if name in found}

    def step(self, step_index: int, sh_degree: int | None = None) -> None:
        """Update every parameter in place from its ``.grad`` (parameters without one are left alone).

        Args:
            step_index: step of the schedule, from 0; sets the learning rate of the means.
            sh_degree: degree active in this step; default: all the Gaussians hold.

        Raises:
            NonFiniteGradientError: a gradient held NaN or inf. Such values counted as 0, all others were applied: stop,
                or go back to a checkpoint.
            RuntimeError: the Gaussians changed N without the optimiser.
        """
        degree = self.gaussians.sh_degree if sh_degree is None else min(sh_degree, self.gaussians.sh_degree)
        self.sh_degree = max(self.sh_degree, degree)
        self.steps += 1
        s = self.settings
        rates = self.learning_rates(step_index)
        moving = []
        for name, values in self.gaussians.items():
            if values.grad is None:
                continue
            first, second = self.first[name], self.second[name]
            if first.shape != values.shape:
                raise RuntimeError(
                    f"{name} is {tuple(values.shape)} but its Adam moments are {tuple(first.shape)}; "
                    "change N through rtgs.gaussians.density.apply_plan"
                )
            active = 3 * rest_count(self.sh_degree) if name == "sh_rest" else values[:1].numel()
            moving.append(Moving(name, values, first, second, active, rates[name]))
        move(moving, self.steps, (s.beta1, s.beta2), s.eps, step_index)

    @torch.no_grad()
    def clamp(self) -> None:
        """Keep the activations finite whatever the learning rate (method.md 14).

        exp overflows float32 at 88, and a logit beyond 13.8 has a sigmoid derivative below 1e-6 from which Adam cannot
        return; channels have bounds of their own. The other parameters are used as they are, and Adam bounds their
        drift by learning rate times steps.
        """
        s, gaussians = self.settings, self.gaussians
        smallest, largest = (math.log(share * self.extent) for share in (s.smallest_scale, s.largest_scale))
        of_logits = (-s.opacity_logit_limit, s.opacity_logit_limit)
        gaussians.log_scales.clamp_(smallest, largest)
        gaussians.opacity_logits.clamp_(*of_logits)
        for channel in gaussians.channels:
            gaussians[channel.name].clamp_(*(channel.bounds or of_logits))

    def zero_grad(self) -> None:
        """Drop the gradients."""
        for _, values in self.gaussians.items():
            values.grad = None

    def keep(self, index: Tensor) -> None:
        """Rows ``index`` (M,) int64 become the new rows, in this order; a row may occur more than once."""
        for moments in (self.first, self.second):
            for name, values in moments.items():
                moments[name] = values[index].contiguous()

    def append(self, count: int) -> None:
        """``count`` rows with zero moments at the end."""
        for moments in (self.first, self.second):
            for name, values in moments.items():
                moments[name] = torch.cat((values, values.new_zeros(count, *values.shape[1:])))

    def inherit(self, other: GaussianAdam) -> None:
        """Go on where the optimiser of the same rows stopped: its step count, and moments of parameters in both."""
        self.steps, self.sh_degree = other.steps, other.sh_degree
        for mine, theirs in ((self.first, other.first), (self.second, other.second)):
            for name in mine.names:
                if name in theirs:
                    mine[name] = theirs[name]

    def zero_moments(self, name: str, rows: Tensor | None = None) -> None:
        """Forget one parameter's moments: of all Gaussians, or of ``rows`` (int64 or bool)."""
        for moments in (self.first, self.second):
            values = moments[name]
            if rows is None:
                values.zero_()
            else:
                values[rows] = 0

    def state(self) -> dict[str, Tensor]:
        """All that a checkpoint needs for an exact resume (the tensors are the live ones, not copies)."""
        return {
            "steps": torch.tensor(self.steps),
            "sh_degree": torch.tensor(self.sh_degree),
            **{f"first.{name}": values for name, values in self.first.items()},
            **{f"second.{name}": values for name, values in self.second.items()},
        }

    def load(self, state: dict[str, Tensor]) -> None:
        """Take over a :meth:`state` (copied).

        Raises:
            ValueError: it lacks an entry, or is of Gaussians of another shape.
        """
        expected = self.state()
        if missing := sorted(expected.keys() - state.keys()):
            raise ValueError(f"optimiser state lacks {', '.join(missing)}; the checkpoint is incomplete")
        for name, values in expected.items():
            if state[name].shape != values.shape:
                raise ValueError(
                    f"optimiser state {name} is {tuple(state[name].shape)} but the Gaussians need "
                    f"{tuple(values.shape)}; load the Gaussians of the same checkpoint first"
                )
        self.steps = int(state["steps"])
        self.sh_degree = int(state["sh_degree"])
        for prefix, moments in (("first", self.first), ("second", self.second)):
            for name in moments.names:
                moments[name] = state[f"{prefix}.{name}"].detach().clone().contiguous()


def _zeros_like(gaussians: Gaussians) -> Gaussians:
    return gaussians.like({n: torch.zeros(values.shape, dtype=torch.float32) for n, values in gaussians.items()})
