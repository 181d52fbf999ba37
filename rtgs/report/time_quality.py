"""A plot of quality over training time: the curves of one scene, their knees marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtgs.evaluate.curves import QualityCurve
from rtgs.report.panels import save_figure

_COLORS = "tab10"
_LINES = ("-", "--", ":", "-.")
_MARKS = ".^sDvx*P<>"  # with the colours, so that curves are told apart in grey as well


def draw_time_quality(curves: Sequence[QualityCurve], path: Path) -> tuple[Path, ...]:
    """Write ``path`` with the suffixes ``.png`` and ``.pdf``.

    PSNR over CPU seconds, and beside it PSNR in the masks where any run has it. A colour and a mark for each method,
    a line for each preset, a ring at each knee, the legend beside the plots.

    Args:
        curves: of one scene, at least one.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    masked = any(look.psnr_masked is not None for curve in curves for look in curve.looks)
    titles = ("PSNR, dB", "PSNR in the mask, dB")[: 1 + masked]
    figure = Figure(figsize=(5 * len(titles) + 1.8, 4.2), layout="constrained")
    methods = list(dict.fromkeys(curve.method for curve in curves))
    presets = list(dict.fromkeys(curve.preset for curve in curves))
    for place, title in enumerate(titles):
        axes = figure.add_subplot(1, len(titles), place + 1)
        for curve in curves:
            found = [(each, each.psnr_masked if place else each.psnr) for each in curve.looks]
            points = [(each.cpu_seconds, value) for each, value in found if value is not None]
            place_of, line = methods.index(curve.method), _LINES[presets.index(curve.preset) % len(_LINES)]
            color = colormaps[_COLORS](place_of % 10)
            if points:
                mark = _MARKS[place_of % len(_MARKS)]
                axes.plot(*zip(*points), line, color=color, marker=mark, markersize=4, label=curve.label)
            knees = [(each.cpu_seconds, value) for each, value in found if each == curve.knee and value is not None]
            for knee in knees:
                axes.plot(*knee, "o", color=color, fillstyle="none", markersize=10)
        axes.set(xscale="log", xlabel="CPU seconds of training", ylabel=title)
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
    figure.suptitle(f"{curves[0].scene}: ring = knee")
    return save_figure(figure, path)
