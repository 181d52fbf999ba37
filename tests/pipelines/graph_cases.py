"""Graphs of runs from their words, and what identifies their steps."""

from __future__ import annotations

from pipelines.planning.graph import RunGraph, build_graph
from rtgs.config import compose
from rtgs.workflow import topological

PLAIN = ("scene=toycar", "method=3dgs", "preset=smoke")
GLASS = ("scene=ball_statue", "method=rtgs", "preset=smoke")


def graph(*words: str) -> RunGraph:
    return build_graph(*compose(words))


def keys(found: RunGraph) -> dict[str, str]:
    """Without the report, whose text has all words."""
    return {step.name: step.fingerprint for step in topological(found.targets) if step.name != "report"}
