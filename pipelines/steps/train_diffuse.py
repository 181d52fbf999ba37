"""The first stage of every surfel method: the diffuse base set, rasterised."""

from __future__ import annotations

from pipelines.steps.training import StageParams, train_stage
from rtgs.workflow import StepContext, StepKind


def train_diffuse(params: StageParams, context: StepContext) -> None:
    """Train the base set on the scene (:func:`pipelines.steps.training.train_stage`)."""
    train_stage(params, context)


STEP = StepKind(
    "train_diffuse",
    5,
    train_diffuse,
    helpers=(
        "pipelines.steps.training",
        "rtgs.methods.surfel_base",
        "rtgs.methods.gs3d",
        "rtgs.methods.surfel_set",
        "rtgs.train.trainer",
        "rtgs.train.schedule",
        "rtgs.train.view_order",
        "rtgs.train.losses",
        "rtgs.gaussians.adam",
        "rtgs.gaussians.initialize",
        "rtgs.gaussians.density",
        "rtgs.gaussians.mcmc",
        "rtgs.gaussians.primitives",
        "rtgs.gaussians.activate",
        "rtgs.gaussians.ply",
        "rtgs.render.surfels",
        "rtgs.render.ellipsoids",
        "rtgs.native",
    ),
)
