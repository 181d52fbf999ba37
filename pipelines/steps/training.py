"""What the training steps share: parameters, the run of one stage, and reading a trained method back."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.build import build
from rtgs.core.documents import DocumentError, parse_json
from rtgs.core.errors import RtgsError
from rtgs.core.records import read_json, record_of, write_json
from rtgs.methods.settings import MethodSettings
from rtgs.track import Tracker
from rtgs.train.settings import ScheduleSettings
from rtgs.workflow import StepContext
from rtgs.workflow.manifest import Manifest

if TYPE_CHECKING:
    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene
    from rtgs.train.trainer import TrainSummary

CHECKPOINT_FOLDER = "checkpoint"
SUMMARY_FILE = "summary.json"
HISTORY_FILE = "history.jsonl"
OBJECT_FOLDER = "object_mesh"


@dataclass(frozen=True)
class StageParams:
    """One stage of a training: the recipe, the seed, and which stretch of steps."""

    method: MethodSettings
    schedule: ScheduleSettings
    seed: int
    stage: str
    from_step: int
    until: int


def train_stage(params: StageParams, context: StepContext, object_mesh: ObjectMesh | None = None) -> Model:
    """Train from ``from_step`` to ``until`` on the scene, going on from a checkpoint of a killed attempt.

    Writes ``checkpoint/`` (state of the method at the end), ``<set>.ply`` for every set of surfels, ``summary.json``,
    ``history.jsonl`` (the recorded metrics), ``pictures/`` of fixed views where the training is long enough, and with
    an ``object_mesh`` a copy of it in ``object_mesh/``. Returns the trained method.

    Raises:
        TrainingDiverged: a loss or gradient is not finite.
    """
    from pipelines.steps.pictures import FOLDER, TrainingPictures
    from rtgs.gaussians.ply import write_ply
    from rtgs.mesh.container import write_object_mesh
    from rtgs.methods import Stage, create_method
    from rtgs.scenes.canonical import read_scene
    from rtgs.train.progress import progress_for
    from rtgs.train.seeds import generator_for
    from rtgs.train.trainer import Trainer

    scene = context.read("import_scene", read_scene)
    generator = generator_for(params.seed, "initialise")
    method = create_method(params.method, scene, params.schedule, generator, object_mesh)
    stage = Stage(params.stage, params.from_step, params.until)
    checkpoints = context.partial / "checkpoints"
    _start_from_stage_before(context, checkpoints)
    recorder = HistoryRecorder(context.partial / HISTORY_FILE, context.tracker)
    trainer = Trainer(
        method,
        scene,
        seed=params.seed,
        stage=stage,
        progress=progress_for(quiet=context.quiet),
        recorder=recorder,
        checkpoint_dir=checkpoints,
        observer=TrainingPictures(scene, context.partial / FOLDER, params.schedule.total),
    )
    summary = trainer.run()
    newest = max(checkpoints.glob("step_*"))
    shutil.copytree(newest, context.out / CHECKPOINT_FOLDER)
    if object_mesh is not None:
        (context.out / OBJECT_FOLDER).mkdir()
        write_object_mesh(context.out / OBJECT_FOLDER, object_mesh)
    for part in method.sets:
        write_ply(context.out / f"{part.name}.ply", part.gaussians)
    record = {key: _finite(value) for key, value in asdict(summary).items()}
    write_json(context.out / SUMMARY_FILE, record)
    recorder.write_history(context.out / HISTORY_FILE)
    if (context.partial / FOLDER).is_dir():
        shutil.copytree(context.partial / FOLDER, context.out / FOLDER)
    numbers = {f"final/{key}": value for key, value in record.items() if isinstance(value, (int, float))}
    context.tracker.metrics(numbers)
    return method


def _start_from_stage_before(context: StepContext, checkpoints: Path) -> None:
    """A later stage goes on from the state at the end of the one before, unless it has a checkpoint of its own."""
    from rtgs.train.checkpoint import adopt_checkpoint

    before = [folder for name, folder in context.inputs.items() if name.startswith("train_")]
    if before and not any(checkpoints.glob("step_*")):
        adopt_checkpoint(before[-1] / CHECKPOINT_FOLDER, checkpoints)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


class HistoryRecorder:
    """Metrics to a tracker and, one JSON object per line, to a file that survives a kill."""

    def __init__(self, path: Path, tracker: Tracker) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.tracker = tracker

    def metrics(self, values: Mapping[str, float], step: int) -> None:
        """Record numbers at an iteration."""
        self.tracker.metrics(values, step)
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(
                json.dumps({"step": step, **{key: _finite(float(value)) for key, value in values.items()}}) + "\n"
            )

    def write_history(self, path: Path) -> None:
        """The history without what a killed attempt recorded past the checkpoint it was resumed from."""
        rows: dict[int, dict[str, float]] = {}
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        for line in lines:
            try:
                row = parse_json(line)
            except DocumentError:  # cut by a kill; what follows was recorded by the attempt after
                continue
            rows = {step: kept for step, kept in rows.items() if step <= row["step"]}
            rows[row["step"]] = rows.get(row["step"], {}) | row
        path.write_text("".join(json.dumps(rows[step]) + "\n" for step in sorted(rows)), encoding="utf-8")


def read_history(folder: Path) -> list[dict[str, float]]:
    """Recorded metrics of a training artifact: one mapping per iteration, with its ``step``."""
    lines = (folder / HISTORY_FILE).read_text(encoding="utf-8").splitlines()
    return [{key: value for key, value in parse_json(line).items() if value is not None} for line in lines]


def read_summary(folder: Path) -> TrainSummary:
    """``summary.json`` of a training artifact.

    Raises:
        RtgsError: it is missing or damaged.
    """
    from rtgs.train.trainer import TrainSummary

    path = folder / SUMMARY_FILE
    values = read_json(path)
    for item in fields(TrainSummary):
        if item.type == "float" and values.get(item.name, 0.0) is None:  # JSON has no NaN and no infinity
            values[item.name] = math.nan
    return record_of(TrainSummary, values, path)


def stage_params(folder: Path) -> StageParams:
    """The parameters a training artifact was made with, from its manifest.

    Raises:
        RtgsError: the folder is no artifact.
    """
    manifest = Manifest.read(folder)
    if manifest is None:
        raise RtgsError(f"{folder} has no readable manifest: run `rtgs cache gc`, then the command again")
    return build(StageParams, manifest.params)


def load_method(folder: Path, scene: Scene) -> tuple[Model, StageParams]:
    """The method as it was at the end of a training stage, with the object mesh that the artifact carries."""
    from rtgs.mesh.container import read_object_mesh
    from rtgs.methods import create_method
    from rtgs.train.checkpoint import load_checkpoint
    from rtgs.train.seeds import generator_for

    params = stage_params(folder)
    mesh = read_object_mesh(folder / OBJECT_FOLDER) if (folder / OBJECT_FOLDER).is_dir() else None
    method = create_method(params.method, scene, params.schedule, generator_for(params.seed, "initialise"), mesh)
    tensors = load_checkpoint(folder / CHECKPOINT_FOLDER).tensors
    prefix = "method."
    method.load({name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)})
    return method, params


def last_training(inputs: Mapping[str, Path]) -> Path:
    """The folder of the training stage that ends latest among the inputs of a step.

    Raises:
        RtgsError: no training artifact among them.
    """
    folders = [folder for name, folder in inputs.items() if name.startswith("train_")]
    if not folders:
        raise RtgsError(f"no training step among the inputs {sorted(inputs)}")
    return max(folders, key=lambda folder: stage_params(folder).until)
