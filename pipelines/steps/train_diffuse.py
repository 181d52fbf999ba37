"""The first stage of every surfel method: the diffuse base set, rasterised."""

from __future__ import annotations

from pipelines.steps.training import StageParams, train_stage
from rtgs.workflow import StepContext, StepKind


def train_diffuse(params: StageParams, context: StepContext) -> None:
    """Train the base set on the scene (:func:`pipelines.steps.training.train_stage`)."""
    train_stage(params, context)


STEP = StepKind("train_diffuse", 5, train_diffuse)
