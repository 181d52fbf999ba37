"""The tensors of a rendered view: as they are stored, and read again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.names import stored_file

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.methods import RenderedView
    from rtgs.methods.model import Model

COVERAGE = "coverage.safetensors"


def view_maps(rendered: RenderedView) -> dict[str, Tensor]:
    """Depth, normal, alpha and the layers of a view rendered with ``depth``, as the step ``render`` stores them."""
    from rtgs.train.losses import surface_depth

    buffers = rendered.buffers
    assert buffers.depth is not None
    depth = surface_depth(buffers.depth, buffers.alpha)
    maps = {"depth": depth, "normal": buffers.normal, "alpha": buffers.alpha}
    if rendered.layers is not None:
        maps |= {name: tensor.float() for name, tensor in rendered.layers.items()}
    return {name: tensor.contiguous() for name, tensor in maps.items() if tensor is not None}


def seen_maps(method: Model, camera: Camera, step: int, mask: Tensor | None = None) -> dict[str, Tensor]:
    """The image (3, H, W), the maps and layers of :func:`view_maps` and the weights of the layers from any camera, as
    of ``step``; a transparent object is where ``mask`` (H, W) says, without one where its mesh is seen."""
    import torch

    from rtgs.methods import Mode, RenderOptions

    options = RenderOptions(depth=True, normal="normal" in method.maps, layers=True, weights=True)
    with torch.no_grad():
        rendered = method.render(camera, step, Mode.EVALUATE, options, mask)
    return {"image": rendered.image, **view_maps(rendered)}


def read_coverage(folder: Path, view_name: str) -> Tensor | None:
    """(H, W) int16 training views that show what each pixel of a test view shows; None: the views have no maps, or an
    older version rendered them."""
    from safetensors import safe_open

    if not (folder / COVERAGE).is_file():
        return None
    with safe_open(folder / COVERAGE, framework="pt") as file:
        return file.get_tensor(view_name)


def read_render(folder: Path, view_name: str) -> dict[str, Tensor]:
    """The tensors of one rendered view."""
    from safetensors.torch import load_file

    return load_file(stored_file(folder / "views", view_name, ".safetensors"))
