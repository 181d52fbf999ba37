"""The plot of ``benchmarks.speed_error``: error over time of the kernels, quality over time of training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

PICTURE_BOUND, GRADIENT_BOUND = 1e-5, 1e-4  # of the largest value; the bounds of the tests


def draw(figures: dict[str, Any], path: Path) -> None:
    """Both panels as one PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))
    draw_kernel(left, figures["kernel"])
    draw_training(right, figures["training"], figures["training_threads"])
    for axes in (left, right):
        axes.grid(True, which="major", color="#e3e6ea", lw=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    found = figures["machine"]
    where = f"{found['processor']}, {found['cores']} cores, {found['isa']}; CPU time of this process"
    figure.supxlabel(where, fontsize=8, color="#5c6670")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def draw_kernel(axes, kernel: dict[str, Any] | None) -> None:
    """Errors over time, both logarithmic: left is faster, lower is more exact."""
    from rtgs.report.figures import SERIES_COLORS

    width, height = kernel["image"] if kernel else (0, 0)
    axes.set_title("Rasteriser: forward + backward, 1 thread", loc="left", fontsize=11)
    axes.set_xlabel(f"CPU ms ({kernel['surfels']:,} surfels, {width}x{height}, 12 channels)" if kernel else "CPU ms")
    axes.set_ylabel("error against float64, relative to the largest value")
    if not kernel:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center")
        return
    paths = {name: values for name, values in kernel["paths"].items() if "picture_worst" in values}
    kinds = (("picture_worst", "o", "picture, worst pixel"), ("gradient_worst", "s", "gradient, worst element"))
    for color, (key, marker, label) in zip(SERIES_COLORS, kinds):
        times = [values["ms"] for values in paths.values()]
        axes.plot(times, [v[key] for v in paths.values()], marker, color=color, ms=7, label=label)
    for name, values in paths.items():
        pair = (values["picture_worst"], values["gradient_worst"])
        axes.plot([values["ms"]] * 2, pair, color="#b8bfc6", lw=1, zorder=1)
        axes.annotate(
            name.replace("_", " "),
            (values["ms"], max(pair)),
            (0, 8),
            textcoords="offset points",
            ha="center",
            fontsize=9,
        )
    axes.axhline(PICTURE_BOUND, color=SERIES_COLORS[0], ls=":", lw=1.2, label="bound, 99.9 % of pixels")
    axes.axhline(GRADIENT_BOUND, color=SERIES_COLORS[1], ls=":", lw=1.2, label="bound, gradients")
    exact = kernel["paths"]["twin_float64"]["ms"]
    axes.axvline(exact, color="#7c8794", ls="--", lw=1)
    axes.annotate(
        "float64 twin",
        (exact, 0.03),
        (-4, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        rotation=90,
        ha="right",
        fontsize=8,
        color="#5c6670",
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.12)
    axes.set_ylim(1e-7, 1e-3)
    axes.legend(frameon=False, fontsize=8, loc="upper center", ncols=2)


def draw_training(axes, points: list[dict[str, Any]], threads: int) -> None:
    """PSNR over CPU seconds: one line per scene and per thing that is turned."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    from rtgs.report.figures import SERIES_COLORS

    axes.set_title("Training from preset quick: quality for time", loc="left", fontsize=11)
    axes.set_xlabel(f"training, CPU seconds ({threads} thread{'s' if threads > 1 else ''})")
    axes.set_ylabel("PSNR of held-out views, dB")
    if not points:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center")
        return
    for index, scene in enumerate(dict.fromkeys(point["scene"] for point in points)):
        color = SERIES_COLORS[index % len(SERIES_COLORS)]
        own = [point for point in points if point["scene"] == scene]
        most_steps, most_cap = (max(point[key] for point in own) for key in ("steps", "cap"))
        by_cap = sorted((p for p in own if p["steps"] == most_steps), key=lambda p: p["cap"])
        by_steps = sorted((p for p in own if p["cap"] == most_cap), key=lambda p: p["steps"])
        lines = (
            (by_cap, "o-", f"{scene}: cap on surfels, {most_steps:,} steps", lambda p: f"{p['cap'] / 1000:g}k", (0, 8)),
            (by_steps, "s--", f"{scene}: steps, cap {most_cap / 1000:g}k", lambda p: f"{p['steps']:,} steps", (0, -14)),
        )
        for line, style, label, name, offset in lines:
            x, y = [p["cpu_seconds"] for p in line], [p["psnr"] for p in line]
            axes.plot(
                x,
                y,
                style,
                color=color,
                ms=6,
                lw=1.5,
                label=label,
                markerfacecolor="white" if style == "s--" else color,
            )
            for point in line:
                at = (point["cpu_seconds"], point["psnr"])
                axes.annotate(name(point), at, offset, textcoords="offset points", ha="center", fontsize=8, color=color)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.margins(x=0.1, y=0.16)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
