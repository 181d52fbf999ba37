"""Photos or a video without poses become a capture with poses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from rtgs.prepare.settings import SfmSettings
from rtgs.prepare.source import Source
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import NOT_IN_RECIPE, Step, StepContext, StepKind


@dataclass(frozen=True)
class SfmParams:
    """What found poses depend on: the settings and the content of the photos, not where they lie."""

    settings: SfmSettings
    images_dir: str | None
    masks_dir: str
    normals_dir: str
    normals_frame: str
    background: tuple[float, float, float]
    source: str
    """Digest of everything that is read (:func:`rtgs.prepare.source.source_digest`)."""
    path: str = field(metadata=NOT_IN_RECIPE)


def sfm_step(source: Source, scene: SceneSettings, settings: SfmSettings) -> Step:
    """The step for a source without poses; hashes its files.

    Raises:
        CaptureError: a file cannot be read.
    """
    from importlib.metadata import version

    from rtgs.prepare.source import source_digest

    params = SfmParams(
        replace(settings, use="auto"),
        scene.images_dir,
        scene.masks_dir,
        scene.normals_dir,
        scene.normals_frame,
        scene.background,
        source_digest(source, scene, settings),
        str(source.path),
    )
    return STEP.step(params, tools=(("pycolmap", version("pycolmap")),))


def sfm(params: SfmParams, context: StepContext) -> None:
    """Write ``images/``, ``sparse/0``, ``masks/``, ``normals/``, ``sfm.json``, ``coverage.png``."""
    import torch

    from rtgs.prepare.poses.find import Request, find_poses

    request = Request(
        Path(params.path),
        params.images_dir,
        params.masks_dir,
        params.normals_dir,
        params.normals_frame,
        params.background,
    )
    report = find_poses(
        request, params.settings, context.partial, context.out, torch.get_num_threads(), context.log.info
    )
    context.tracker.metrics(
        {
            "sfm/registered": float(report.registered),
            "sfm/photos": float(report.photos),
            "sfm/reprojection_error": report.reprojection_error,
            "sfm/track_length": report.track_length,
        }
    )


STEP = StepKind("sfm", 5, sfm)
