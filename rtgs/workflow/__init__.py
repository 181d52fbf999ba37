"""Cached pipeline steps: a pure graph of recipes, a content-addressed store, a plan, and an executor."""

from rtgs.core.recipe import NOT_IN_RECIPE
from rtgs.workflow.artifacts import Artifacts
from rtgs.workflow.executors import Executor, InlineExecutor, StepResult
from rtgs.workflow.outcome import StepOutcome, StepUnfinished, SweepOutcomes
from rtgs.workflow.plan import Plan, PlannedStep, make_plan, topological
from rtgs.workflow.remote import RemoteStore, RemoteStoreError
from rtgs.workflow.step import Step, StepContext, StepFailed, StepKind
from rtgs.workflow.store import Artifact, Store

__all__ = [
    "NOT_IN_RECIPE",
    "Artifact",
    "Artifacts",
    "Executor",
    "InlineExecutor",
    "Plan",
    "PlannedStep",
    "RemoteStore",
    "RemoteStoreError",
    "Step",
    "StepContext",
    "StepFailed",
    "StepKind",
    "StepOutcome",
    "StepResult",
    "StepUnfinished",
    "Store",
    "SweepOutcomes",
    "make_plan",
    "topological",
]
