"""The plot of ``benchmarks.speed.speed_error``: error over time of the kernels, quality over time of training."""

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
    times = [values["ms"] for values in paths.values()]
    kinds = (("picture", "o", PICTURE_BOUND), ("gradient", "s", GRADIENT_BOUND))
    for color, (kind, marker, bound) in zip(SERIES_COLORS, kinds):
        for part, fill, label in (("999", color, "99.9 % are within"), ("worst", "white", "worst")):
            errors = [values[f"{kind}_{part}"] for values in paths.values()]
            axes.plot(times, errors, marker, color=color, markerfacecolor=fill, ms=7, label=f"{kind}, {label}")
        axes.axhline(bound, color=color, ls=":", lw=1.2, zorder=1)
        axes.annotate(
            f"bound of the tests, {kind}s",
            (0.5, bound),
            (0, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=color,
        )
    for index, (name, values) in enumerate(paths.items()):
        errors = [values[f"{kind}_{part}"] for kind in ("picture", "gradient") for part in ("999", "worst")]
        axes.plot([values["ms"]] * 2, (min(errors), max(errors)), color="#b8bfc6", lw=1, zorder=1)
        native = not name.startswith("twin")
        axes.annotate(
            f"{name.replace('_', ' ')}, {_duration(values['ms'])}",
            (values["ms"], max(errors)),
            (-4 if native else 8, 8 + 14 * max(0, 2 - index)),  # native paths lie close together
            textcoords="offset points",
            ha="left" if native else "right",
            fontsize=8.5,
        )
    exact = kernel["paths"]["twin_float64"]["ms"]
    axes.axvline(exact, color="#7c8794", ls="--", lw=1)
    axes.annotate(
        f"float64 twin, {_duration(exact)}",
        (exact, 0.2),
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
    axes.set_ylim(1e-8, 1e-2)
    axes.legend(frameon=False, fontsize=8, loc="lower center", ncols=2)


def _duration(ms: float) -> str:
    return f"{ms / 1000:.1f} s" if ms >= 1000 else f"{ms:.1f} ms"


def draw_training(axes, points: list[dict[str, Any]], threads: int) -> None:
    """PSNR over CPU seconds: one line per scene and per thing that is turned."""
    from matplotlib.ticker import FuncFormatter, LogLocator

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
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.margins(x=0.1, y=0.16)
    axes.legend(frameon=False, fontsize=8, loc="upper left")
