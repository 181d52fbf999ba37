"""Cached pipeline steps: a pure graph of recipes, a content-addressed store, a plan, and an executor."""

from rtgs.pipeline.executors import Executor, InlineExecutor, StepResult
from rtgs.pipeline.fingerprint import NOT_IN_RECIPE
from rtgs.pipeline.outcome import StepOutcome, StepUnfinished, SweepOutcomes
from rtgs.pipeline.plan import Plan, PlannedStep, make_plan, topological
from rtgs.pipeline.remote import RemoteStore, RemoteStoreError
from rtgs.pipeline.step import Step, StepContext, StepFailed, StepKind
from rtgs.pipeline.store import Artifact, Store

__all__ = [
    "NOT_IN_RECIPE",
    "Artifact",
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
