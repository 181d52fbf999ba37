"""One stage of a method on a scene: the one kind of step that trains, whatever the method."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.extract_mesh import why_absent
from pipelines.steps.pictures import FOLDER as PICTURES
from pipelines.steps.training import train_stage, training_before
from rtgs.core.files import sha256_of
from rtgs.evaluate.judgement import JudgeRecord
from rtgs.methods import MethodSpec, StageSpec, find_method, is_own, own_methods
from rtgs.runs.mixture import JUDGE, PLAIN
from rtgs.runs.training import HISTORY_FILE, StageParams, last_training, load_method
from rtgs.train.networks import Named, check_networks, named_in_key
from rtgs.workflow import Step, StepContext, StepKind
from rtgs.workflow.fingerprint import fingerprint
from rtgs.workflow.manifest import NAME as MANIFEST

if TYPE_CHECKING:
    from rtgs.evaluate.boundary import BoundaryScores
    from rtgs.mesh.container import ObjectMesh
    from rtgs.scenes.scene import Scene

MESH_STEP = "extract_mesh"


def train(params: StageParams, context: StepContext) -> None:
    """Train one stage, going on from the stage before it where there is one.

    Writes what :func:`pipelines.steps.training.train_stage` writes. With the mesh of a transparent object among its
    inputs also ``object_mesh/`` (a copy of it: whoever loads the method needs this artifact alone) and
    ``boundary.json``: how well the object's surface is known where the stage begins and where it ends
    (:class:`rtgs.evaluate.boundary.BoundaryScores`). Where there is no transparent object after all, the stage before
    goes on to the end, bit for bit as in a run without this one, and there is neither. After a judge that shows nothing
    of the method it is not trained further: the state in which it was judged is written. Of a method that is shown,
    what follows a judge is trained on the held-out views as well.

    Raises:
        MissingWeights: the recipe names a network of the perceptual loss that is not on this machine.
        WrongWeights: the networks here are others than those that the recipe names.
        TrainingDiverged: a loss or gradient is not finite.
    """
    check_networks(params.method.loss, context.tools)
    if _is_dropped(context.inputs):
        _end_here(params, context)
    elif MESH_STEP not in context.inputs:
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
    earlier = BoundaryRecord.read(last_training(context.inputs)) if params.joined else None  # of the same stage
    at_start = _scores_before(context.inputs, scene, mesh) if earlier is None else earlier.before
    method = train_stage(params, context, mesh)
    record = BoundaryRecord(at_start, boundary_scores(method, scene, mesh, params.until))
    record.write(context.out)
    for when, values in vars(record).items():
        context.log.info("%s the %s stage: %s", when, params.stage, values)
        context.tracker.metrics(_numbers(values, when))


def _scores_before(inputs: Mapping[str, Path], scene: Scene, mesh: ObjectMesh) -> BoundaryScores:
    """Of the method at the end of the stage before."""
    from rtgs.evaluate.boundary import boundary_scores

    method, stage = load_method(last_training(inputs), scene)
    return boundary_scores(method, scene, mesh, stage.until)


def _is_dropped(inputs: Mapping[str, Path]) -> bool:
    """Whether a judge among the inputs of a training shows nothing of its method."""
    if JUDGE not in inputs:
        return False
    return not JudgeRecord.read(inputs[JUDGE]).shows("plain" if PLAIN in inputs else "full")


def _end_here(params: StageParams, context: StepContext) -> None:
    """The state in which the method was judged is the end of its training."""
    before = training_before(context.inputs)
    assert before is not None  # the judge has seen it
    context.log.info("%s is not trained after step %d: no region shows it", params.method.name, params.joined)
    told = shutil.ignore_patterns(MANIFEST, HISTORY_FILE, PICTURES)  # with the step that made them
    shutil.copytree(before, context.out, ignore=told, copy_function=shutil.copyfile, dirs_exist_ok=True)
    (context.out / HISTORY_FILE).touch()


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
