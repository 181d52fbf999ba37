"""Pictures of fixed views and layers during training: the slider of the tracker.

They are files of the training artifact, as the curves are: a run that finds its training cached shows them as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.names import unique_stems
from rtgs.runs.views import read_render, view_maps

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.methods import Method
    from rtgs.scenes.scene import Scene, View

FOLDER = "pictures"
VIEWS = 2
STOPS = 8  # of a long training
LEAST_STEPS = 500  # between two stops: a picture costs about as much as three steps of training, so below 1 %
LONG_SIDE = 320
_COLOURS = ("image", "reflection", "transmission")
_NAME = re.compile(r"(\d{6})_(.+)__([a-z_]+)\.png")


@dataclass(frozen=True)
class LayerPicture:
    """One layer of one view at one step."""

    view: str
    layer: str
    step: int
    pixels: np.ndarray  # (H, W, 3) or (H, W) uint8

    @property
    def key(self) -> str:
        """What the stops of one slider have in common."""
        return f"{self.view}/{self.layer}"


def fixed_views(scene: Scene) -> tuple[View, ...]:
    """The views that are watched: evenly spread over the test views, over the training views where there are none."""
    views = scene.test or scene.train
    count = min(VIEWS, len(views))
    return tuple(views[index * len(views) // count] for index in range(count))


def layer_pixels(maps: Mapping[str, Tensor], camera: Camera) -> dict[str, np.ndarray]:
    """The layers people look at, as pixels; ``maps`` as :func:`rtgs.runs.views.view_maps` gives them."""
    from rtgs.evaluate.images import to_bytes
    from rtgs.report.figures import alpha_picture, normal_picture

    pixels = {name: to_bytes(maps[name]) for name in _COLOURS if name in maps}
    if "normal" in maps:
        pixels["normal"] = normal_picture(maps["normal"], camera)
    if "specular" in maps:
        pixels["specular"] = alpha_picture(maps["specular"])
    return {name: _small(array) for name, array in pixels.items()}


def _small(pixels: np.ndarray) -> np.ndarray:
    import numpy as np
    from PIL import Image

    height, width = pixels.shape[:2]
    if max(height, width) <= LONG_SIDE:
        return pixels
    share = LONG_SIDE / max(height, width)
    size = max(1, round(width * share)), max(1, round(height * share))
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


class TrainingPictures:
    """Looks at the fixed views every so many steps of a training of ``total`` steps, and writes PNG files."""

    def __init__(self, scene: Scene, folder: Path, total: int) -> None:
        self._views = fixed_views(scene)
        self._stems = unique_stems(view.name for view in self._views)
        self._folder = folder
        self._total = total
        self._every = max(LEAST_STEPS, total // STOPS)

    def look(self, method: Method, step: int) -> None:
        """After ``step`` steps. The end is left out: the rendered test views show it."""
        from PIL import Image

        if step % self._every or step >= self._total:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        for view in self._views:
            for layer, pixels in layer_pixels(_rendered(method, view, step), view.camera).items():
                name = f"{step:06d}_{self._stems[view.name]}__{layer}.png"
                Image.fromarray(pixels).save(self._folder / name, compress_level=1)


def _rendered(method: Method, view: View, step: int) -> dict[str, Tensor]:
    import torch

    from rtgs.methods import Mode, RenderOptions

    with torch.no_grad():
        options = RenderOptions(depth=True, normal="normal" in method.maps, layers=True)
        rendered = method.render(view.camera, step, Mode.EVALUATE, options, view.mask)
        return {"image": rendered.image, **view_maps(rendered)}


def training_pictures(folder: Path) -> Iterator[LayerPicture]:
    """What :class:`TrainingPictures` left in a training artifact, in the order of the steps."""
    import numpy as np
    from PIL import Image

    for path in sorted((folder / FOLDER).glob("*.png")):
        if match := _NAME.fullmatch(path.name):
            with Image.open(path) as opened:
                yield LayerPicture(match.group(2), match.group(3), int(match.group(1)), np.asarray(opened))


def final_pictures(scene: Scene, rendered: Path, step: int) -> Iterator[LayerPicture]:
    """The same layers of the same views from the artifact of the render step; none without test views."""
    views = fixed_views(scene) if scene.test else ()
    stems = unique_stems(view.name for view in views)
    for view in views:
        for layer, pixels in layer_pixels(read_render(rendered, view.name), view.camera).items():
            yield LayerPicture(stems[view.name], layer, step, pixels)
