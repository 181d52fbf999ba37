"""The order in which training visits the views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class OrderState:
    """Everything needed to go on with a :class:`ViewOrder`."""

    permutation: Tensor  # (V,) int64, the current epoch
    position: int  # views of this epoch already given out
    generator: Tensor  # uint8 state of the generator


class ViewOrder:
    """One training view per step: every epoch visits all views once, in an order drawn from a dedicated generator."""

    def __init__(self, count: int, seed: int) -> None:
        if count < 1:
            raise ValueError("no training view: every image is in the test split, or the scene is empty")
        self._generator = torch.Generator().manual_seed(seed)
        self._permutation = torch.randperm(count, generator=self._generator)
        self._position = 0

    def next(self) -> int:
        """Index of the next training view."""
        if self._position == len(self._permutation):
            self._permutation = torch.randperm(len(self._permutation), generator=self._generator)
            self._position = 0
        self._position += 1
        return int(self._permutation[self._position - 1])

    def state(self) -> OrderState:
        return OrderState(self._permutation.clone(), self._position, self._generator.get_state())

    def load(self, state: OrderState) -> None:
        """Go on where ``state`` was taken.

        Raises:
            ValueError: the state is of another number of views.
        """
        if state.permutation.shape != self._permutation.shape:
            raise ValueError(
                f"the checkpoint visits {len(state.permutation)} training views, the scene has {len(self._permutation)}"
            )
        self._permutation = state.permutation.clone()
        self._position = state.position
        self._generator.set_state(state.generator)
