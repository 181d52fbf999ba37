"""Whether masks are made for a capture, by which way, and why not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pipelines.steps import import_scene, masks
from pipelines.steps.normals import photo_settings
from rtgs.config.schema import RunConfig
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.source import Source
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import Step


class MaskPlan(NamedTuple):
    """The way masks are made, or why they are not."""

    method: str
    """Key of :data:`rtgs.prepare.masks.report.METHODS`; empty: not made."""
    why: str


def plan_masks(config: RunConfig, source: Source) -> MaskPlan:
    """Decide.

    Raises:
        MissingWeights: ``masks=grounded_sam2`` and a network is not there.
        PrepareError: a file named is not there, or given masks in a form that photos without poses cannot have.
    """
    from rtgs.prepare.masks.makers import find_networks

    settings = config.masks
    if settings.source == "none":
        return MaskPlan("", "masks=none")
    if settings.source != "auto":
        if settings.source == "grounded_sam2":
            find_networks(settings)
        _refuse_early_forms(config, source)
        return MaskPlan(settings.source, "")
    return _automatic(config, source)


def _automatic(config: RunConfig, source: Source) -> MaskPlan:
    from rtgs.prepare.masks.drawn import drawn_kinds
    from rtgs.prepare.masks.makers import find_networks
    from rtgs.prepare.pretrained import MissingWeights

    if given := _given(config, source) or _no_glass(source):
        return MaskPlan("", given)
    marks = _folder(source) / config.masks.drawn.file
    if marks.is_file():
        kinds = drawn_kinds(marks)
        return MaskPlan("polygon" if kinds == ("panes",) else "grabcut" if kinds == ("cutouts",) else "drawn", "")
    if not _reads_masks(config):
        return MaskPlan(
            "", "nothing reads them (method.loss.specular is 0, no stage for transmittance, no masked mesh)"
        )
    try:
        find_networks(config.masks)
    except MissingWeights as error:
        hint = f"; `rtgs weights status` says where to get it, {marks.name} beside the photos does without"
        return MaskPlan("", f"{error}".split("; searched")[0] + hint)
    return MaskPlan("grounded_sam2", "")


def _given(config: RunConfig, source: Source) -> str:
    """In words, where the capture brings masks."""
    from rtgs.scenes.importers.registry import read_capture

    scene = config.scene
    if not source.has_poses:
        there = bool(scene.masks_dir) and (_folder(source) / scene.masks_dir).is_dir()
        return f"masks are given ({scene.masks_dir}/)" if there else ""
    views = read_capture(scene).views
    given = sum(view.mask is not None for view in views)
    return f"masks are given ({given} of {len(views)} photos)" if given else ""


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


def _folder(source: Source) -> Path:
    return source.path if source.path.is_dir() else source.path.parent


def mask_step(
    config: RunConfig, source: Source, method: str, imported: import_scene.ImportParams, before: tuple[Step, ...]
) -> Step:
    """The step for a way that was decided on; hashes what it reads.

    Raises:
        MissingWeights, PrepareError, CaptureError: a file it reads is not there.
    """
    from importlib.metadata import version

    from rtgs.prepare.masks.makers import find_networks

    settings = config.masks
    given = replace(settings.given, folder=settings.given.folder or config.scene.masks_dir or "masks")
    recipe = masks.with_networks(replace(settings, source="auto", given=given), ())
    files: tuple[str, ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    if method == "grounded_sam2":
        found = find_networks(settings)
        files = tuple(map(str, (found.detector, found.tokenizer, found.encoder, found.decoder)))
        tools = (*found.digests, ("onnxruntime", version("onnxruntime")))
    scene = photo_settings(imported.settings)
    params = masks.MaskParams(
        method,
        recipe,
        scene,
        "" if before else _capture_digest(imported, scene),
        _marks_digest(config, method, _folder(source)),
        imported.path,
        str(_folder(source)),
        files,
        str(Path(config.paths.store) / "single_masks"),
    )
    return masks.STEP.step(params, *before, tools=tools)


def draws_panes(step: Step) -> bool:
    """The step makes masks from marks that may be flat panes: the object's mesh takes their planes."""
    return isinstance(step.params, masks.MaskParams) and step.params.method in ("polygon", "drawn")


def _capture_digest(imported: import_scene.ImportParams, scene: SceneSettings) -> str:
    from rtgs.scenes.digest import capture_digest

    return capture_digest(replace(scene, path=imported.path))


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
