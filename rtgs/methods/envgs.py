"""EnvGS (Xie et al. 2025; method.md 6.1, 12): base set and environment set, one mirror ray, weight 1."""

from __future__ import annotations

from rtgs.methods.reflective import ReflectiveMethod


class EnvGs(ReflectiveMethod):
    """EnvGS is RT-GS's second stage with ``optics.weight: envgs``; its numbers are in conf/method/envgs."""
