"""Pictures rendered finer than the photo and averaged, as the photo was when it was made smaller."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor
from torch.nn.functional import avg_pool2d

from rtgs.core.cameras import Camera

Render = Callable[[Camera, Tensor | None], Tensor]


def supersampled(render: Render, camera: Camera, mask: Tensor | None, times: int) -> Tensor:
    """(3, H, W) mean over ``times`` x ``times`` samples a pixel.

    The mean is taken of values as the photo has them (sRGB, clipped to 0 .. 1), because that is what a photo's own
    resizing averages (:func:`rtgs.scenes.images.area_resize`), not of light.

    Parameters
    ----------
    render : callable
        The picture (3, h, w) of a camera of that size, and of a mask (h, w) bool where there is one.
    camera : Camera
        At the size of the result.
    mask : (H, W) bool Tensor, optional
        Handed to ``render`` with each pixel repeated.
    times : int
        At least 1; 1 gives what ``render`` gives, not clipped.
    """
    if times == 1:
        return render(camera, mask)
    fine = camera.resized(times * camera.width, times * camera.height)
    repeated = None if mask is None else mask.repeat_interleave(times, 0).repeat_interleave(times, 1)
    return avg_pool2d(render(fine, repeated).clamp(0, 1), times)
