"""The second stage of methods with reflection: base set with materials and the traced reflection set, jointly."""

from __future__ import annotations

from pipelines.steps import train_diffuse
from pipelines.steps.training import StageParams, train_stage
from rtgs.workflow import StepContext, StepKind


def train_reflection(params: StageParams, context: StepContext) -> None:
    """Go on from the diffuse stage with reflection (:func:`pipelines.steps.training.train_stage`)."""
    train_stage(params, context)


STEP = StepKind(
    "train_reflection",
    3,
    train_reflection,
    helpers=(
        *train_diffuse.STEP.helpers,
        "rtgs.methods.reflective",
        "rtgs.methods.reflection_set",
        "rtgs.methods.traced_set",
        "rtgs.methods.mirror",
        "rtgs.methods.traced_pixels",
        "rtgs.methods.propagation",
        "rtgs.methods.matte",
        "rtgs.gaussians.materials",
        "rtgs.optics.microfacet",
        "rtgs.optics.split_sum",
        "rtgs.render.trace",
    ),
)
