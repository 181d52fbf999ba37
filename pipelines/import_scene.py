"""Photos and poses become a Scene: read, undistorted, shrunk, split, filtered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rtgs.pipeline import NOT_IN_RECIPE, StepContext, StepKind
from rtgs.scenes.settings import SceneSettings


@dataclass(frozen=True)
class ImportParams:
    """What an imported scene depends on: the settings and the content of the files, not where they lie."""

    settings: SceneSettings
    """With an empty path."""
    capture: str
    """Digest of every file the import reads (:func:`rtgs.scenes.canonical.capture_digest`)."""
    path: str = field(metadata=NOT_IN_RECIPE)


def import_params(settings: SceneSettings) -> ImportParams:
    """Parameters of an import; reads the capture's poses and hashes its files.

    Raises:
        CaptureError: the capture cannot be read.
    """
    from rtgs.scenes.canonical import capture_digest

    return ImportParams(replace(settings, path=""), capture_digest(settings), settings.path)


def import_scene(params: ImportParams, context: StepContext) -> None:
    """Write ``scene.json`` and safetensors (:func:`rtgs.scenes.canonical.save_scene`)."""
    from rtgs.scenes.canonical import save_scene
    from rtgs.scenes.scene import load_scene

    save_scene(load_scene(replace(params.settings, path=params.path)), context.out)


STEP = StepKind(
    "import_scene",
    3,
    import_scene,
    helpers=(
        "rtgs.scenes.canonical",
        "rtgs.scenes.scene",
        "rtgs.scenes.images",
        "rtgs.scenes.truth",
        "rtgs.scenes.points",
        "rtgs.scenes.splits",
        "rtgs.scenes.undistort",
        "rtgs.scenes.colmap",
        "rtgs.scenes.transforms",
        "rtgs.scenes.blender",
    ),
)
