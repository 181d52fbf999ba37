"""Which steps come before the import: what the capture lacks is made, what it has is skipped, with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pipelines.planning.mask_plan import mask_step, plan_masks
from pipelines.steps import import_scene, normals, sfm
from rtgs.config.schema import RunConfig
from rtgs.prepare.source import Source, find_source
from rtgs.workflow import Step


@dataclass(frozen=True)
class SkippedStep:
    """A step the graph could hold and does not."""

    name: str
    why: str


@dataclass(frozen=True)
class Preparation:
    """The import of a scene, the steps it builds on, and those that are not needed."""

    scene: Step
    steps: tuple[Step, ...] = ()
    skipped: tuple[SkippedStep, ...] = ()


def prepare(config: RunConfig) -> Preparation:
    """The first steps of a run. Looks at the capture and hashes its files.

    Raises:
        CaptureError: the capture cannot be read.
        PrepareError: it has no poses and none may or can be looked for.
        MissingWeights: ``normals.use=always`` or ``masks=grounded_sam2`` and no network.
    """
    source = find_source(config.scene, config.sfm)
    steps: list[Step] = []
    skipped: list[SkippedStep] = []
    if source.has_poses:
        params = import_scene.import_params(config.scene)
        skipped.append(SkippedStep("sfm", source.why))
    else:
        params = import_scene.prepared_params(config.scene, source.path)
        steps.append(sfm.sfm_step(source, config.scene, config.sfm))
    before = tuple(steps)
    planned = plan_masks(config, source)
    if planned.method:
        steps.append(mask_step(config, source, planned.method, params, before))
    else:
        skipped.append(SkippedStep("masks", planned.why))
    why = _why_no_normals(config, source)
    if why:
        skipped.append(SkippedStep("normals", why))
    else:
        steps.append(_normals_step(config, params, before))
    return Preparation(import_scene.STEP.step(params, *steps), tuple(steps), tuple(skipped))


def _why_no_normals(config: RunConfig, source: Source) -> str:
    """Why monocular normals are not made; empty: they are.

    Raises:
        MissingWeights: they are demanded and the network is not there.
        PrepareError: the file named is not there, or another one.
    """
    from rtgs.prepare.normals.make import find_network
    from rtgs.prepare.pretrained import MissingWeights

    settings = config.normals
    if settings.use == "never":
        return "normals.use=never"
    if settings.use == "auto":
        if given := _given_normals(config, source):
            return given
        if not config.method.loss.mono_normal:
            return "no loss reads them (method.loss.mono_normal is 0)"
    try:
        find_network(settings)
    except MissingWeights as error:
        if settings.use == "always":
            raise
        return f"{error}".split("; searched")[0] + "; `rtgs weights status` says where to get it"
    return ""


def _given_normals(config: RunConfig, source: Source) -> str:
    """In words, where the capture brings normal maps."""
    from rtgs.scenes.importers.registry import read_capture

    scene = config.scene
    if not source.has_poses:
        folder = source.path / scene.normals_dir
        return f"normal maps are given ({scene.normals_dir}/)" if scene.normals_dir and folder.is_dir() else ""
    views = read_capture(scene).views
    given = sum(view.normal is not None for view in views)
    return f"normal maps are given ({given} of {len(views)} photos)" if given else ""


def _normals_step(config: RunConfig, imported: import_scene.ImportParams, before: tuple[Step, ...]) -> Step:
    from importlib.metadata import version

    from rtgs.prepare.normals.make import find_network

    settings = config.normals
    path, digest = find_network(settings)
    scene = normals.photo_settings(imported.settings)
    params = normals.NormalParams(
        replace(settings, use="auto", file="stated", sha256=""),  # its place is no part of the recipe, its digest is
        scene,
        "" if before else _photo_digest(imported, scene),
        imported.path,
        str(path),
        str(Path(config.paths.store) / "single_normals"),
    )
    return normals.STEP.step(params, *before, tools=(("network", digest), ("onnxruntime", version("onnxruntime"))))


def _photo_digest(imported: import_scene.ImportParams, scene: object) -> str:
    """Digest of photos and poses alone: masks do not concern their normals."""
    from rtgs.scenes.digest import capture_digest
    from rtgs.scenes.settings import SceneSettings

    assert isinstance(scene, SceneSettings)
    return capture_digest(replace(scene, path=imported.path))
