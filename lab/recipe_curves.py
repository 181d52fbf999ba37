"""Quality over training time of two recipes, every scene in one picture.

``python -m lab.recipe_curves BEFORE/table.csv AFTER/table.csv --labels before now --out curves.png``

The tables are those that ``rtgs run experiment=time_quality`` writes; the second run had the config words of the other
recipe. A plot for each scene, a colour for each method and preset, dashed for the first table and solid for the second.
Prints a Markdown table of where the curves end, and how long the second recipe takes to reach the end of the first.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

from rtgs.evaluate.curves import Look, QualityCurve

COLUMNS = 4
_LINES = ("--", "-")


@dataclass(frozen=True)
class Pair:
    """What one method made of one scene with both recipes."""

    before: QualityCurve
    after: QualityCurve

    @property
    def caught_up(self) -> float | None:
        """CPU seconds after which the second recipe is as good as the first at its end, and stays so; None: it never
        is."""
        end = self.before.looks[-1].psnr
        behind = [place for place, look in enumerate(self.after.looks) if look.psnr < end]
        first = behind[-1] + 1 if behind else 0
        return self.after.looks[first].cpu_seconds if first < len(self.after.looks) else None

    def row(self) -> str:
        """A line of the table."""
        ends = [curve.looks[-1] for curve in (self.before, self.after)]
        caught = "never" if self.caught_up is None else f"{self.caught_up:.0f}"
        cells = [self.after.scene, self.after.label]
        cells += [f"{end.psnr:.2f}, {end.cpu_seconds:.0f} s" for end in ends]
        cells += [f"{ends[1].psnr - ends[0].psnr:+.2f}", caught]
        return f"| {' | '.join(cells)} |"


def read_curves(path: Path) -> list[QualityCurve]:
    """The curves of a ``table.csv``.

    Raises:
        ValueError: it holds none.
    """
    looks: dict[tuple[str, str, str, int], list[Look]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            masked = float(row["psnr_masked"]) if row["psnr_masked"] else None
            look = Look(int(row["steps"]), float(row["cpu_seconds"]), float(row["psnr"]), masked)
            looks.setdefault((row["scene"], row["method"], row["preset"], int(row["seed"])), []).append(look)
    if not looks:
        raise ValueError(f"{path} holds no curve: give the table.csv of a run of experiment=time_quality")
    return [QualityCurve(*key, tuple(found)) for key, found in looks.items()]


def paired(before: list[QualityCurve], after: list[QualityCurve]) -> list[Pair]:
    """Curves of the same scene, method, preset and seed, in the order of the second.

    Raises:
        ValueError: none is in both.
    """
    others = {(c.scene, c.method, c.preset, c.seed): c for c in before}
    keys = [(c.scene, c.method, c.preset, c.seed) for c in after]
    pairs = [Pair(others[key], curve) for key, curve in zip(keys, after, strict=True) if key in others]
    if not pairs:
        raise ValueError("the two tables have no scene, method, preset and seed in common")
    return pairs


def draw(pairs: list[Pair], labels: tuple[str, str], path: Path) -> None:
    """Write the picture: a plot for each scene."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    scenes = list(dict.fromkeys(pair.after.scene for pair in pairs))
    kinds = list(dict.fromkeys(pair.after.label for pair in pairs))
    rows = -(-len(scenes) // COLUMNS)
    figure = Figure(figsize=(3.4 * min(COLUMNS, len(scenes)), 2.7 * rows + 0.5), layout="constrained")
    handles = {}
    for place, scene in enumerate(scenes):
        axes = figure.add_subplot(rows, min(COLUMNS, len(scenes)), place + 1)
        for pair in (each for each in pairs if each.after.scene == scene):
            kind = pair.after.label
            color = colormaps["tab10"](kinds.index(kind) % 10)
            for curve, label, line in zip((pair.before, pair.after), labels, _LINES, strict=True):
                points = [(look.cpu_seconds, look.psnr) for look in curve.looks]
                (drawn,) = axes.plot(*zip(*points), line, color=color, marker=".", markersize=4)
                handles[f"{kind}: {label}"] = drawn
        axes.set_title(scene, fontsize="medium")
        axes.set(xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    figure.supxlabel("CPU seconds of training")
    figure.supylabel("PSNR, dB")
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4, fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--labels", nargs=2, default=["before", "now"])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    pairs = paired(read_curves(options.before), read_curves(options.after))
    draw(pairs, tuple(options.labels), options.out)
    print(f"| scene | method | {' | '.join(options.labels)} | dB | as good after, CPU s |\n{'| --- ' * 6}|")
    for pair in pairs:
        print(pair.row())


if __name__ == "__main__":
    main()
