"""One self-contained HTML page of a run: numbers, pictures, curves, and how it was made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps import extract_mesh
from pipelines.steps.evaluate import TABLE_JSON
from pipelines.steps.external import ExternalRecord
from pipelines.steps.judge import STEP as JUDGE
from pipelines.steps.render import ENVIRONMENT, PREVIEW, RenderTimes
from pipelines.steps.training import read_summary
from rtgs.core.decisions import Decision
from rtgs.core.records import damaged
from rtgs.evaluate.judgement import JudgeRecord
from rtgs.mesh.record import RECORD_FILE, MeshRecord
from rtgs.runs.training import has_training, last_training, read_history, stage_params
from rtgs.runs.views import read_coverage, read_render
from rtgs.workflow import StepContext, StepKind
from rtgs.workflow.manifest import Manifest

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from rtgs.evaluate.records import EvaluationTable
    from rtgs.report.figures import Curve
    from rtgs.report.page import MeshFigure, ReportView, StepLine

PAGE = "report.html"


@dataclass(frozen=True)
class ReportParams:
    """What the page says besides what it reads from the steps before it."""

    title: str
    command: str
    config: dict[str, tuple[str, str]]
    """Value and default of every config key that has to do with the result."""
    decisions: tuple[tuple[str, str], ...] = ()
    """What the graph left out, and why: :class:`rtgs.core.decisions.Decision` as pairs, the form that older recipes
    have, so that their reports are found."""
    views: int = 4
    """How many test views are shown: the best, the worst, and evenly between."""


def report(params: ReportParams, context: StepContext) -> None:
    """Write ``report.html``."""
    from rtgs.evaluate.records import read_json
    from rtgs.report.page import ConfigLine, ReportData, write_report

    inputs = context.inputs
    table = read_json(inputs["evaluate"] / TABLE_JSON)
    training = last_training(inputs) if has_training(inputs) else None
    manifest = Manifest.read(training or inputs["render"])
    assert manifest is not None
    decisions = [Decision(*item) for item in params.decisions]
    decisions += _prepared(inputs)
    decisions += _external(inputs) if training is None else read_summary(training).decisions
    mesh = MeshRecord.read(inputs["extract_mesh"]) if "extract_mesh" in inputs else None
    decisions += () if mesh is None else mesh.decisions  # how the transparent object's mesh was chosen
    decisions += [] if training is None else _boundary(training)
    decisions += _guide(table)
    decisions += JudgeRecord.read(inputs[JUDGE.name]).decisions() if JUDGE.name in inputs else ()
    data = ReportData(
        title=params.title,
        evaluation=table,
        command=params.command,
        created=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        views=_views(table, context, params.views),
        curves=_curves(inputs),
        steps=_steps(context),
        decisions=tuple(decisions),
        config=tuple(ConfigLine(key, *both) for key, both in sorted(params.config.items())),
        machine={key: str(value) for key, value in (manifest.machine | manifest.versions).items()},
        mesh=None if mesh is None else _mesh(inputs["extract_mesh"], mesh),
        preview=_preview(inputs["render"] / PREVIEW),
        environment=_environment(inputs["render"] / ENVIRONMENT),
        timed="per view, maps included" if RenderTimes.read(inputs["render"]).with_maps else "per view",
    )
    size = write_report(context.out / PAGE, data)
    context.log.info("report of %.1f MB", size / 1e6)
    context.tracker.artifact(context.out / PAGE)


def _external(inputs: Mapping[str, Path]) -> list[Decision]:
    """What the pictures of another program are."""
    record = ExternalRecord.read(inputs["render"])
    return [] if record is None else [Decision("external pictures", note) for note in record.notes]


def _preview(path: Path) -> str:
    """The moving picture as an address; empty: there is none."""
    from rtgs.report.figures import data_uri

    return data_uri(path.read_bytes(), "image/webp") if path.is_file() else ""


def _prepared(inputs: Mapping[str, Path]) -> list[Decision]:
    """How good the poses are and what to do about it, how masks (a classical fallback is named as such) and normals
    were made."""
    from rtgs.prepare.masks.report import MaskReport
    from rtgs.prepare.normals.make import read_message
    from rtgs.prepare.poses.quality import SfmReport
    from rtgs.scenes.capture import list_some

    lines = []
    if "sfm" in inputs:
        poses = SfmReport.read(inputs["sfm"])
        missing = f"; without a pose: {list_some(poses.missing)}" if poses.missing else ""
        lines += [Decision("poses", f"{poses}{missing}"), *(Decision("advice", line) for line in poses.advice)]
    if "masks" in inputs:
        made = MaskReport.read(inputs["masks"])
        lines.append(Decision("masks", "; ".join((str(made), *made.notes))))
    if "normals" in inputs:
        lines.append(Decision("normals", read_message(inputs["normals"])))
    return lines


def _views(table: EvaluationTable, context: StepContext, count: int) -> tuple[ReportView, ...]:
    from rtgs.report.page import ReportView, pick_views
    from rtgs.scenes.canonical import read_scene

    photos = {view.name: view for view in context.read("import_scene", read_scene).test}
    symbols = _symbols(context.inputs)
    views = []
    for row, role in pick_views(table, count):
        name = table.rows[row].view
        maps = read_render(context.inputs["render"], name)
        photo = photos[name]
        shown = {key: maps.get(key) for key in ("depth", "normal", "alpha")}
        shown["framed"] = read_coverage(context.inputs["render"], name)
        seen = (name, photo.camera, photo.image, maps["image"], role)
        views.append(
            ReportView(*seen, layers=_layers(maps), symbols=symbols, mask=photo.mask, truth=photo.truth, **shown)
        )
    return tuple(views)


def _layers(maps: dict[str, Tensor]) -> dict[str, Tensor]:
    """The layers of a rendered view as the page takes them; none for methods without reflection."""
    from rtgs.evaluate.layers import LAYERS, added_by_base

    if "reflection" not in maps:
        return {}
    names = (*LAYERS, "normal", "specular", "roughness", "f0")
    whole = {"diffuse": added_by_base(maps)} if {"specular", "diffuse"} <= maps.keys() else {}
    return whole | {name: maps[name] for name in names if name in maps}


def _symbols(inputs: Mapping[str, Path]) -> Mapping[str, str]:
    """What the layers are in the symbols of the method; of another program's nothing is known."""
    from rtgs.methods import find_method
    from rtgs.methods.spec import MIRROR

    if not has_training(inputs):
        return {}
    method = stage_params(last_training(inputs)).method
    spec = find_method(method.name)
    return {**spec.layers, "diffuse": "C_d"} if method.optics.additive and MIRROR in spec.has else spec.layers


def _boundary(training: Path) -> list[Decision]:
    """How well the transparent object's surface is known, where a third stage has written it down."""
    from rtgs.evaluate.boundary import BoundaryRecord

    scores = BoundaryRecord.read(training)
    if scores is None:
        return []
    return [Decision(f"object's surface {when} the third stage", str(each)) for when, each in vars(scores).items()]


def _guide(table: EvaluationTable) -> list[Decision]:
    """Where the object's mesh gives no pair of surfaces, and how far it is from the true container."""
    known = table.object
    if known is None:
        return []
    lines = [Decision("rays without two surfaces", known.fallbacks)]
    if known.distance is not None:
        front, back = ("none to judge" if share is None else f"{share:.3f}" for share in (known.front, known.back))
        why = (
            f"{known.distance:.4f} of its diagonal on average; share of the pixels whose surface is within 3 %: first "
        )
        lines.append(Decision("mesh and true container", f"{why}{front}, second {back}"))
    return lines


def _environment(folder: Path) -> np.ndarray | None:
    """The panorama of the far light; None: the method has none."""
    import numpy as np
    from PIL import Image

    from rtgs.light.pictures import PANORAMA

    return np.asarray(Image.open(folder / PANORAMA).convert("RGB")) if folder.is_dir() else None


def _mesh(folder: Path, record: MeshRecord) -> MeshFigure | None:
    """None: the scene turned out to have no transparent object."""
    import numpy as np
    from PIL import Image

    from rtgs.report.page import MeshFigure

    if record.absent:
        return None
    if record.vertices is None or record.faces is None:
        raise damaged(folder / RECORD_FILE, "the counts of vertices and faces are missing")
    pixels = np.asarray(Image.open(folder / extract_mesh.PICTURE_FILE).convert("RGB"))
    note = f"{record.note} Seen from {record.picture_from}."
    return MeshFigure(pixels, record.vertices, record.faces, note)


def _curves(inputs: Mapping[str, Path]) -> tuple[Curve, ...]:
    """Every recorded series, the stages of training joined."""
    from rtgs.report.figures import Curve

    series: dict[str, list[tuple[int, float]]] = {}
    for name, folder in inputs.items():
        if name.startswith("train_"):
            for row in read_history(folder):
                for key in row.keys() - {"step"}:
                    series.setdefault(key, []).append((int(row["step"]), row[key]))
    return tuple(
        Curve(name, tuple(step for step, _ in points), tuple(value for _, value in points))
        for name, points in sorted(series.items())
    )


def _steps(context: StepContext) -> tuple[StepLine, ...]:
    from rtgs.report.page import StepLine

    lines = []
    for name, folder in context.inputs.items():
        manifest = Manifest.read(folder)
        assert manifest is not None
        hit = manifest.fingerprint not in context.executed
        lines.append(StepLine(name, manifest.fingerprint, hit, manifest.duration))
    return tuple(lines)


STEP = StepKind("report", 11, report)
