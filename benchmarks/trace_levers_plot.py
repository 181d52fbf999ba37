"""The plot of the tracer's part of ``benchmarks.speed_error``: what each lever saves and what it costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

TITLES = {
    "transmittance_cutoff": "transmittance cutoff",
    "alpha_cutoff": "alpha cutoff",
    "refit_interval": "steps between rebuilds",
    "traced_share": "share of rays, at random",
    "traced_block": "share of rays, one block",
    "specular_threshold": "specular threshold",
    "resolution": "resolution, bilinear",
}
DEFAULT_MARK = 130  # points squared


def draw_levers(figures: dict[str, Any], defaults: dict[str, float], path: Path) -> None:
    """Left: PSNR over relative time; middle: gradient error; right: time of the levers that cost no error."""
    from matplotlib.figure import Figure

    tracer = figures["tracer"]
    lines: dict[str, list[dict[str, Any]]] = {}
    for point in tracer["points"]:
        lines.setdefault(point["lever"], []).append(point)
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    panels = figure.subplots(1, 3)
    kinds = (
        ("psnr", "PSNR against no cut, dB"),
        ("gradient_error", "relative error of the means' gradient"),
        (None, ""),
    )
    for axes, (key, label) in zip(panels, kinds, strict=True):
        _draw_panel(axes, lines, key, defaults)
        axes.set_xlabel("time, forward + backward, relative to the first setting")
        axes.set_ylabel(label or "setting")
        axes.grid(True, which="major", color="#e3e6ea", lw=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_title("Picture: up is more exact", loc="left", fontsize=11)
    panels[1].set_title("Gradient: down is more exact", loc="left", fontsize=11)
    panels[2].set_title("No error, time only", loc="left", fontsize=11)
    panels[1].set_yscale("log")
    panels[2].set_yscale("log")
    found = figures["machine"]
    where = f"{found['processor']}, {found['isa']}; CPU time of one thread; "
    where += f"{tracer['surfels']:,} surfels, {tracer['rays']:,} reflected rays; large marks: defaults"
    figure.supxlabel(where, fontsize=8, color="#5c6670")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def _draw_panel(axes, lines: dict[str, list[dict[str, Any]]], key: str | None, defaults: dict[str, float]) -> None:
    from rtgs.report.figures import SERIES_COLORS

    for color, (lever, points) in zip(SERIES_COLORS * 2, lines.items()):
        if key is None:
            shown = points if lever in ("refit_interval", "traced_block") else []
            y = [p["setting"] for p in shown]
        else:
            shown = [p for p in points if p[key]]  # None and exact answers have no place on the axis
            y = [p[key] for p in shown]
        if not shown or (key == "gradient_error" and lever == "refit_interval"):
            continue
        x = [p["relative_time"] for p in shown]
        axes.plot(x, y, "o-", color=color, ms=5, lw=1.4, label=TITLES[lever])
        for point, at in zip(shown, zip(x, y, strict=True), strict=True):
            text = _setting(lever, point["setting"])
            axes.annotate(text, at, (0, 6), textcoords="offset points", ha="center", fontsize=7, color=color)
            if defaults.get(lever) is not None and abs(point["setting"] / max(defaults[lever], 1e-12) - 1) < 1e-6:
                axes.scatter(*at, s=DEFAULT_MARK, facecolors="none", edgecolors=color, lw=1.6)
    axes.margins(x=0.1, y=0.12)
    axes.legend(frameon=False, fontsize=8)


def _setting(lever: str, value: float) -> str:
    if lever == "alpha_cutoff":
        return f"1/{1 / value:.0f}"
    return f"{value:g}" if lever in ("transmittance_cutoff", "specular_threshold", "refit_interval") else f"{value:.0%}"
