"""Parameters that are no rows of Gaussians: named groups of tensors, each with a rate and a schedule of its own.

An environment cubemap, the weights of a small network, the exposure of each view, the correction of a pose, one index
of refraction: whatever trains beside the sets is a :class:`ParameterGroup`, so Adam, the guard against non-finite
numbers, checkpoints and resuming treat it like them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.gaussians.adam import Moving, move


@dataclass(frozen=True)
class Rate:
    """Learning rate of a group: constant, or exponential from ``initial`` to ``final`` over ``steps``, after a delay.

    Steps count from ``start``; before it the group stands still. Over the first ``warm_up`` of them the rate rises in a
    straight line to what it is without.
    """

    initial: float
    final: float | None = None  # None: constant
    steps: int = 1  # over which it decays
    start: int = 0  # first step at which the group moves
    warm_up: int = 0  # steps

    def __post_init__(self) -> None:
        values = (self.initial, self.initial if self.final is None else self.final)
        if not all(math.isfinite(value) and value > 0 for value in values):
            raise ValueError(f"learning rates {values} of a group must be finite and above 0")
        if self.steps < 1 or self.start < 0 or self.warm_up < 0:
            raise ValueError(
                f"a rate decays over {self.steps} steps from step {self.start}, after {self.warm_up} of warm-up: at "
                "least 1, 0 and 0"
            )

    def at(self, step: int) -> float:
        """The rate of ``step``; 0 before the group moves."""
        if step < self.start:
            return 0.0
        rising = min((step - self.start + 1) / self.warm_up, 1.0) if self.warm_up else 1.0
        if self.final is None:
            return rising * self.initial
        share = min((step - self.start) / self.steps, 1.0)
        return rising * math.exp((1 - share) * math.log(self.initial) + share * math.log(self.final))


class ParameterGroup:
    """Named float32 tensors of any shape under one Adam (bias-corrected, Kingma and Ba 2015) and one :class:`Rate`.

    ``limits`` (smallest, largest) are kept after every step, where given. The tensors are leaves: whoever renders reads
    them by :meth:`__getitem__`, in :class:`~rtgs.train.method.Mode` TRAIN with their graph.
    """

    def __init__(
        self,
        name: str,
        tensors: Mapping[str, Tensor],
        rate: Rate,
        *,
        limits: tuple[float, float] | None = None,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        """Raises ValueError where there is no tensor, or one that is not float32 and finite."""
        if not tensors:
            raise ValueError(f"parameter group {name!r} has no tensor")
        for key, tensor in tensors.items():
            if tensor.dtype != torch.float32 or not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{name}.{key} is {tensor.dtype} or not finite; a group trains finite float32 tensors")
        self.name = name
        self.rate = rate
        self.limits = limits
        self.steps = 0  # updates done: the t of the bias correction
        self._betas, self._eps = betas, eps
        self._values = {key: tensor.detach().clone().contiguous().requires_grad_() for key, tensor in tensors.items()}
        self._first = {key: torch.zeros(tensor.shape) for key, tensor in tensors.items()}
        self._second = {key: torch.zeros(tensor.shape) for key, tensor in tensors.items()}

    def __len__(self) -> int:
        return sum(tensor.numel() for tensor in self._values.values())

    def __getitem__(self, key: str) -> Tensor:
        return self._values[key]

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of every parameter."""
        yield from self._values.items()

    def step(self, step: int) -> None:
        """One step of Adam from the gradients, which are dropped; tensors without one stand still.

        Raises:
            NonFiniteGradientError: a gradient held NaN or inf; gradients are kept for the report.
        """
        rate = self.rate.at(step)
        moving = [
            Moving(key, value, self._first[key], self._second[key], value[:1].numel() if value.ndim else 1, rate)
            for key, value in self._values.items()
            if value.grad is not None
        ]
        if rate > 0 and moving:
            self.steps += 1
            move(moving, self.steps, self._betas, self._eps, step)
        for value in self._values.values():
            value.grad = None
        if self.limits is not None:
            with torch.no_grad():
                for value in self._values.values():
                    value.clamp_(*self.limits)

    def state(self) -> dict[str, Tensor]:
        """Every tensor of the group under dotted names."""
        tensors: dict[str, Tensor] = {f"{self.name}.adam.steps": torch.tensor(self.steps)}
        for key, value in self._values.items():
            tensors[f"{self.name}.values.{key}"] = value.detach()
            tensors[f"{self.name}.adam.first.{key}"] = self._first[key]
            tensors[f"{self.name}.adam.second.{key}"] = self._second[key]
        return tensors

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Take over the tensors of :meth:`state` (copied).

        Raises:
            ValueError: one is missing or has another shape.
        """
        for name, mine in self.state().items():
            if name not in state or state[name].shape != mine.shape:
                found = tuple(state[name].shape) if name in state else "nothing"
                raise ValueError(
                    f"the checkpoint has {found} for {name}, this method needs {tuple(mine.shape)}: it was written by "
                    "another method or version; train again from the start"
                )
        self.steps = int(state[f"{self.name}.adam.steps"])
        for key in self._values:
            self._values[key] = state[f"{self.name}.values.{key}"].clone().contiguous().requires_grad_()
            self._first[key] = state[f"{self.name}.adam.first.{key}"].clone().contiguous()
            self._second[key] = state[f"{self.name}.adam.second.{key}"].clone().contiguous()
