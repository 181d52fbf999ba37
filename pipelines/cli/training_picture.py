"""A first picture of a model while it trains, made again as it gets better; the finished run has better ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.files import whole_file
from rtgs.train.progress import Progress, SilentProgress

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.mesh.container import ObjectMesh
    from rtgs.scenes.scene import Scene, View
    from rtgs.train.method import Method

MARKS = (10.0, 30.0, 90.0)
"""Seconds of the run after which there is a picture."""
EVERY = 300.0
"""And after so many more each time: a picture costs about as much as three steps of training."""
QUALITY = 90  # of the JPEG


class TrainingPicture(SilentProgress):
    """One test view (a training view where there are none): the photo, and beside it the model at this moment.

    Implements :class:`rtgs.train.onlooker.Onlooker`; it never ends a training.

    Args:
        path: of the JPEG file, written as a whole; its folder is made.
        clock: seconds from anywhere.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self._clock = clock
        self._began = clock()
        self._marks = list(MARKS)
        self._view: View | None = None
        self._progress: Progress = SilentProgress()

    def attend(self, scene: Scene, mesh: ObjectMesh | None, progress: Progress) -> None:
        """A training begins; one line of each picture goes to ``progress``."""
        views = scene.test or scene.train
        self._view, self._progress = views[len(views) // 2], progress

    def look(self, method: Method, step: int) -> bool:
        """Where a mark was passed, make the picture; the method stays as it is."""
        elapsed = self._clock() - self._began
        if self._view is None or elapsed < self._marks[0]:
            return False
        while self._marks and self._marks[0] <= elapsed:
            self._marks.pop(0)
        self._marks = self._marks or [elapsed + EVERY]
        psnr = self._write(method, self._view, step)
        self._progress.note(f"picture after step {step}: {self.path} (photo, model; {psnr:.1f} dB)")
        return False

    def _write(self, method: Method, view: View, step: int) -> float:
        import numpy as np
        import torch
        from PIL import Image

        from rtgs.evaluate.images import to_bytes
        from rtgs.train.held_out import psnr_of
        from rtgs.train.method import Mode

        with torch.no_grad():
            image = method.render(view.camera, step, Mode.EVALUATE, mask=view.mask).image
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self.path) as partial:
            pixels = np.concatenate([to_bytes(view.image), to_bytes(image)], 1)
            Image.fromarray(pixels).save(partial, format="JPEG", quality=QUALITY)
        return psnr_of(image, view.image)


def picture_of_run(config: RunConfig) -> TrainingPicture:
    """In the run's folder, until the finished run replaces it."""
    from pipelines.publishing.results import TRAINING_PICTURE

    return TrainingPicture(config.paths.runs / str(config.name) / TRAINING_PICTURE)
