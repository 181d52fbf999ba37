"""RT-GS, first stage: the diffuse base set, trained with EnvGS's numbers (methods.md 6.1, 6.2)."""

from __future__ import annotations

from rtgs.methods.surfel_base import SurfelMethod


class RtGs(SurfelMethod):
    """RT-GS up to the point where reflection starts: base set only; losses rgb, normal and monocular normal."""
