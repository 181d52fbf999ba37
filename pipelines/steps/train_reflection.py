"""The second stage of methods with reflection: base set with materials and the traced reflection set, jointly."""

from __future__ import annotations

from pipelines.steps.training import StageParams, train_stage
from rtgs.workflow import StepContext, StepKind


def train_reflection(params: StageParams, context: StepContext) -> None:
    """Go on from the diffuse stage with reflection (:func:`pipelines.steps.training.train_stage`)."""
    train_stage(params, context)


STEP = StepKind("train_reflection", 3, train_reflection)
