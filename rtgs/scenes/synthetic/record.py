"""What is known of a finished view (``record.json``) and of a finished capture (``synthetic.json``)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtgs.core.errors import RtgsError
from rtgs.core.records import read_record
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.synthetic.layers import LightLayers

CAPTURE_RECORD = "synthetic.json"
VIEW_RECORD = "record.json"


@dataclass(frozen=True)
class ViewRecord:
    """Figures of one view. Reflected shares are averages over pixels of reflected / all light, linear."""

    image: str  # file name
    samples: int
    seconds: float
    masked: float  # share of the pixels that show a transparent surface
    specular: float  # share of the pixels that show a mirror, glossy or transparent surface
    reflected_in_mask: float | None  # None: no such pixels
    reflected_in_specular: float | None
    noise: float | None  # mean squared error against the converged image, sRGB 0..1, before rounding; test views

    def write(self, folder: Path) -> None:
        """Write ``record.json``."""
        (folder / VIEW_RECORD).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    def read(folder: Path) -> ViewRecord:
        """Read what :meth:`write` wrote.

        Raises:
            RtgsError: it is missing or damaged.
        """
        return read_record(ViewRecord, folder / VIEW_RECORD, "delete the folder, and the view is rendered again")


@dataclass(frozen=True)
class CaptureRecord:
    """Figures of a synthetic capture; shares and PSNR are averages over its views."""

    name: str
    title: str
    stand_in_for: str  # the scene of a paper whose place it takes in tables; empty: none
    description_sha256: str  # of the scene file
    renderer: str  # Mitsuba version and variant
    width: int
    height: int
    views: int
    samples: int
    test_samples: int
    seed: int
    points: int
    seconds: float
    noise_psnr: float  # dB of the test images against a converged render, mean over the test views
    noise_psnr_worst: float
    masked: float
    specular: float
    reflected_in_mask: float | None
    reflected_in_specular: float | None
    psnr_specular_2dgs: float | None = None  # dB on mirror, gloss and glass of `method=2dgs preset=quick`
    psnr_rest_2dgs: float | None = None  # dB elsewhere of the same run; both set by benchmarks.quality.difficulty

    def labelled(self, name: str) -> str:
        """How tables, pages and logs name the scene: nobody may take a stand-in for a paper's data."""
        return f"{name} (stand-in)" if self.stand_in_for else name

    @property
    def photo_noise_psnr(self) -> float:
        """PSNR in dB of the training photos against a converged render, before JPEG: the noise of the test views falls
        with the samples, so that of fewer is as many times larger. An estimate; nothing of the photos is measured."""
        from rtgs.scenes.synthetic.noise import ROUNDING, psnr

        tests = max(10 ** (-self.noise_psnr / 10) - ROUNDING, 0.0)
        return psnr(tests * self.test_samples / self.samples + ROUNDING)

    @property
    def origin(self) -> str:
        """An addition to what is said of where a scene came from."""
        stand_in = f", stand-in for {self.stand_in_for}, not its data" if self.stand_in_for else ""
        return f"; path traced ({self.renderer}){stand_in}"

    def write(self, folder: Path) -> None:
        """Write ``synthetic.json``."""
        (folder / CAPTURE_RECORD).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    def read(folder: Path) -> CaptureRecord | None:
        """The record of a capture, None where it has none.

        Raises:
            CaptureError: the file is there and cannot be read.
        """
        path = folder / CAPTURE_RECORD
        if not path.is_file():
            return None
        try:
            return read_record(CaptureRecord, path, "make the capture again, or remove the file")
        except RtgsError as error:
            raise CaptureError(str(error)) from error


def reflected_share(layers: LightLayers, where: NDArray[np.bool_]) -> float | None:
    """Average over the pixels of ``where`` of the share of reflected light, linear."""
    if not where.any():
        return None
    reflected, total = (light.mean(-1)[where] for light in (layers.reflected, layers.image))
    return float(np.mean(reflected / np.maximum(total, 1e-6)))


def noise_psnrs(views: list[ViewRecord]) -> list[float]:
    """PSNR of every test view against its converged render, dB."""
    from rtgs.scenes.synthetic.noise import picture_psnr  # loads torch, which plans that read a record do without

    return [picture_psnr(view.noise) for view in views if view.noise is not None]


def weighted_share(views: list[ViewRecord], share: str, weight: str) -> float | None:
    """Average of a share over all pixels of all views that it is about."""
    pairs = [(getattr(view, share), getattr(view, weight)) for view in views if getattr(view, share) is not None]
    total = sum(weight for _, weight in pairs)
    return sum(value * weight for value, weight in pairs) / total if total > 0 else None
