"""The plots of ``lab.levers``, tracer and rasteriser: what each lever saves and what it costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

STYLES = {  # lever -> title, colour, marker
    "transmittance_cutoff": ("transmittance cutoff", "#3b7dd8", "o"),
    "alpha_cutoff": ("alpha cutoff", "#d9822b", "s"),
    "traced_share": ("share of rays, at random", "#b0508f", "D"),
    "specular_threshold": ("specular threshold", "#3a9c6b", "^"),
    "resolution": ("resolution, bilinear", "#7c8794", "v"),
}
DEFAULT_MARK = 150  # points squared


def draw_levers(figures: dict[str, Any], defaults: dict[str, float], path: Path) -> None:
    """PSNR and gradient error over relative time, and the time of a step over the steps between rebuilds."""
    from matplotlib.figure import Figure

    tracer = figures["tracer"]
    lines = _by_lever(tracer["points"])
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    picture, gradient, refit = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 0.8))
    _draw_pair(picture, gradient, lines, defaults)
    _draw_refit(refit, lines["refit_interval"], defaults)
    rays = f"{tracer['surfels']:,} surfels, {tracer['rays']:,} reflected rays"
    _finish(figure, (picture, gradient, refit), figures["machine"], rays, path)


def draw_raster_levers(figures: dict[str, Any], defaults: dict[str, float], path: Path) -> None:
    """PSNR and gradient error of the rasteriser over relative time."""
    from matplotlib.figure import Figure

    raster = figures["rasterizer"]
    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    picture, gradient = figure.subplots(1, 2)
    _draw_pair(picture, gradient, _by_lever(raster["points"]), defaults)
    width, height = raster["image"]
    what = f"{raster['surfels']:,} surfels, {width}x{height} pixels"
    _finish(figure, (picture, gradient), figures["machine"], what, path)


def _by_lever(points: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    lines: dict[str, list[dict[str, Any]]] = {}
    for point in points:
        lines.setdefault(point["lever"], []).append(point)
    return lines


def _draw_pair(picture, gradient, lines: dict[str, list[dict[str, Any]]], defaults: dict[str, float]) -> None:
    _draw_errors(picture, lines, "psnr", defaults)
    _draw_errors(gradient, lines, "gradient_error", defaults)
    picture.set_title("Picture: up is more exact", loc="left", fontsize=11)
    picture.set_ylabel("PSNR against no cut, dB")
    gradient.set_title("Gradient of the means: down is more exact", loc="left", fontsize=11)
    gradient.set_ylabel("relative L2 error")
    gradient.set_yscale("log")


def _finish(figure, panels, machine: dict[str, Any], what: str, path: Path) -> None:
    for axes in panels:
        axes.grid(True, which="major", color="#e3e6ea", lw=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    where = f"{machine['processor']}, {machine['isa']}; CPU time of one thread, forward + backward; "
    where += f"{what}; ringed: defaults"
    figure.supxlabel(where, fontsize=8, color="#5c6670")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def _draw_errors(axes, lines: dict[str, list[dict[str, Any]]], key: str, defaults: dict[str, float]) -> None:
    for lever, (title, color, marker) in STYLES.items():
        shown = [p for p in lines.get(lever, []) if p[key]]  # None and exact answers have no place on the axis
        if not shown:
            continue
        at = [(p["relative_time"], p[key]) for p in shown]
        axes.plot(*zip(*at, strict=True), color=color, marker=marker, ms=5, lw=1.4, label=title)
        for point, place in zip(shown, at, strict=True):
            text = _setting(lever, point["setting"])
            axes.annotate(text, place, (4, 5), textcoords="offset points", fontsize=7, color=color)
            if _is_default(lever, point["setting"], defaults):
                axes.scatter(*place, s=DEFAULT_MARK, facecolors="none", edgecolors=color, lw=1.6)
    axes.set_xlabel("time relative to the lever's first setting")
    axes.margins(x=0.1, y=0.12)
    axes.legend(frameon=False, fontsize=8)


def _draw_refit(axes, points: list[dict[str, Any]], defaults: dict[str, float]) -> None:
    steps, times = [p["setting"] for p in points], [p["relative_time"] for p in points]
    axes.plot(steps, times, "o-", color="#3b7dd8", ms=5, lw=1.4)
    for step, time in zip(steps, times, strict=True):
        if _is_default("refit_interval", step, defaults):
            axes.scatter(step, time, s=DEFAULT_MARK, facecolors="none", edgecolors="#3b7dd8", lw=1.6)
    axes.set_xscale("log")
    axes.set_title("Steps between rebuilds: no error", loc="left", fontsize=11)
    axes.set_xlabel("steps between rebuilds; refitted in between")
    axes.set_ylabel("time of a step, builds included, relative to rebuilding always")


def _is_default(lever: str, setting: float, defaults: dict[str, float]) -> bool:
    return lever in defaults and abs(setting - defaults[lever]) <= 1e-9


def _setting(lever: str, value: float) -> str:
    if lever == "alpha_cutoff":
        return f"1/{1 / value:.0f}"
    return f"{value:g}" if lever in ("transmittance_cutoff", "specular_threshold") else f"{value:.0%}"
