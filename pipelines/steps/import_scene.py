"""Photos and poses become a Scene: read, undistorted, shrunk, split, filtered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import NOT_IN_RECIPE, StepContext, StepKind


@dataclass(frozen=True)
class ImportParams:
    """What an imported scene depends on: the settings and the content of the files, not where they lie."""

    settings: SceneSettings
    """With an empty path."""
    capture: str
    """Digest of every file the import reads (:func:`rtgs.scenes.digest.capture_digest`)."""
    path: str = field(metadata=NOT_IN_RECIPE)


def import_params(settings: SceneSettings, digest: str) -> ImportParams:
    """Parameters of the import of a capture; ``digest``: of every file that the import reads."""
    return ImportParams(replace(settings, path=""), digest, settings.path)


def prepared_params(settings: SceneSettings, source: Path) -> ImportParams:
    """Parameters of the import of a capture that a step before it makes out of ``source`` (photos, a video).

    Of the original only ``split_file`` is read; what the capture consists of is in the key of the step before.

    Raises:
        CaptureError: the split file cannot be read.
    """
    from rtgs.scenes.digest import files_digest

    root = source if source.is_dir() else source.parent
    split = "" if settings.split_file is None else files_digest("split", root, [root / settings.split_file])
    made = replace(
        settings,
        path="",
        format="colmap",
        images_dir=None,
        model_dir=None,
        masks_dir="masks" if settings.masks_dir else "",
        normals_dir="normals" if settings.normals_dir else "",
        normals_frame="opencv",
    )
    return ImportParams(made, split, str(root))


def import_scene(params: ImportParams, context: StepContext) -> None:
    """Write ``scene.json`` and safetensors (:func:`rtgs.scenes.canonical.save_scene`)."""
    from rtgs.scenes.canonical import save_scene
    from rtgs.scenes.scene import load_scene

    settings = replace(params.settings, path=params.path)
    if "sfm" in context.inputs:
        split = settings.split_file and str(Path(params.path, settings.split_file).absolute())
        settings = replace(settings, path=str(context.inputs["sfm"]), split_file=split)
    if "masks" in context.inputs:
        settings = replace(settings, masks_dir=str((context.inputs["masks"] / "masks").absolute()))
    if "normals" in context.inputs:
        maps = str((context.inputs["normals"] / "normals").absolute())
        settings = replace(settings, normals_dir=maps, normals_frame="opencv")
    save_scene(load_scene(settings), context.out)


STEP = StepKind("import_scene", 6, import_scene)
