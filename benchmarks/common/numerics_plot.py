"""The plot of ``benchmarks.quality.numerics``: error over the factor, a panel for each strain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.common.stress_scenes import AXES

COLUMNS = 5


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """One PNG; lines are worst errors, pictures solid and gradients dashed, a colour for each path."""
    from matplotlib.figure import Figure

    from rtgs.report.figures import SERIES_COLORS

    axes_named = list(dict.fromkeys(row["axis"] for row in rows))
    paths = list(dict.fromkeys(row["path"] for row in rows))
    columns = min(COLUMNS, len(axes_named))
    lines = -(-len(axes_named) // columns)
    figure = Figure(figsize=(3.1 * columns + 0.6, 2.9 * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).flatten()
    for panel in panels[len(axes_named) :]:
        panel.set_visible(False)
    for panel, name in zip(panels, axes_named):
        for path_name, color in zip(paths, SERIES_COLORS):
            found = [row for row in rows if (row["axis"], row["path"]) == (name, path_name)]
            values = [row["value"] for row in found]
            for kind, style in (("picture", "-"), ("gradient", "--")):
                errors = [max(row[f"{kind}_worst"], 1e-9) for row in found]
                panel.plot(values, errors, style, marker="o", ms=3, lw=1.2, color=color, label=f"{path_name}, {kind}s")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_ylim(5e-9, 2)
        panel.set_xlabel(AXES[name].label, fontsize=8)
        panel.set_title(name, loc="left", fontsize=10)
        panel.grid(True, color="#e3e6ea", lw=0.8)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("worst error against float64", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
