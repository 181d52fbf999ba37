"""Monocular normals for photos that have none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rtgs.prepare.settings import NormalSettings
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import NOT_IN_RECIPE, StepContext, StepKind


@dataclass(frozen=True)
class NormalParams:
    """What normal maps depend on: the photos, the network (its digest is a tool of the step) and its adapter."""

    settings: NormalSettings
    """With an empty file."""
    scene: SceneSettings
    """What matters of it: which photos, where they lie in the capture; with an empty path."""
    capture: str
    """Digest of the capture, where no step before makes it."""
    path: str = field(metadata=NOT_IN_RECIPE)
    file: str = field(metadata=NOT_IN_RECIPE)
    cache: str = field(metadata=NOT_IN_RECIPE)
    """Folder of single maps."""


def photo_settings(scene: SceneSettings) -> SceneSettings:
    """The part of the settings that chooses photos and cameras: what the normals of a photo can depend on."""
    return SceneSettings(
        format=scene.format,
        images_dir=scene.images_dir,
        model_dir=scene.model_dir,
        max_views=scene.max_views,
        background=scene.background,
        masks_dir="",
        normals_dir="",
    )


def normals(params: NormalParams, context: StepContext) -> None:
    """Write ``normals/<image name>.npy`` and ``normals.json``."""
    from pathlib import Path

    import torch

    from rtgs.prepare.normals.make import make_normals

    path = str(context.inputs["sfm"]) if "sfm" in context.inputs else params.path
    settings = replace(params.settings, file=params.file)
    scene = replace(params.scene, path=path)
    make_normals(scene, settings, Path(params.cache), context.out, torch.get_num_threads(), context.log.info)


STEP = StepKind("normals", 2, normals)
