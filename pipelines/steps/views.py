"""The tensors of a rendered view: as they are stored, and read again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods import RenderedView


def view_maps(rendered: RenderedView) -> dict[str, Tensor]:
    """Depth, normal, alpha and the layers of a view rendered with ``depth``, as the step ``render`` stores them."""
    buffers = rendered.buffers
    assert buffers.depth is not None
    depth = buffers.depth / buffers.alpha.clamp_min(1e-6)  # the buffer holds the sum of w z
    maps = {"depth": depth, "normal": buffers.normal, "alpha": buffers.alpha}
    if rendered.layers is not None:
        maps |= {name: tensor.float() for name, tensor in rendered.layers.items()}
    return {name: tensor.contiguous() for name, tensor in maps.items() if tensor is not None}


def read_render(folder: Path, view_name: str) -> dict[str, Tensor]:
    """The tensors of one rendered view."""
    from safetensors.torch import load_file

    from rtgs.evaluate.images import file_stem

    return load_file(folder / "views" / f"{file_stem(view_name)}.safetensors")
