"""One stage of a method on a scene: the one kind of step that trains, whatever the method."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.extract_mesh import why_absent
from pipelines.steps.training import train_stage
from rtgs.core.files import sha256_of
from rtgs.methods import MethodSpec, StageSpec, find_method, is_own, own_methods
from rtgs.runs.training import StageParams, last_training, load_method
from rtgs.train.networks import Named, check_networks, named_in_key
from rtgs.workflow import Step, StepContext, StepKind
from rtgs.workflow.fingerprint import fingerprint

if TYPE_CHECKING:
    from rtgs.evaluate.boundary import BoundaryScores

MESH_STEP = "extract_mesh"


def train(params: StageParams, context: StepContext) -> None:
    """Train one stage, going on from the stage before it where there is one.

    Writes what :func:`pipelines.steps.training.train_stage` writes. With the mesh of a transparent object among its
    inputs also ``object_mesh/`` (a copy of it: whoever loads the method needs this artifact alone) and
    ``boundary.json``: how well the object's surface is known where the stage begins and where it ends
    (:class:`rtgs.evaluate.boundary.BoundaryScores`). Where there is no transparent object after all, the stage before
    goes on to the end, bit for bit as in a run without this one, and there is neither.

    Raises:
        MissingWeights: the recipe names a network of the perceptual loss that is not on this machine.
        WrongWeights: the networks here are others than those that the recipe names.
        TrainingDiverged: a loss or gradient is not finite.
    """
    check_networks(params.method.loss, context.tools)
    if MESH_STEP not in context.inputs:
        train_stage(params, context)
    elif why := why_absent(context.inputs[MESH_STEP]):
        context.log.info("no %s stage, the one before goes on: %s", params.stage, why)
        train_stage(_without_object(params), context)
    else:
        _train_with_object(params, context)


def _train_with_object(params: StageParams, context: StepContext) -> None:
    from rtgs.evaluate.boundary import BoundaryRecord, boundary_scores
    from rtgs.mesh.container import read_object_mesh
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    mesh = read_object_mesh(context.inputs[MESH_STEP])
    before, stage = load_method(last_training(context.inputs), scene)
    at_start = boundary_scores(before, scene, mesh, stage.until)
    del before
    method = train_stage(params, context, mesh)
    record = BoundaryRecord(at_start, boundary_scores(method, scene, mesh, params.until))
    record.write(context.out)
    for when, values in vars(record).items():
        context.log.info("%s the %s stage: %s", when, params.stage, values)
        context.tracker.metrics(_numbers(values, when))


def _without_object(params: StageParams) -> StageParams:
    """Those of the stage before, lasting as long as the whole run; it is met on its way, at ``params.from_step``."""
    spec = find_method(params.method.name)
    before = spec.before(params.stage, params.method, params.schedule)
    own = spec.stage(before.name).reads(params.method)
    return replace(params, method=own, stage=before.name, from_step=before.from_step)


def _numbers(scores: BoundaryScores, when: str) -> dict[str, float]:
    return {f"boundary/{when}/{name}": value for name, value in vars(scores).items() if isinstance(value, float)}


def kind_of(stage: StageSpec) -> StepKind:
    """The step that trains a stage: ``train_<name>``, with the stage's version."""
    return StepKind(f"train_{stage.name}", stage.version, train)


def train_step(
    spec: MethodSpec, params: StageParams, *upstream: Step, networks: Named = (), name: str | None = None
) -> Step:
    """The step of one stage of a method.

    ``networks``: (name, digest) of the pretrained files that are on this machine; those that the perceptual loss reads
    belong to the recipe. So does the source of a method from outside: no review of this project asks for a new version
    when it changes. ``name``: of the step, where it is not that of the stage.
    """
    tools = named_in_key(params.method.loss, networks)
    if not is_own(spec):
        tools = (*tools, (f"method {spec.name}", _source_digest(spec)))
    return kind_of(spec.stage(params.stage)).step(params, *upstream, name=name, tools=tools)


def _source_digest(spec: MethodSpec) -> str:
    """SHA-256 over the files of the method's functions: what composes it, when its stages start, what they read."""
    functions = [spec.build, *(each for stage in spec.stages for each in (stage.start, stage.reads, stage.on))]
    whole = (inspect.unwrap(getattr(each, "func", each)) for each in functions)
    outside = (each for each in whole if each.__module__.split(".")[0] != "rtgs")  # those of rtgs have versions
    files = sorted({file for each in outside if (file := inspect.getsourcefile(each)) is not None})
    return fingerprint([sha256_of(Path(file)) for file in files])


def training_kinds(specs: Iterable[MethodSpec] | None = None) -> tuple[StepKind, ...]:
    """The kinds of the stages of these methods (default: those of this package), each once."""
    stages = (stage for spec in (own_methods() if specs is None else specs) for stage in spec.stages)
    return tuple({kind.name: kind for kind in map(kind_of, stages)}.values())
