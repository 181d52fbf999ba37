"""The gain of a mirror ray over angle and roughness: ``python -m lab.optics_gain [PNG]``.

What multiplies the traced colour, w_r, for f0 = 0.04 and f0 = 0.5, and each weight that can be chosen. Draws the plot
of docs/optics.md (default ``docs/images/optics_gain.png``); last line: a JSON object with the largest gains.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rtgs.optics.microfacet import specular_weights
from rtgs.optics.settings import OpticsSettings

SHOWN = {
    "S_max 16": OpticsSettings(max_gain=16.0),
    "S_max 1": OpticsSettings(max_gain=1.0),
    "no bound": OpticsSettings(max_gain=0.0),
    "literal": OpticsSettings(weight="literal"),
    "split sum": OpticsSettings(weight="split_sum"),
}
F0 = (0.04, 0.5)
ROUGHNESS = (0.001, 0.005, 0.02, 0.1, 0.5)


def gain(degrees: np.ndarray, roughness: float, f0: float, optics: OpticsSettings) -> np.ndarray:
    """w_r at angles of incidence (P,) in degrees."""
    cosine = torch.from_numpy(np.cos(np.radians(degrees)))
    alpha, reflectance = torch.full_like(cosine, roughness), torch.full_like(cosine, f0)
    return specular_weights(cosine, alpha, reflectance, optics).reflection.numpy()


def largest(optics: OpticsSettings, f0: float) -> float:
    """The largest w_r over all angles and roughnesses."""
    degrees = np.linspace(0, 90, 181)
    return max(float(gain(degrees, alpha, f0, optics).max()) for alpha in np.geomspace(1e-3, 1, 61))


def draw(path: Path) -> None:
    """Left two panels: the default over the angle; right: every weight at one roughness."""
    from matplotlib.figure import Figure

    from rtgs.report.figures import SERIES_COLORS

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    degrees = np.linspace(0, 89.9, 400)
    for axes, f0 in zip(panels, F0):
        for color, alpha in zip(SERIES_COLORS, ROUGHNESS):
            axes.plot(degrees, gain(degrees, alpha, f0, OpticsSettings()), color=color, label=f"roughness {alpha:g}")
        axes.set_title(f"Default (S_max {OpticsSettings().max_gain:g}), f0 = {f0:g}", loc="left", fontsize=11)
    for color, (name, optics) in zip(SERIES_COLORS, SHOWN.items()):
        panels[2].plot(degrees, gain(degrees, 0.005, 0.04, optics), color=color, label=name)
    panels[2].set_title("Every weight, f0 = 0.04, roughness 0.005", loc="left", fontsize=11)
    for axes in panels:
        axes.axhline(1, color="#7c8794", lw=1, ls=":")
        axes.set(yscale="log", ylim=(1e-3, 100), xlim=(0, 90), xlabel="angle of incidence, degrees", ylabel="w_r")
        axes.legend(fontsize=8, frameon=False)
        axes.grid(True, which="major", color="#e3e6ea", lw=0.8)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("png", nargs="?", type=Path, default=Path("docs/images/optics_gain.png"))
    path = parser.parse_args().png
    draw(path)
    sweep = {
        f"S_max {bound:g}": replace(OpticsSettings(), max_gain=bound) for bound in (1.0, 2.0, 4.0, 8.0, 16.0, 64.0)
    }
    figures = {name: {f"f0 {f0:g}": round(largest(optics, f0), 3) for f0 in F0} for name, optics in sweep.items()}
    print(json.dumps({"plot": str(path), "largest_gain": figures}))


if __name__ == "__main__":
    main()
