"""The parts of the transmitted light of a view, beside the pictures of its truth.

They are samples of their own, so their sum differs from the transmitted light that is already there by the noise of
both. They are therefore scaled, in each pixel and colour by one factor for all three: their sum is what
``transmitted.png`` holds, up to their own rounding to 8 bits.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rtgs.core.cameras import Camera
from rtgs.scenes.synthetic.glass import GlassLight
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.truth import read_light, write_glass


def glass_samples(view_samples: int) -> int:
    """Paths a pixel for the parts: half of the view's, for each follows both branches at the second wall."""
    return max(1, view_samples // 2)


def add_glass_truth(tracer: PathTracer, camera: Camera, folder: Path, samples: int) -> None:
    """Path-trace the parts of a view's transmitted light and write them into its folder of truth.

    Raises:
        CaptureError: the transmitted light is not there, or damaged.
    """
    transmitted = read_light(folder, "transmitted").numpy().transpose(1, 2, 0)
    parts = asdict(shared_out(tracer.glass_light(camera, samples), transmitted))
    write_glass(folder, {name: torch.from_numpy(part.transpose(2, 0, 1)) for name, part in parts.items()})


def shared_out(light: GlassLight, transmitted: NDArray[np.float32]) -> GlassLight:
    """(H, W, 3) ``transmitted`` in parts of the proportions of ``light``; where that is dark, all of it is behind."""
    total = light.transmitted.astype(np.float64)
    factor = np.divide(transmitted, total, out=np.zeros_like(total), where=total > 0)
    inner, contents, behind = (
        (part * factor).astype(np.float32) for part in (light.inner, light.contents, light.behind)
    )
    return GlassLight(inner, contents, np.where(total > 0, behind, transmitted))
