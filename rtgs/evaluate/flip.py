"""LDR-FLIP (Andersson et al. 2020): the error of a picture as a person sees it who flips between it and the photo.

By NVIDIA's package ``flip-evaluator``; nothing is downloaded.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rtgs.core.image_pair import checked_pair

PIXELS_PER_DEGREE = 67.02064514160156  # of the visual angle: a screen 0.7 m away and wide, 3840 pixels (the default)

FLIP_COLORMAP = "magma"  # of its authors, over 0 to 1


def flip_map(image: Tensor, target: Tensor) -> Tensor:
    """FLIP of every pixel: 0 where no difference is seen, 1 for black beside white.

    Parameters
    ----------
    image : (3, H, W) Tensor
        The render, sRGB encoded; it is clamped to [0, 1].
    target : (3, H, W) Tensor
        The photo, in [0, 1].

    Returns
    -------
    (H, W) float64 Tensor
        In [0, 1].

    Raises
    ------
    TypeError
        A tensor does not hold floating-point numbers.
    ValueError
        Shapes or ranges do not fit, or a value is not finite.

    References
    ----------
    .. [1] Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild: FLIP: A Difference Evaluator for
       Alternating Images. HPG 2020.
    """
    from flip_evaluator import evaluate  # loads matplotlib

    image, target = checked_pair(image, target)
    reference, test = (_rows(each.clamp(0, 1)) for each in (target, image))
    viewing = {"ppd": PIXELS_PER_DEGREE}
    found, _, _ = evaluate(
        reference, test, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=False, parameters=viewing
    )
    return torch.from_numpy(found[..., 0].astype(np.float64))


def _rows(image: Tensor) -> np.ndarray:
    """(H, W, 3) float32, as the package takes it."""
    return np.ascontiguousarray(image.permute(1, 2, 0).numpy(), dtype=np.float32)
