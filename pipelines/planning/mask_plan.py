"""Whether masks are made for a capture, by which way, and why not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pipelines.planning.inspection import Inspection
from pipelines.steps import import_scene, masks
from pipelines.steps.normals import photo_settings
from rtgs.config.schema import RunConfig
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.source import Source
from rtgs.workflow import Step

_DRAWN = ("polygon", "grabcut", "drawn")  # ways that read a file of marks


class MaskPlan(NamedTuple):
    """The way masks are made, or why they are not."""

    method: str
    """Key of :data:`rtgs.prepare.masks.report.METHODS`; empty: not made."""
    why: str


def plan_masks(config: RunConfig, inspection: Inspection) -> MaskPlan:
    """Decide.

    Raises:
        MissingWeights: ``masks=grounded_sam2`` and a network is not there.
        PrepareError: a file named is not there, or given masks in a form that photos without poses cannot have.
    """
    from rtgs.prepare.masks.networks import find_networks

    settings = config.masks
    if settings.source == "none":
        return MaskPlan("", "masks=none")
    if settings.source != "auto":
        if settings.source == "grounded_sam2":
            find_networks(settings)
        _refuse_early_forms(config, inspection.source)
        if settings.source in _DRAWN:
            _refuse_bad_marks(config, inspection)
        return MaskPlan(settings.source, "")
    return _automatic(config, inspection)


def _automatic(config: RunConfig, inspection: Inspection) -> MaskPlan:
    from rtgs.prepare.masks.drawn import drawn_kinds
    from rtgs.prepare.masks.networks import find_networks
    from rtgs.prepare.pretrained import MissingWeights

    if given := inspection.given_masks or _no_glass(inspection.source):
        return MaskPlan("", given)
    marks = inspection.folder / config.masks.drawn.file
    if marks.is_file():
        kinds = drawn_kinds(marks)
        _refuse_bad_marks(config, inspection)
        return MaskPlan("polygon" if kinds == ("panes",) else "grabcut" if kinds == ("cutouts",) else "drawn", "")
    if not _reads_masks(config):
        return MaskPlan(
            "", "nothing reads them (method.loss.specular is 0, no stage for transmittance, no masked mesh)"
        )
    try:
        find_networks(config.masks)
    except MissingWeights as error:
        hint = f"; `rtgs weights status` says where to get it; without: {marks.name} beside the photos (`rtgs outline`)"
        return MaskPlan("", f"{error}".split("; searched")[0] + hint)
    return MaskPlan("grounded_sam2", "")


def _refuse_bad_marks(config: RunConfig, inspection: Inspection) -> None:
    """Marks that the step would refuse: now, not when poses have been looked for.

    Raises:
        PrepareError: the file is not there, not of its form, or names photos that there are not.
    """
    from rtgs.prepare.masks.drawn import read_drawing
    from rtgs.prepare.source import mark_file, markable_names

    read_drawing(mark_file(inspection.source, config.masks), markable_names(inspection.source, config.scene))


def _no_glass(source: Source) -> str:
    from rtgs.scenes.synthetic.record import CaptureRecord

    record = CaptureRecord.read(source.path) if source.path.is_dir() else None
    return "" if record is None or record.masked else "the scene has no glass (its record says so)"


def _reads_masks(config: RunConfig) -> bool:
    from rtgs.methods import find_method

    method = find_method(config.method.name)
    stages = {stage.name for stage in method.timeline(config.method, config.schedule, transparent=True)}
    object_stage = method.object_stage(config.method)
    return (
        config.method.loss.specular > 0
        or config.mesh.only_masked
        or (object_stage is not None and object_stage.name in stages)
    )


def _refuse_early_forms(config: RunConfig, source: Source) -> None:
    """Masks that the search of poses would read the wrong way."""
    given = config.masks.given
    plain = given.layout == "files" and not (given.labels or given.label_colors or given.inverted or given.folder)
    if config.masks.source == "given" and not source.has_poses and not plain:
        raise PrepareError(
            f"{source.path} has no poses yet, and their search reads masks only as {config.scene.masks_dir or 'masks'}/"
            "<image name>.png, white on the glass: write them so, or look for poses first and run on that capture"
        )


def mask_step(
    config: RunConfig,
    inspection: Inspection,
    method: str,
    imported: import_scene.ImportParams,
    before: tuple[Step, ...],
) -> Step:
    """The step for a way that was decided on; hashes what it reads.

    Raises:
        MissingWeights, PrepareError, CaptureError: a file it reads is not there.
    """
    from importlib.metadata import version

    from rtgs.prepare.masks.networks import find_networks

    settings = config.masks
    given = replace(settings.given, folder=settings.given.folder or config.scene.masks_dir or "masks")
    recipe = masks.with_networks(replace(settings, source="auto", given=given), ())
    files: tuple[str, ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    if method == "grounded_sam2":
        found = find_networks(settings)
        files = tuple(map(str, (found.detector, found.tokenizer, found.encoder, found.decoder)))
        tools = (*found.digests, ("onnxruntime", version("onnxruntime")))
    params = masks.MaskParams(
        method,
        recipe,
        photo_settings(imported.settings),
        "" if before else inspection.photo_digest,
        _marks_digest(config, method, inspection.folder),
        imported.path,
        str(inspection.folder),
        files,
        str(Path(config.paths.store) / "single_masks"),
    )
    return masks.STEP.step(params, *before, tools=tools)


def draws_panes(step: Step) -> bool:
    """The step makes masks from marks that may be flat panes: the object's mesh takes their planes."""
    return isinstance(step.params, masks.MaskParams) and step.params.method in ("polygon", "drawn")


def _marks_digest(config: RunConfig, method: str, folder: Path) -> str:
    from rtgs.scenes.digest import files_digest

    settings = config.masks
    if method == "grounded_sam2" or (method == "given" and settings.given.layout == "alpha"):
        return ""
    if method == "given":
        place = folder / (settings.given.folder or config.scene.masks_dir or "masks")
        return files_digest("given", place, sorted(path for path in place.rglob("*") if path.is_file()))
    marks = folder / settings.drawn.file
    if not marks.is_file():
        from rtgs.prepare.masks.drawn import drawn_kinds

        drawn_kinds(marks)  # raises: says how to write it
    return files_digest("marks", marks.parent, [marks])
