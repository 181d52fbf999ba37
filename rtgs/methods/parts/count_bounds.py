"""No more Gaussians than the pixels of a view can tell apart, or than the capture's points have support for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from rtgs.core.decisions import Decision
from rtgs.gaussians.settings import DensitySettings
from rtgs.methods.settings import MethodSettings


@dataclass(frozen=True)
class SceneCounts:
    """What of a scene bounds the number of Gaussians."""

    pixels: int  # of the largest training view
    points: int | None  # that several photos agree on; None: Gaussians do not start from the scene's points

    def bounds(self, density: DensitySettings) -> Iterator[tuple[int, str]]:
        """The caps that the settings ask for in this scene, and why."""
        if density.max_per_pixel is not None:
            why = f"a view has {self.pixels:,} pixels, and max_per_pixel is {density.max_per_pixel:g}"
            yield max(1, round(density.max_per_pixel * self.pixels)), why
        if density.max_per_point is not None and self.points is not None:
            why = f"the scene has {self.points:,} points, and max_per_point is {density.max_per_point:g}"
            yield max(1, round(density.max_per_point * self.points)), why

    def within(self, density: DensitySettings) -> DensitySettings:
        """The settings with the lowest of the caps."""
        return replace(density, max_surfels=min((density.max_surfels, *(cap for cap, _ in self.bounds(density)))))


def bound_counts(settings: MethodSettings, counts: SceneCounts) -> tuple[MethodSettings, tuple[Decision, ...]]:
    """The settings with the caps of all sets bounded, and what was lowered."""
    reflection, transmittance = settings.reflection, settings.transmittance
    bounded = replace(
        settings,
        density=counts.within(settings.density),
        reflection=replace(reflection, density=counts.within(reflection.density)),
        transmittance=replace(transmittance, density=counts.within(transmittance.density)),
    )
    return bounded, tuple(_lowered(settings, bounded, counts))


def _lowered(before: MethodSettings, after: MethodSettings, counts: SceneCounts) -> Iterator[Decision]:
    pairs = {
        "density": (before.density, after.density),
        "reflection.density": (before.reflection.density, after.reflection.density),
        "transmittance.density": (before.transmittance.density, after.transmittance.density),
    }
    for name, (asked, used) in pairs.items():
        if used.max_surfels < asked.max_surfels:
            what = f"cap of {used.max_surfels:,} instead of {asked.max_surfels:,} ({name})"
            yield Decision(what, min(counts.bounds(asked))[1])
