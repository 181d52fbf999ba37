"""Tensors as the native core takes them."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def arrays_of(*tensors: Tensor | None) -> tuple[np.ndarray | None, ...]:
    """Contiguous numpy views, without the graph; None stays None."""
    return tuple(
        None if each is None else (each.detach() if each.requires_grad else each).contiguous().numpy()
        for each in tensors
    )
