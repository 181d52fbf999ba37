"""RT-GS to its second stage: the diffuse base set, then reflection with the microfacet weight (methods.md 6.2)."""

from __future__ import annotations

from rtgs.methods.reflective import ReflectiveMethod


class RtGs(ReflectiveMethod):
    """RT-GS up to the point where transmittance starts; its numbers are in conf/method/rtgs."""
