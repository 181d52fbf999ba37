"""Optics: what a surface does with the light of one mirror ray and of one straight ray (docs/optics.md)."""
