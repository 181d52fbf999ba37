"""The run folder and the tracked run: what people look at, copied out of the store."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import FileLock

from pipelines.planning.rows import plan_rows
from pipelines.steps.evaluate import TABLE_CSV, TABLE_JSON
from pipelines.steps.judge import STEP as JUDGE
from pipelines.steps.pictures import final_pictures, training_pictures
from pipelines.steps.render import ENVIRONMENT, PREVIEW
from pipelines.steps.report import PAGE
from pipelines.steps.report import STEP as REPORT
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError
from rtgs.core.listing import columns
from rtgs.evaluate.judgement import RECORD_FILE, JudgeRecord
from rtgs.evaluate.records import EvaluationTable, read_json
from rtgs.prepare.masks.report import FILES as MASK_FILES
from rtgs.prepare.poses.quality import PICTURE_FILE, REPORT_FILE
from rtgs.report.files import link_files
from rtgs.runs.mixture import plain_training
from rtgs.runs.record import RUN_FILE, RunRecord
from rtgs.runs.training import has_training, last_training, read_history, stage_params
from rtgs.track import RunInfo, Tracker
from rtgs.track.source import git_tags, installed
from rtgs.workflow import Artifacts, Plan, Step, StepResult, Store

CONFIG_FILE = "config.yaml"
INSTALLED_FILE = "requirements.txt"
SHOWN = "shown"  # what `rtgs show` made of this model
EXPORTS = "exports"  # and `rtgs export`
BEFORE = "before"  # both, of the model that the folder showed before
TRAINING_PICTURE = "training.jpg"  # while it trains
_TRACKED_IMAGES = 4
log = logging.getLogger("rtgs")
_NOT_TOLD = ("paths.", "tracking.", "table.")  # where results go, not what they are


def note_tracked(folder: Path, results: Sequence[StepResult], place: str) -> None:
    """Write into the record of a run folder that the tracker at ``place`` has this run, unless another run of that name
    has the folder by now."""
    steps = _keys(results)
    with _folder_lock(folder):
        record = RunRecord.read(folder)
        if record is not None and record.steps == steps and place not in record.tracked:
            replace(record, tracked=(*record.tracked, place)).write(folder)


def is_tracked(config: RunConfig, plan: Plan, place: str) -> bool:
    """Whether the tracker at ``place`` has the run of this name with these steps, by the record of its folder."""
    record = _known(config.paths.runs / str(config.name))
    steps = {planned.step.name: planned.step.fingerprint for planned in plan}
    return record is not None and record.steps == steps and place in record.tracked


def write_run_folder(config: RunConfig, choices: Choices, command: str, results: Sequence[StepResult]) -> Path:
    """Copy what people look at into ``runs/<name>``; nothing is copied when it is all there already.

    ``report.html``, ``preview.webp`` (where the capture has a path), ``metrics.json``, ``metrics.csv``, ``renders/``,
    ``errors/``, ``point_cloud.ply`` (the base set;
    other sets under their own names; the plain method's where a judge kept it everywhere), ``mesh.ply`` when asked for,
    ``environment/`` of a method with a far light, ``judge.json`` of a run with a judge, ``config.yaml``, ``run.json``.
    """
    folder = config.paths.runs / str(config.name)
    config.paths.runs.mkdir(parents=True, exist_ok=True)
    with _folder_lock(folder):
        return _fill_run_folder(folder, config, choices, command, results, _keys(results))


def _folder_lock(folder: Path) -> FileLock:
    return FileLock(str(folder.with_name(f".{folder.name}.lock")))


def _keys(results: Sequence[StepResult]) -> dict[str, str]:
    return {result.step.name: result.step.fingerprint for result in results}


def _fill_run_folder(
    folder: Path,
    config: RunConfig,
    choices: Choices,
    command: str,
    results: Sequence[StepResult],
    steps: dict[str, str],
) -> Path:
    known = _known(folder)
    if known is not None and known.steps == steps and (folder / PAGE).is_file():
        return folder
    if known is not None and known.steps != steps:
        log.info("%s", replaced(folder, known, command))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RUN_FILE).unlink(missing_ok=True)  # written last: a folder without it is incomplete
    for pattern in (
        "*.ply",
        "mesh.*",
        RECORD_FILE,
        PREVIEW,
        TRAINING_PICTURE,
    ):  # of another run of this name, with other stages
        for left in folder.glob(pattern):
            left.unlink(missing_ok=True)
    if known is None or known.steps != steps:
        _put_aside(folder)
    places = folders(results)
    shutil.copyfile(places["report"] / PAGE, folder / PAGE)
    for name in (TABLE_JSON, TABLE_CSV):
        shutil.copyfile(places["evaluate"] / name, folder / name)
    _replace_tree(places["render"] / "images", folder / "renders")
    if (places["render"] / PREVIEW).is_file():
        shutil.copyfile(places["render"] / PREVIEW, folder / PREVIEW)
    _replace_tree(places["evaluate"] / "errors", folder / "errors")
    _replace_tree(places["render"] / ENVIRONMENT, folder / ENVIRONMENT)
    if JUDGE.name in places:
        shutil.copyfile(places[JUDGE.name] / RECORD_FILE, folder / RECORD_FILE)
    shown = shown_training(results)
    for ply in sorted(shown.glob("*.ply")) if shown is not None else ():
        shutil.copyfile(ply, folder / ("point_cloud.ply" if ply.stem == "base" else ply.name))
    for mesh in sorted(places["extract_mesh"].glob("mesh.*")) if "extract_mesh" in places else ():
        shutil.copyfile(mesh, folder / mesh.name)
    for name in (REPORT_FILE, PICTURE_FILE) if "sfm" in places else ():
        shutil.copyfile(places["sfm"] / name, folder / name)
    for name in MASK_FILES if "masks" in places else ():
        shutil.copyfile(places["masks"] / name, folder / name)
    (folder / CONFIG_FILE).write_text(config_yaml(config), encoding="utf-8")
    link_files(folder / PAGE)
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    RunRecord(str(config.name), command, finished, asdict(choices), steps).write(folder)
    return folder


def _put_aside(folder: Path) -> None:
    """Films and exports are of the model that the folder showed until now."""
    for name in (SHOWN, EXPORTS):
        if (folder / name).is_dir():
            (folder / BEFORE).mkdir(exist_ok=True)
            shutil.rmtree(folder / BEFORE / name, ignore_errors=True)
            (folder / name).rename(folder / BEFORE / name)
            log.info("%s are of the model before: now in %s", folder / name, folder / BEFORE / name)


def replaced(folder: Path, before: RunRecord, command: str) -> str:
    """In words: a run folder now shows another run of its name, or the same one with other results."""
    if before.command == command:
        return f"{folder}: the results of {before.finished} are replaced; they stay in the store (rtgs cache ls)"
    return (
        f"{folder} showed another run and now shows this one; name=... keeps both. `{before.command}` brings the other "
        "back from the store"
    )


def _known(folder: Path) -> RunRecord | None:
    """The record of a run folder that this run may write; a damaged one makes the folder incomplete, and is told."""
    try:
        return RunRecord.read(folder)
    except RtgsError as error:
        log.warning("%s; the folder is written anew", error)
        return None


def _replace_tree(source: Path, target: Path) -> None:
    if target.exists():
        shutil.rmtree(target)
    if source.exists():
        shutil.copytree(source, target)


def folders(results: Sequence[StepResult]) -> dict[str, Path]:
    """The artifact folder of each step by name."""
    return {result.step.name: result.folder for result in results}


def was_trained(results: Sequence[StepResult]) -> bool:
    """Whether the run trained anything; else the pictures are another program's."""
    return has_training(folders(results))


def final_training(results: Sequence[StepResult]) -> Path:
    """The artifact of the last training stage.

    Raises:
        RtgsError: the run trained nothing.
    """
    return last_training(folders(results))


def judge_record(results: Sequence[StepResult]) -> JudgeRecord | None:
    """What the judge of a run decided; None: it has none."""
    places = folders(results)
    return JudgeRecord.read(places[JUDGE.name]) if JUDGE.name in places else None


def shown_training(results: Sequence[StepResult]) -> Path | None:
    """The artifact whose sets of Gaussians are published: of the run's method, unless nothing of it is shown. None:
    the run trained nothing."""
    if not was_trained(results):
        return None
    record = judge_record(results)
    if record is not None and record.all_plain:
        return plain_training(folders(results))
    return final_training(results)


def config_yaml(config: RunConfig) -> str:
    """The resolved config as YAML, credentials left out."""
    from omegaconf import OmegaConf

    values = asdict(config)
    return redact(OmegaConf.to_yaml(OmegaConf.create(json.loads(json.dumps(values)))))


def evaluation_of(results: Sequence[StepResult]) -> EvaluationTable:
    """The measured table of a run."""
    return read_json(folders(results)["evaluate"] / TABLE_JSON)


def result_table(tables: Sequence[EvaluationTable], seeds: Sequence[int] = ()) -> str:
    """Runs side by side in plain text; what was not measured is ``n/a``. ``seeds``: shown where they differ.

    Beside the PSNR of whole pictures, where known: that of the pixels that enough training views show, and the noise
    floor of the test photos.
    """
    from rtgs.evaluate.tables import summarize

    seeded = len(set(seeds)) > 1
    summaries = summarize(tables)
    beside = [
        (title, name)
        for title, name in (("seen", "psnr_framed"), ("noise floor", "noise_psnr"))
        if any(getattr(row, name) is not None for row in summaries)
    ]
    header = ("scene", "method", "preset", *(["seed"] if seeded else []), "views", "PSNR")
    header = (*header, *(title for title, _ in beside), "SSIM", "LPIPS", "FLIP")
    rows: list[tuple[str, ...]] = [(*header, "train", "memory", "surfels")]
    for index, row in enumerate(summaries):
        rows.append(
            (
                row.scene,
                row.method,
                row.preset,
                *([str(seeds[index])] if seeded else []),
                f"{row.views} of {row.resolution}" if row.views else "none",
                _figure(row.psnr, "{:.2f} dB"),
                *(_figure(getattr(row, name), "{:.2f} dB") for _, name in beside),
                _figure(row.ssim, "{:.4f}"),
                _figure(row.lpips_01, "{:.4f}"),
                _figure(row.flip, "{:.4f}"),
                _figure(row.train_seconds, "{:.1f} s"),
                _figure(row.peak_memory_mb, "{:.0f} MB"),
                _figure(row.surfels, "{:,}"),
            )
        )
    return columns(rows)


def _figure(value: float | None, form: str) -> str:
    return "n/a" if value is None else form.format(value)


def tracked_step(plan: Plan) -> Step:
    """The step by whose key a tracker knows a run: its report, which depends on everything that the run is."""
    return next(planned.step for planned in plan if planned.step.name == REPORT.name)


def run_info(config: RunConfig, choices: Choices, plan: Plan, parent: str = "") -> RunInfo:
    """How a run appears in the tracker: names as tags, each step linked by its fingerprint."""
    target = tracked_step(plan)
    tags = {f"rtgs.{key}": getattr(choices, key) for key in ("scene", "method", "preset", "ablation", "experiment")}
    tags |= {f"rtgs.step.{planned.step.name}": planned.step.fingerprint for planned in plan}
    tags |= {"rtgs.seed": str(config.seed), **git_tags()}
    return RunInfo(config.tracking.experiment, str(config.name), target.fingerprint, tags, parent)


def track_start(tracker: Tracker, config: RunConfig, choices: Choices, plan: Plan) -> None:
    """What a person tells runs apart by as parameters; the whole config, what is installed, and the plan."""
    tracker.params(told_apart(config, choices))
    with TemporaryDirectory() as folder:
        for name, text in ((CONFIG_FILE, config_yaml(config)), (INSTALLED_FILE, installed())):
            path = Path(folder) / name
            path.write_text(text, encoding="utf-8")
            tracker.artifact(path)
    tracker.table("plan", plan_rows(plan))


def told_apart(config: RunConfig, choices: Choices) -> dict[str, str]:
    """The chosen names, the seed and the overrides, by key.

    Not the hundreds of other keys: trackers print all parameters above every picture. What a step read is with the
    step's own run.
    """
    names = ("scene", "method", "preset", "ablation")
    told = {name: str(getattr(choices, name)) for name in names} | {"seed": str(config.seed)}
    for word in choices.overrides:
        key, _, value = word.lstrip("+~").partition("=")
        if not key.startswith(_NOT_TOLD):
            told.setdefault(key, value)
    return told


def track_end(tracker: Tracker, folder: Path, results: Sequence[StepResult], artifacts: Artifacts) -> None:
    """Curves over real iterations, final figures, the per-view table, a few pictures, the files of the run folder."""
    for result in results:
        if result.step.name.startswith("train_"):
            for row in read_history(result.folder):
                step = int(row.pop("step"))
                tracker.metrics(row, step)
    table = evaluation_of(results)
    means = {name: table.mean(name) for name in table.metrics}
    tracker.metrics({f"eval/{name}": value for name, value in means.items() if value is not None})
    facts = {"train_seconds": table.facts.train_seconds, "peak_memory_mb": table.facts.peak_memory_mb}
    tracker.metrics({f"cost/{name}": value for name, value in facts.items() if value is not None})
    if table.object is not None:
        tracker.metrics({f"object/{name}": value for name, value in table.object.numbers().items()})
    if table.facts.surfels is not None:
        tracker.metrics({"surfels": float(table.facts.surfels)})
    tracker.table("eval", [{"view": row.view, **row.values} for row in table.rows])
    _track_sliders(tracker, results, artifacts)
    for path in sorted((folder / "renders").glob("*.png"))[:_TRACKED_IMAGES]:
        _track_png(tracker, f"renders/{path.stem}", path)
        _track_png(tracker, f"errors/{path.stem}", folder / "errors" / path.name)
    for name in (PAGE, TABLE_JSON, TABLE_CSV, RUN_FILE):
        tracker.artifact(folder / name)
    for ply in sorted(folder.glob("*.ply")):  # point_cloud.ply, and the sets of later stages
        tracker.artifact(ply)


def _track_sliders(tracker: Tracker, results: Sequence[StepResult], artifacts: Artifacts) -> None:
    """Fixed views and layers at several steps, the last of them as the test views were rendered."""
    from rtgs.scenes.canonical import read_scene

    if not was_trained(results):
        return
    places, last = folders(results), final_training(results)
    for result in results:
        if result.step.name.startswith("train_"):
            for picture in training_pictures(result.folder):
                tracker.image(picture.key, picture.pixels, picture.step)
    scene = artifacts.read(read_scene, places["import_scene"])
    for picture in final_pictures(scene, places["render"], stage_params(last).until):
        tracker.image(picture.key, picture.pixels, picture.step)


def _track_png(tracker: Tracker, name: str, path: Path) -> None:
    import numpy as np
    from PIL import Image

    if path.is_file():
        tracker.image(name, np.asarray(Image.open(path).convert("RGB")))


def report_page(folder: Path, store: Store) -> Path:
    """The report in a run folder; copied out of the store again when it is gone.

    Raises:
        RtgsError: it is in neither place.
    """
    page = folder / PAGE
    if page.is_file():
        return page
    record = RunRecord.read(folder)
    key = record.steps.get("report", "") if record else ""
    cached = store.folder_of("report", key) / PAGE
    if not cached.is_file():
        repeat = record.command if record else "rtgs run ..."
        raise RtgsError(f"{page} is gone and not in the store either; `{repeat}` makes it again")
    shutil.copyfile(cached, page)
    link_files(page)
    return page
