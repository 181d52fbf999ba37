"""What the training steps share: the run of one stage, and what it records."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtgs.core.documents import DocumentError, parse_json
from rtgs.core.memory import share_one_heap
from rtgs.core.records import read_json, record_of, write_json
from rtgs.runs.mixture import TRAININGS
from rtgs.runs.training import CHECKPOINT_FOLDER, HISTORY_FILE, OBJECT_FOLDER, PSEUDO_VIEWS, StageParams
from rtgs.track import Tracker
from rtgs.workflow import StepContext

if TYPE_CHECKING:
    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.model import Model
    from rtgs.runs.pseudo import PseudoViews
    from rtgs.train.trainer import TrainSummary

SUMMARY_FILE = "summary.json"


def train_stage(params: StageParams, context: StepContext, object_mesh: ObjectMesh | None = None) -> Model:
    """Train from ``from_step`` to ``until`` on the scene, going on from a checkpoint of a killed attempt.

    Writes ``checkpoint/`` (state of the method at the end), ``<set>.ply`` for every set of surfels, ``summary.json``,
    ``history.jsonl`` (the recorded metrics), ``pictures/`` of fixed views where the training is long enough, and with
    an ``object_mesh`` a copy of it in ``object_mesh/``. Pseudo views among the inputs are trained on as well, and what
    their models cost counts. Returns the trained method.

    Raises:
        TrainingDiverged: a loss or gradient is not finite.
        TrainingStopped: who looks on asked for the end; the next attempt goes on from there.
    """
    from pipelines.steps.pictures import FOLDER, TrainingPictures
    from rtgs.gaussians.ply import write_ply
    from rtgs.mesh.container import write_object_mesh
    from rtgs.methods import Stage, create_method
    from rtgs.methods.views import views_schedule
    from rtgs.scenes.canonical import read_scene
    from rtgs.train.progress import SharedProgress, progress_for
    from rtgs.train.seeds import generator_for
    from rtgs.train.trainer import Trainer

    share_one_heap()
    scene = context.read("import_scene", read_scene)
    pseudo = _pseudo_views(context)
    if pseudo is not None:
        scene = replace(scene, pseudo=pseudo.views)
    generator = generator_for(params.seed, "initialise")
    method = create_method(params.method, scene, params.schedule, generator, object_mesh)
    stage = Stage(params.stage, params.from_step, params.until, params.joined)
    checkpoints = context.partial / "checkpoints"
    _start_from_stage_before(context, checkpoints)
    recorder = HistoryRecorder(context.partial / HISTORY_FILE, context.tracker)
    progress = progress_for(quiet=context.quiet)
    if context.onlooker is not None:
        context.onlooker.attend(scene, object_mesh, progress)
        progress = SharedProgress(progress, context.onlooker)
    trainer = Trainer(
        method,
        scene,
        seed=params.seed,
        stage=stage,
        views=partial(views_schedule, method, params.from_step),
        progress=progress,
        recorder=recorder,
        checkpoint_dir=checkpoints,
        observer=TrainingPictures(scene, context.partial / FOLDER, params.schedule.total),
        watch=params.watch,
        onlooker=context.onlooker,
        spent=None if pseudo is None else pseudo.spent,
    )
    summary = trainer.run()
    summary = summary if pseudo is None else _of_all(summary, pseudo)
    newest = max(checkpoints.glob("step_*"))
    shutil.copytree(newest, context.out / CHECKPOINT_FOLDER)
    if object_mesh is not None:
        (context.out / OBJECT_FOLDER).mkdir()
        write_object_mesh(context.out / OBJECT_FOLDER, object_mesh)
    for part in method.sets:
        write_ply(context.out / f"{part.name}.ply", part.shown())
    record = {key: _finite(value) for key, value in asdict(summary).items()}
    write_json(context.out / SUMMARY_FILE, record)
    recorder.write_history(context.out / HISTORY_FILE)
    if (context.partial / FOLDER).is_dir():
        shutil.copytree(context.partial / FOLDER, context.out / FOLDER)
    numbers = {f"final/{key}": value for key, value in record.items() if isinstance(value, (int, float))}
    context.tracker.metrics(numbers)
    return method


def _pseudo_views(context: StepContext) -> PseudoViews | None:
    """Those among the inputs of a training; None: it is on photos alone."""
    from rtgs.runs.pseudo import read_pseudo

    folder = context.inputs.get(PSEUDO_VIEWS)
    return None if folder is None else read_pseudo(folder)


def _of_all(summary: TrainSummary, pseudo: PseudoViews) -> TrainSummary:
    """The summary of a taught training: its times count those of its teachers already, its peak is that of any."""
    return replace(summary, peak_memory_mb=max(summary.peak_memory_mb, pseudo.peak_memory_mb))


def _start_from_stage_before(context: StepContext, checkpoints: Path) -> None:
    """A later stage goes on from the state at the end of the one before, unless it has a checkpoint of its own."""
    from rtgs.train.checkpoint import adopt_checkpoint

    before = training_before(context.inputs)
    if before is not None and not any(checkpoints.glob("step_*")):
        adopt_checkpoint(before / CHECKPOINT_FOLDER, checkpoints)


def training_before(inputs: Mapping[str, Path]) -> Path | None:
    """The artifact of the training that a training step goes on from; None: it is the first."""
    before = [folder for name, folder in inputs.items() if name.startswith(TRAININGS)]
    return before[-1] if before else None


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

    def forget_after(self, step: int) -> None:
        """Drop what a killed attempt recorded beyond the checkpoint it is resumed from."""
        kept = [json.dumps(row) + "\n" for row in self._rows() if row["step"] <= step]
        whole = self.path.with_name(f"{self.path.name}.tmp")
        whole.write_text("".join(kept), encoding="utf-8")
        whole.replace(self.path)

    def write_history(self, path: Path) -> None:
        """The history, one line for each step."""
        rows: dict[int, dict[str, float]] = {}
        for row in self._rows():
            rows[row["step"]] = rows.get(row["step"], {}) | row
        path.write_text("".join(json.dumps(rows[step]) + "\n" for step in sorted(rows)), encoding="utf-8")

    def _rows(self) -> Iterator[dict[str, Any]]:
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        for line in lines:
            with suppress(DocumentError):  # cut by a kill; what follows was recorded by the attempt after
                yield parse_json(line)


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
