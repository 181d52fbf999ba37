"""RT-GS: the diffuse base set, then reflection with the microfacet weight, then transmittance (method.md 6.2)."""

from __future__ import annotations

from rtgs.methods.transmittance import TransmissiveMethod


class RtGs(TransmissiveMethod):
    """RT-GS; its numbers are in conf/method/rtgs."""
