"""Which tiles of a transparent object a step of training traces: wrong ones more often (docs/transmittance.md).

A tile is drawn with a probability in proportion to its error when the view was last seen, and its gradient counts by
the inverse: what each pixel teaches is right on average. Losses whose windows reach into tiles that were not drawn,
D-SSIM and L_perc, see the photo there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from rtgs.core.cameras import Camera
from rtgs.methods.shading.straight import FirstBounce, GlassRays
from rtgs.scenes.scene import View
from rtgs.train.method import Drawn, RenderedView

TILE = 8  # pixels a side: neighbouring rays share the work of the tracer
LEAST = 0.25  # probability of a tile that is right: another look is due, and no weight is above its inverse
_ERRORS = "drawn_errors"  # in the state, by the number of the training view


class DrawnTiles:
    """The errors of the tiles of each training view, and what is drawn by them.

    ``share``: of the object's pixels, about; 1: every step traces all, and no error is kept.
    ``views``: of the training.
    """

    def __init__(self, share: float, views: Sequence[View], generator: torch.Generator) -> None:
        self._share = share
        self._generator = generator
        self._number = {_place(view.camera): number for number, view in enumerate(views)}
        self._errors: dict[int, Tensor] = {}  # (rows, columns) float32 of the tiles

    def draw(self, camera: Camera, inside: Tensor) -> Drawn | None:
        """What a step on the view traces; ``inside`` (H * W,) bool: the object's pixels. None: all, for nothing is
        known of this view in this size."""
        errors = self._errors.get(self._number.get(_place(camera), -1)) if self._errors else None
        if errors is None:
            return None
        shown = inside.reshape(camera.height, camera.width)
        share = _of_tiles(shown.float())
        if errors.shape != share.shape:
            return None
        mean = float((errors * share).sum() / share.sum().clamp_min(1e-9))
        if mean <= 0:
            return None
        probability = (errors * (self._share / mean)).clamp(LEAST, 1)
        drawn = torch.rand(errors.shape, generator=self._generator) < probability
        weight = torch.where(drawn, probability.reciprocal(), 0.0)
        return Drawn(torch.where(shown, _of_pixels(weight, shown), 1.0))

    def saw(self, rendered: RenderedView, view: View) -> None:
        """A training view as it came out: its error in the tiles that were drawn."""
        number, inside = self._number.get(_place(rendered.camera)), rendered.maps.get("transparent")
        if self._share == 1 or number is None or inside is None:
            return
        wrong = (rendered.image.detach().clamp(0, 1) - view.image).abs_().mean(0)
        found = _of_tiles(wrong * inside) / _of_tiles(inside.float()).clamp_min(1e-6)
        before = self._errors.get(number)
        if rendered.drawn is not None and before is not None and before.shape == found.shape:
            seen = _of_tiles((rendered.drawn.weight * inside > 0).float()) > 0
            found = torch.where(seen, found, before)
        self._errors[number] = found

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint: the errors."""
        return {f"{_ERRORS}.{number}": errors for number, errors in self._errors.items()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The errors, from a checkpoint's state."""
        names = {number: f"{_ERRORS}.{number}" for number in self._number.values()}
        self._errors = {number: state[name].clone() for number, name in names.items() if name in state}


def weighed(bounce: FirstBounce | None, drawn: Drawn | None, traced: Tensor, rays: GlassRays) -> FirstBounce | None:
    """What the first ``rays`` met, with the weights of their pixels; ``traced`` (P,) int64 flattened pixels."""
    if bounce is None or drawn is None:
        return bounce
    pixels = traced[rays.rows[rays.second]]
    return replace(bounce, weight=drawn.weight.flatten()[pixels])


def _place(camera: Camera) -> bytes:
    """What tells a view from others, in any size."""
    return camera.rotation.numpy().tobytes() + camera.translation.numpy().tobytes()


def _of_tiles(values: Tensor) -> Tensor:
    """Means of the tiles of a map (H, W); the last ones may be cut."""
    return avg_pool2d(values[None, None], TILE, ceil_mode=True)[0, 0]


def _of_pixels(tiles: Tensor, like: Tensor) -> Tensor:
    """(H, W) the value of each pixel's tile."""
    height, width = like.shape
    return tiles.repeat_interleave(TILE, 0)[:height].repeat_interleave(TILE, 1)[:, :width]
