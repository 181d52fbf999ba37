"""Radiance split at the first surface a ray meets: reflected, transmitted and the rest, from the same samples.

At a specular first surface (thin or solid glass, mirror, glossy coat) the specular reflection and the rest are *both*
followed, each with its own weight (for glass: Fresnel reflectance F and 1 - F) instead of one chosen at random. The sum
of the layers is the unbiased image by construction, and the choice, the largest source of noise on glass, is gone.
Behind the first surface the integrator goes on as usual.

The same straight-line code runs in Mitsuba's scalar variant (one ray) and in the vectorised ones (a wavefront of rays).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LightLayers:
    """Linear radiance times exposure, (H, W, 3) float32 each; their sum is the image."""

    diffuse: NDArray[np.float32]  # what is neither of the two below: matte light, lamps, the sky
    reflected: NDArray[np.float32]  # leaves the first surface by specular reflection
    transmitted: NDArray[np.float32]  # comes through the first surface

    @property
    def image(self) -> NDArray[np.float32]:
        """(H, W, 3) linear light, not clipped."""
        return self.diffuse + self.reflected + self.transmitted

    @staticmethod
    def mean(renders: list[LightLayers]) -> LightLayers:
        """Independent renders of one view as one."""
        diffuse, reflected, transmitted = (
            np.mean([getattr(layers, name) for layers in renders], axis=0)
            for name in ("diffuse", "reflected", "transmitted")
        )
        return LightLayers(diffuse, reflected, transmitted)


class FirstSurface:
    """Follows rays of one scene; ``mi`` is Mitsuba in the variant the scene was loaded in."""

    def __init__(self, mi: Any, scene: Any, integrator: Any) -> None:
        import drjit

        flags = mi.BSDFFlags
        self.mi, self.dr, self.scene, self.integrator = mi, drjit, scene, integrator
        self.scalar = "scalar" in mi.variant()
        self.reflecting = int(flags.DeltaReflection) | int(flags.GlossyReflection)
        self.passing = int(flags.DeltaTransmission) | int(flags.GlossyTransmission) | int(flags.Null)
        self.rest = (int(flags.All) | int(flags.Null)) & ~self.reflecting
        self.smooth = int(flags.Smooth)

    def layers(self, ray: Any, sampler: Any) -> tuple[Any, Any, Any]:
        """(diffuse, reflected, transmitted) radiance along ``ray``, ``Color3f`` each; numbers from ``sampler``."""
        zero = self.mi.Color3f(0.0)
        si = self.scene.ray_intersect(ray)
        bsdf = si.bsdf(ray) if not self.scalar or si.is_valid() else None
        if bsdf is None:
            return self.radiance(ray, sampler, True), zero, zero
        flags = bsdf.flags()
        specular = si.is_valid() & ((flags & self.reflecting) != 0)
        passing = (flags & self.passing) != 0
        plain = self.radiance(ray, sampler, specular == False)  # noqa: E712 - scalar bool or vector mask
        reflected = self._component(si, bsdf, self.reflecting, sampler, specular)
        other = self._component(si, bsdf, self.rest, sampler, specular)
        emitted = self._emission(si, specular)
        through = self.dr.select(passing, other, zero)
        return plain + emitted + (other - through), reflected, through

    def _component(self, si: Any, bsdf: Any, types: int, sampler: Any, active: Any) -> Any:
        """Light that leaves ``si`` against the ray by the lobes of ``types``: emitter and BSDF sampling, weighted by
        the power heuristic (Veach 1997, 9.2.2), and whatever lies further along the sampled direction."""
        mi, dr = self.mi, self.dr
        if active is False:
            return mi.Color3f(0.0)
        context = mi.BSDFContext(mi.TransportMode.Radiance, types, 0xFFFFFFFF)
        direct = self._emitter_sampled(si, bsdf, context, sampler, active)
        drawn, weight = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
        active = active & dr.any(weight != 0)
        if active is False:
            return direct
        ray = si.spawn_ray(si.to_world(drawn.wo))
        after = self.scene.ray_intersect(ray, active)
        emitted = self._emission(after, active)
        chance = self._emitter_density(si, after, active)
        delta = (drawn.sampled_type & mi.BSDFFlags.Delta.value) != 0
        share = dr.select(delta, 0.0, _power(chance, drawn.pdf))
        total = self.radiance(ray, sampler, active)  # counts the emission at ``after`` in full
        return direct + dr.select(active, weight * (total - emitted * share), 0.0)

    def _emitter_sampled(self, si: Any, bsdf: Any, context: Any, sampler: Any, active: Any) -> Any:
        mi, dr = self.mi, self.dr
        number = sampler.next_2d(active)
        active = active & ((bsdf.flags() & self.smooth & int(context.type_mask)) != 0)
        if active is False:
            return mi.Color3f(0.0)
        drawn, weight = self.scene.sample_emitter_direction(si, number, True, active)
        active = active & (drawn.pdf != 0)
        value, density = bsdf.eval_pdf(context, si, si.to_local(drawn.d), active)
        share = dr.select(drawn.delta, 1.0, _power(drawn.pdf, density))
        return dr.select(active, value * weight * share, 0.0)

    def _emitter_density(self, si: Any, after: Any, active: Any) -> Any:
        """Solid-angle density with which emitter sampling would have drawn the direction from ``si`` to ``after``."""
        if self.scalar and after.emitter(self.scene) is None:
            return 0.0
        sample = self.mi.DirectionSample3f(self.scene, after, si)
        return self.scene.pdf_emitter_direction(si, sample, active)

    def _emission(self, si: Any, active: Any) -> Any:
        """Light that ``si`` itself sends against the ray."""
        if active is False:
            return self.mi.Color3f(0.0)
        emitter = si.emitter(self.scene)
        return self.mi.Color3f(0.0) if emitter is None else emitter.eval(si, active)

    def radiance(self, ray: Any, sampler: Any, active: Any) -> Any:
        if active is False:
            return self.mi.Color3f(0.0)
        return self.integrator.sample(self.scene, sampler, ray, None, active)[0]


def _power(one: Any, other: Any) -> Any:
    """Power heuristic one^2 / (one^2 + other^2) for densities of which ``one`` is positive where it matters."""
    import drjit as dr

    ratio = other / dr.maximum(one, 1e-20)
    return dr.select(one > 0, 1.0 / (1.0 + ratio * ratio), 0.0)
