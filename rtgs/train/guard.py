"""Stops training at the first non-finite number, and says where it came from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from rtgs.train.method import LossValues, Method, Trained

SHOWN = 5


@dataclass(frozen=True)
class BadGaussians:
    """Gaussians, or rows of a group of parameters, with a gradient or value that is not finite."""

    set_name: str
    tensor: str  # "gradient of log_scales" or "log_scales"
    count: int
    ids: tuple[int, ...]  # the first few
    values: tuple[str, ...]  # theirs, as text
    unit: str = "Gaussian"  # what a row is; of a group of other parameters "row"


@dataclass(frozen=True)
class Divergence:
    """Where training broke."""

    step: int
    view: str
    terms: tuple[tuple[str, float], ...]  # every loss term of the step
    bad_terms: tuple[str, ...]
    gaussians: tuple[BadGaussians, ...]
    cause: str  # message of the part that noticed; empty for a loss


class TrainingDiverged(RtgsError):
    """A loss or a gradient is not finite. ``divergence`` holds the facts; the last checkpoint is intact."""

    def __init__(self, divergence: Divergence) -> None:
        self.divergence = divergence
        lines = [f"training diverged at step {divergence.step}, view {divergence.view!r}"]
        if divergence.bad_terms:
            lines.append(f"loss terms that are not finite: {', '.join(divergence.bad_terms)}")
        if divergence.cause and not divergence.gaussians:
            lines.append(divergence.cause)
        lines.append("terms: " + ", ".join(f"{name} {value:.6g}" for name, value in divergence.terms))
        for bad in divergence.gaussians:
            examples = "; ".join(
                f"{bad.unit} {index}: {value}" for index, value in zip(bad.ids, bad.values, strict=True)
            )
            lines.append(f"set {bad.set_name}, {bad.tensor}: {bad.count} {bad.unit}s not finite ({examples})")
        lines.append(
            "The last checkpoint is intact and holds finite values. Lower the learning rates in method.optimizer or "
            "switch the named term off (its weight in method.loss) and run again; if the inputs are ordinary photos, "
            "please report this message"
        )
        super().__init__("\n".join(lines))


def check_loss(terms: LossValues, method: Method, step: int, view: str) -> float:
    """The loss as a number. One scalar read when all is well.

    Raises:
        TrainingDiverged: it is not finite.
    """
    loss = float(terms.total.detach())
    if math.isfinite(loss):
        return loss
    terms.total.backward()  # for the report alone: its gradients tell which Gaussians are involved
    raise diverged(terms, method, step, view)


def diverged(terms: LossValues, method: Method, step: int, view: str, *, cause: str = "") -> TrainingDiverged:
    """The report of a step whose loss or gradients (still in ``.grad``) are not finite."""
    bad = tuple(term.name for term in terms.terms if not math.isfinite(term.value))
    values = tuple((term.name, term.value) for term in terms.terms)
    return TrainingDiverged(Divergence(step, view, values, bad, _bad_gaussians(method), cause))


def _bad_gaussians(method: Method) -> tuple[BadGaussians, ...]:
    """Every parameter and gradient with non-finite rows."""
    found = []
    parts = (*((each, "Gaussian") for each in method.sets), *((each, "row") for each in method.groups))
    for part, unit in parts:
        for name, tensor in part.tensors():
            for label, values in ((name, tensor.detach()), (f"gradient of {name}", tensor.grad)):
                bad = _describe(part, unit, label, values)
                if bad is not None:
                    found.append(bad)
    return tuple(found)


def _describe(part: Trained, unit: str, label: str, values: Tensor | None) -> BadGaussians | None:
    if values is None:
        return None
    rows = values.reshape(len(values) if values.ndim else 1, -1)
    ids = (~torch.isfinite(rows).all(dim=1)).nonzero()[:, 0]
    if len(ids) == 0:
        return None
    first = ids[:SHOWN].tolist()
    texts = tuple(", ".join(f"{value:.4g}" for value in rows[index, :4].tolist()) for index in first)
    return BadGaussians(part.name, label, len(ids), tuple(first), texts, unit)
