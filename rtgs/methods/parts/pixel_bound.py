"""No more Gaussians than the pixels of a view can tell apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rtgs.core.decisions import Decision
from rtgs.gaussians.settings import DensitySettings
from rtgs.methods.settings import MethodSettings


def within_pixels(density: DensitySettings, pixels: int) -> DensitySettings:
    """The settings with the cap that ``max_per_pixel`` allows in views of so many pixels."""
    if density.max_per_pixel is None:
        return density
    return replace(density, max_surfels=min(density.max_surfels, max(1, round(density.max_per_pixel * pixels))))


def bound_by_pixels(settings: MethodSettings, pixels: int) -> tuple[MethodSettings, tuple[Decision, ...]]:
    """The settings with the caps of all sets bounded, and what was lowered.

    Args:
        settings: as composed.
        pixels: of the largest training view.
    """
    reflection, transmittance = settings.reflection, settings.transmittance
    bounded = replace(
        settings,
        density=within_pixels(settings.density, pixels),
        reflection=replace(reflection, density=within_pixels(reflection.density, pixels)),
        transmittance=replace(transmittance, density=within_pixels(transmittance.density, pixels)),
    )
    return bounded, tuple(_lowered(settings, bounded, pixels))


def _lowered(before: MethodSettings, after: MethodSettings, pixels: int) -> Iterator[Decision]:
    pairs = {
        "density": (before.density, after.density),
        "reflection.density": (before.reflection.density, after.reflection.density),
        "transmittance.density": (before.transmittance.density, after.transmittance.density),
    }
    for name, (asked, used) in pairs.items():
        if used.max_surfels < asked.max_surfels:
            what = f"cap of {used.max_surfels:,} instead of {asked.max_surfels:,} ({name})"
            yield Decision(what, f"a view has {pixels:,} pixels, and max_per_pixel is {asked.max_per_pixel:g}")
