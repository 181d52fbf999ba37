"""Views that grow: steps of a training see small pictures first, later as much detail as they can learn.

DashGaussian (Chen et al., CVPR 2025, 2503.18402): a picture of 1/s of the size holds the middle 1/s of its spectrum. A
size begins when the logarithm of the magnitude it holds is due, in even steps from the smallest size to the whole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from rtgs.core.decisions import Decision
from rtgs.scenes.images import area_resize, unit_or_zero
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

LEAST_SIDE = 32  # pixels of the short side of a view that is shrunk
_LEAST_SHARE = 0.25  # of the spectrum's magnitude that the smallest pictures hold (DashGaussian)


def spectrum_shares(views: Sequence[View], largest: int) -> tuple[float, ...]:
    """Of the factors s = 1 .. ``largest``: which share of the magnitude of all views' spectra pictures of 1/s of the
    size hold. Falls with s."""
    held = np.zeros(largest)
    for view in views:
        gray = view.image.mean(0).numpy()
        magnitude = np.abs(np.fft.fft2(gray))
        rows, columns = (np.abs(np.fft.fftfreq(count)) for count in gray.shape)  # in 0..1/2
        reach = np.maximum(rows[:, None], columns[None, :])
        held += [magnitude[reach <= 0.5 / factor].sum() for factor in range(1, largest + 1)]
    return tuple(held / held[0]) if held[0] > 0 else (1.0,) * largest  # black photos: nothing is lost


def factor_starts(shares: Sequence[float], until: int, begin: int = 0) -> tuple[tuple[int, int], ...]:
    """(first step, factor), the factors falling to 1 at step ``until``; ``shares`` of the factors 1 .. S.

    Factor s begins ln(E(s) / E(S)) / ln(E(1) / E(S)) of the way from step ``begin`` to ``until``; before ``begin``
    views are whole. The smallest pictures hold at least a quarter.
    """
    held = [share for share in shares if share >= _LEAST_SHARE]
    whole = math.log(held[0] / held[-1])
    if whole <= 0:
        return ((0, 1),)
    counted = range(len(held), 0, -1)  # where two begin at once, the larger pictures are shown
    way = until - begin
    begins = {begin + round(way * math.log(held[factor - 1] / held[-1]) / whole): factor for factor in counted}
    return tuple(({0: 1} | begins).items())


def shrunk(view: View, factor: int) -> View:
    """The view at 1/``factor`` of its size, by area averaging; a mask by majority."""
    camera = view.camera.resized(max(view.camera.width // factor, 1), max(view.camera.height // factor, 1))
    size = (camera.width, camera.height)

    def averaged(values: torch.Tensor) -> np.ndarray:
        return area_resize(np.ascontiguousarray(values.numpy().transpose(1, 2, 0)), *size)

    def planes(rows: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(rows.transpose(2, 0, 1)))

    mask = view.mask
    if mask is not None:
        share = area_resize(np.ascontiguousarray(mask.numpy(), dtype=np.float32), *size)
        mask = torch.from_numpy(share > 0.5)
    normal = None if view.normal is None else planes(unit_or_zero(averaged(view.normal)))
    return replace(view, camera=camera, image=planes(averaged(view.image)), mask=mask, normal=normal, truth=None)


class GrowingViews:
    """The training views of a scene as steps see them.

    Attributes:
        starts: (first step, factor): by how much views are shrunk from which step on.
    """

    def __init__(
        self,
        views: Sequence[View],
        schedule: ScheduleSettings,
        why: str = "schedule.coarse, and what their spectra hold",
    ) -> None:
        """``why``: for the log."""
        self._views, self._why = views, why
        self.starts: tuple[tuple[int, int], ...] = ((0, 1),)
        largest = self._largest(schedule.coarse)
        if largest > 1:
            begin, until = (round(share * schedule.total) for share in (schedule.coarse_from, schedule.coarse_until))
            self.starts = factor_starts(spectrum_shares(views, largest), until, begin)
        self._factor = 1
        self._shrunk: dict[int, View] = {}

    def _largest(self, wanted: int) -> int:
        """Factors at which every view keeps enough pixels."""
        least = min((min(view.camera.width, view.camera.height) for view in self._views), default=0)
        return max(1, min(wanted, least // LEAST_SIDE))

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """When views grow."""
        if len(self.starts) == 1:
            return ()
        sizes = ", ".join(f"1/{factor} from step {step}" for step, factor in self.starts)
        return (Decision(f"size of the views in training: {sizes}", self._why),)

    def factor(self, step: int) -> int:
        """By which views are shrunk in ``step``."""
        return next(factor for start, factor in reversed(self.starts) if start <= step)

    def at(self, index: int, step: int) -> View:
        """View ``index`` as ``step`` sees it; those of the present factor are kept."""
        factor = self.factor(step)
        if factor == 1:
            self._shrunk.clear()
            return self._views[index]
        if factor != self._factor:
            self._shrunk.clear()
            self._factor = factor
        view = self._views[index]
        if id(view) not in self._shrunk:  # one that is listed several times is shrunk once
            self._shrunk[id(view)] = shrunk(view, factor)
        return self._shrunk[id(view)]
