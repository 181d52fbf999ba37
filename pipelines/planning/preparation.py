"""Which steps come before the import: what the capture lacks is made, what it has is skipped, with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pipelines.planning.inspection import Inspection
from pipelines.planning.mask_plan import mask_step, plan_masks
from pipelines.steps import import_scene, normals, sfm
from rtgs.config.schema import RunConfig
from rtgs.core.decisions import Decision
from rtgs.workflow import Step


@dataclass(frozen=True)
class Preparation:
    """The import of a scene, the steps it builds on, and those that are not needed: ``what`` is the step's name."""

    scene: Step
    steps: tuple[Step, ...] = ()
    skipped: tuple[Decision, ...] = ()


def prepare(config: RunConfig, inspection: Inspection) -> Preparation:
    """The first steps of a run on the capture that was looked at. Hashes its files.

    Raises:
        CaptureError: files of the capture are missing.
        MissingWeights: ``normals.use=always`` or ``masks=grounded_sam2`` and no network.
    """
    source = inspection.source
    steps: list[Step] = []
    skipped: list[Decision] = []
    if source.has_poses:
        params = import_scene.import_params(config.scene, inspection.digest)
        skipped.append(Decision("sfm", source.why))
    else:
        params = import_scene.prepared_params(config.scene, source.path)
        steps.append(sfm.sfm_step(source, config.scene, config.sfm))
    before = tuple(steps)
    planned = plan_masks(config, inspection)
    if planned.method:
        steps.append(mask_step(config, inspection, planned.method, params, before))
    else:
        skipped.append(Decision("masks", planned.why))
    why = _why_no_normals(config, inspection)
    if why:
        skipped.append(Decision("normals", why))
    else:
        steps.append(_normals_step(config, inspection, params, before))
    return Preparation(import_scene.STEP.step(params, *steps), tuple(steps), tuple(skipped))


def _why_no_normals(config: RunConfig, inspection: Inspection) -> str:
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
        if given := inspection.given_normals:
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


def _normals_step(
    config: RunConfig, inspection: Inspection, imported: import_scene.ImportParams, before: tuple[Step, ...]
) -> Step:
    from importlib.metadata import version

    from rtgs.prepare.normals.make import find_network

    settings = config.normals
    path, digest = find_network(settings)
    params = normals.NormalParams(
        replace(settings, use="auto", file="stated", sha256=""),  # its place is no part of the recipe, its digest is
        normals.photo_settings(imported.settings),
        "" if before else inspection.photo_digest,
        imported.path,
        str(path),
        str(Path(config.paths.store) / "single_normals"),
    )
    return normals.STEP.step(params, *before, tools=(("network", digest), ("onnxruntime", version("onnxruntime"))))
