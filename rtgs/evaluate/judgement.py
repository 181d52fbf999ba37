"""The judge's rule and its record: in which regions a run shows the full method, in which the plain one.

Without torch: results are published without what computes them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rtgs.core.decisions import Decision
from rtgs.core.records import read_record, write_json

Role = Literal["full", "plain"]  # the method of the run, and the plain one
RECORD_FILE = "judge.json"
LEAST_VIEWS = 2  # that show a region: from one view nobody knows how much views differ
SURE = 2  # standard errors by which a difference is told from chance
LEAST_PIXELS = 64  # of a region in a view that is to count


@dataclass(frozen=True)
class RegionErrors:
    """What both methods do in one region, by held-out view.

    Attributes:
        region: its name in words.
        pixels: in each view, of those that count.
        full, plain: mean squared error over those pixels and the channels, images in [0, 1]; at least 1e-10. Without
            meaning where there are no pixels.
    """

    region: str
    pixels: tuple[int, ...]
    full: tuple[float, ...]
    plain: tuple[float, ...]


@dataclass(frozen=True)
class Verdict:
    """Which of the two methods one region shows, and why.

    Attributes:
        views: held-out views that show at least :data:`LEAST_PIXELS` pixels of the region; the figures are over them.
        pixels: in all of these.
        full_error, plain_error: geometric mean over the views of the mean squared error; None: no such view.
        gain: dB by which the full method is better, the mean of the views' differences in PSNR; None: likewise.
        spread: standard error of that mean; None: fewer than two views.
    """

    region: str
    kept: str
    views: int = 0
    pixels: int = 0
    full_error: float | None = None
    plain_error: float | None = None
    gain: float | None = None
    spread: float | None = None

    @property
    def figures(self) -> str:
        """Both errors and their difference in words, the kept method's first."""
        if self.gain is None or self.spread is None:
            return f"{self.views} held-out views show enough of it, {LEAST_VIEWS} are needed: nobody can judge"
        assert self.full_error is not None
        assert self.plain_error is not None
        errors = (self.plain_error, self.full_error) if self.kept == "plain" else (self.full_error, self.plain_error)
        text = f"error {errors[0]:.3g} against {errors[1]:.3g} on {self.views} held-out views"
        text += f", {abs(self.gain):.2f} dB with a standard error of {self.spread:.2f}"
        sure = self.kept == "plain" or self.gain > SURE * self.spread
        return text if sure else f"{text}: too close to be sure"


def verdict(errors: RegionErrors) -> Verdict:
    """Show the plain method where its PSNR is higher, in the mean over the held-out views, by more than :data:`SURE`
    standard errors of the difference. Elsewhere the full method, which was asked for, stays; of two that are the same
    to the bit the plain one is shown.

    Views are compared in pairs, for views differ more than methods do, and each counts alike, as in the tables. Where
    too few views show the region the full method stays: there is nothing to judge it by. The doubt is the full one's
    because it has more to gain where both are judged before their ends: its last stage began later (docs/judge.md).
    """
    shown = [index for index, count in enumerate(errors.pixels) if count >= LEAST_PIXELS]
    pixels = sum(errors.pixels[index] for index in shown)
    if len(shown) < LEAST_VIEWS:
        return Verdict(errors.region, "full", len(shown), pixels)
    full, plain = ([10 * math.log10(each[index]) for index in shown] for each in (errors.full, errors.plain))
    gains = [other - own for own, other in zip(full, plain, strict=True)]
    gain = statistics.fmean(gains)
    spread = statistics.stdev(gains) / math.sqrt(len(gains))
    return Verdict(
        errors.region,
        "full" if gain > -SURE * spread else "plain",
        len(shown),
        pixels,
        10 ** (statistics.fmean(full) / 10),
        10 ** (statistics.fmean(plain) / 10),
        gain,
        spread,
    )


@dataclass(frozen=True)
class JudgeRecord:
    """``judge.json``: which method each region of the pictures shows.

    Attributes:
        full, plain: names of the methods.
        views: names of the held-out views.
        regions: in the order of :class:`rtgs.evaluate.regions.Regions`.
        at: steps of both trainings at which they were judged, and from which on the held-out views are trained on as
            well; None: at their ends.
    """

    full: str
    plain: str
    views: tuple[str, ...]
    regions: tuple[Verdict, ...]
    at: tuple[int, int] | None = None

    @property
    def replaced(self) -> tuple[int, ...]:
        """Numbers of the regions that show the plain method."""
        return tuple(number for number, region in enumerate(self.regions) if region.kept == "plain")

    @property
    def all_plain(self) -> bool:
        """Nothing of the full method is left to see."""
        return len(self.replaced) == len(self.regions)

    def shows(self, role: Role) -> bool:
        """Whether a region shows this one of the two."""
        return any(region.kept == role for region in self.regions)

    def decisions(self) -> tuple[Decision, ...]:
        """For log and report: what each region shows, what was trained further, and of which method the files of
        Gaussians are."""
        lines = [Decision(f"kept {self._method(each)} in {each.region}", each.figures) for each in self.regions]
        lines += self._after_it()
        if self.all_plain:
            lines.append(Decision("files of Gaussians", f"they are of {self.plain}, which was kept everywhere"))
        elif self.replaced:
            why = f"they are of {self.full} alone, so are the maps and layers: files of two methods cannot be mixed"
            lines.append(Decision("files of Gaussians", why))
        return tuple(lines)

    def _after_it(self) -> Iterator[Decision]:
        if self.at is None:
            return
        steps: dict[Role, str] = {
            "full": f"{self.full} from step {self.at[0]} on",
            "plain": f"the plain {self.plain} from step {self.at[1]} on",
        }
        if self.views:
            shown = " and ".join(told for role, told in steps.items() if self.shows(role))
            yield Decision(f"{len(self.views)} held-out views are trained on", f"{shown}: there both were judged")
        for role, told in steps.items():
            if not self.shows(role):
                yield Decision("training stopped", f"{told}: no region shows it")

    def _method(self, region: Verdict) -> str:
        return f"the plain {self.plain}" if region.kept == "plain" else self.full

    def write(self, folder: Path) -> None:
        """Write ``folder/judge.json``."""
        write_json(folder / RECORD_FILE, asdict(self))

    @staticmethod
    def read(folder: Path) -> JudgeRecord:
        """Read ``folder/judge.json``.

        Raises:
            RtgsError: it is missing or damaged.
        """
        return read_record(JudgeRecord, folder / RECORD_FILE)
