"""Quality over training time: one curve per run, its knee, and tables at equal times and at equal steps."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtgs.core.listing import spreadsheet_cell

NOT_REACHED = "-"
ENDED = "*"  # behind a figure of a run that had ended by then


@dataclass(frozen=True)
class Look:
    """The test views as they were scored along a training."""

    steps: int
    cpu_seconds: float  # of the training until then, all threads, of the mesh it waited for, and of further models
    psnr: float  # mean over the test views, dB
    psnr_masked: float | None = None  # in the masks, of the views that have one


@dataclass(frozen=True)
class QualityCurve:
    """The looks of one run, in their order."""

    scene: str
    method: str
    preset: str
    seed: int
    looks: tuple[Look, ...]

    def __post_init__(self) -> None:
        times = [look.cpu_seconds for look in self.looks]
        if not times or times != sorted(times):
            raise ValueError(f"{self.label} on {self.scene}: {len(times)} looks whose times do not rise")

    @property
    def label(self) -> str:
        """Of the curve: method, preset, and the seed where it is not 0."""
        return f"{self.method}, {self.preset}" + (f", seed {self.seed}" if self.seed else "")

    def at_seconds(self, seconds: float) -> Look | None:
        """The run after so much time: between two looks linearly, after the last the last; None before the first."""
        if at := [each for each in self.looks if each.cpu_seconds == seconds]:
            return at[-1]  # where an ensemble ends there are two
        later = next((index for index, each in enumerate(self.looks) if each.cpu_seconds > seconds), None)
        if later is None:
            return self.looks[-1]
        after = self.looks[later]
        if later == 0:
            return None
        before = self.looks[later - 1]
        share = (seconds - before.cpu_seconds) / (after.cpu_seconds - before.cpu_seconds)
        masked = None
        if before.psnr_masked is not None and after.psnr_masked is not None:
            masked = _between(before.psnr_masked, after.psnr_masked, share)
        steps = round(_between(before.steps, after.steps, share))
        return Look(steps, seconds, _between(before.psnr, after.psnr, share), masked)

    def at_steps(self, steps: int) -> Look | None:
        """The look after so many steps; None where none was taken."""
        return next((each for each in self.looks if each.steps == steps), None)

    @property
    def knee(self) -> Look | None:
        """Where more time begins to bring little: the look that is farthest above the straight line from the first to
        the last, of the best PSNR so far over time. None with fewer than three looks, or where nothing was gained.

        References:
            Satopaa et al. 2011, "Finding a Kneedle in a Haystack", with its difference curve.
        """
        first, last = self.looks[0], self.looks[-1]
        best = list(itertools.accumulate((each.psnr for each in self.looks), max))
        gain, time = best[-1] - best[0], last.cpu_seconds - first.cpu_seconds
        if len(self.looks) < 3 or gain <= 0 or time <= 0:
            return None
        above = [
            (quality - best[0]) / gain - (each.cpu_seconds - first.cpu_seconds) / time
            for quality, each in zip(best, self.looks, strict=True)
        ]
        highest = max(range(len(above)), key=above.__getitem__)
        return self.looks[highest] if above[highest] > 0 else None


def _between(low: float, high: float, share: float) -> float:
    return low + share * (high - low)


def with_pause(looks: Sequence[Look], steps: int, seconds: float) -> list[Look]:
    """The looks of a training that stood still for so long after so many steps, for its mesh: later ones are later, and
    the quality in between is that before."""
    before = [look for look in looks if look.steps <= steps]
    after = [_later(look, seconds) for look in looks if look.steps > steps]
    return [*before, *([_later(before[-1], seconds)] if before and seconds > 0 else []), *after]


def with_others(looks: Sequence[Look], end: Look) -> list[Look]:
    """The looks of a training after which the further models of an ensemble are trained: until the ``end`` of those the
    quality is that of the one model, and then it is the ensemble's."""
    last = looks[-1]
    return [*looks, _later(last, end.cpu_seconds - last.cpu_seconds), end]


def _later(look: Look, seconds: float) -> Look:
    return Look(look.steps, look.cpu_seconds + seconds, look.psnr, look.psnr_masked)


def markdown(
    curves: Sequence[QualityCurve], minutes: Sequence[float], steps: Sequence[int], notes: Sequence[str] = ()
) -> str:
    """GitHub Markdown: for each scene PSNR and masked PSNR after equal times, after equal steps, and the knees.
    ``notes``: sentences added at the end."""
    lines = ["# Quality over training time", ""]
    for scene in dict.fromkeys(curve.scene for curve in curves):
        mine = [curve for curve in curves if curve.scene == scene]
        lines += [f"## {scene}", ""]
        for title, value in _MEASURES:
            if any(value(look) is not None for curve in mine for look in curve.looks):
                lines += [*_table(title, mine, value, minutes, steps), ""]
    lines += [
        "- Time is CPU time of the training, all threads, and of the mesh that it waited for; scoring "
        "does not count. Between two looks it is interpolated. The mean of several models counts at its end, when all "
        "are trained.",
        f"- {ENDED}: the run had ended by then. {NOT_REACHED}: no look was taken there.",
        "- Knee: the look farthest above the line from the first to the last (Satopaa et al. 2011).",
        *(f"- {note}" for note in notes),
    ]
    return "\n".join(lines) + "\n"


Measure = Callable[[Look], float | None]
_MEASURES: tuple[tuple[str, Measure], ...] = (
    ("PSNR", lambda look: look.psnr),
    ("PSNR in the mask", lambda look: look.psnr_masked),
)


def _table(
    title: str, curves: Sequence[QualityCurve], value: Measure, minutes: Sequence[float], steps: Sequence[int]
) -> list[str]:
    times, counts = [f"{each:g} min" for each in minutes], [f"{each} steps" for each in steps]
    header = [title, *times, *counts, "end", "CPU s", "knee"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for curve in curves:
        row = [curve.label.replace("|", "\\|")]
        for each in minutes:
            ended = each * 60 > curve.looks[-1].cpu_seconds
            row.append(_shown(curve.at_seconds(each * 60), value) + (ENDED if ended else ""))
        row += [_shown(curve.at_steps(each), value) for each in steps]
        knee, last = curve.knee, curve.looks[-1]
        row += [_shown(last, value), f"{last.cpu_seconds:.0f}"]
        row.append(NOT_REACHED if knee is None else f"{_shown(knee, value)} at {knee.cpu_seconds:.0f} s")
        lines.append("| " + " | ".join(row) + " |")
    return lines


def _shown(look: Look | None, value: Measure) -> str:
    found = None if look is None else value(look)
    return NOT_REACHED if found is None else f"{found:.2f}"


def comma_separated(curves: Sequence[QualityCurve]) -> str:
    """Every look of every run, unrounded."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["scene", "method", "preset", "seed", "steps", "cpu_seconds", "psnr", "psnr_masked", "knee"])
    for curve in curves:
        start = [spreadsheet_cell(each) for each in (curve.scene, curve.method, curve.preset)]
        for look in curve.looks:
            masked = "" if look.psnr_masked is None else repr(look.psnr_masked)
            row = [look.steps, repr(look.cpu_seconds), repr(look.psnr), masked, int(look == curve.knee)]
            writer.writerow([*start, curve.seed, *row])
    return stream.getvalue()
