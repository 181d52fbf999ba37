"""Which importer reads a capture."""

from __future__ import annotations

import os
from pathlib import Path

from rtgs.scenes.capture import Capture
from rtgs.scenes.importers.blender import is_blender, read_blender
from rtgs.scenes.importers.colmap import find_model, incomplete_model, read_colmap
from rtgs.scenes.importers.embedded import embedded_capture
from rtgs.scenes.importers.transforms import is_transforms, read_transforms
from rtgs.scenes.settings import CaptureError, SceneSettings

EMBEDDED_PREFIX = "embedded:"


def capture_root(settings: SceneSettings) -> Path:
    """The folder of the capture.

    Raises:
        CaptureError: no path, or a path that is missing or not a folder.
    """
    if not settings.path:
        raise CaptureError(f"scene {settings.name!r}: scene.path is empty, give the folder of the capture")
    if settings.path.startswith(EMBEDDED_PREFIX):
        return embedded_capture(settings.path.removeprefix(EMBEDDED_PREFIX))
    root = Path(os.path.expandvars(settings.path)).expanduser()
    if not root.exists():
        there = "correct scene.path, or let `rtgs get` bring a capture"
        raise CaptureError(f"capture folder {root} does not exist (from {Path.cwd()}): {there}")
    if not root.is_dir():
        raise CaptureError(f"capture {root} is a file: scene.path names the folder that holds images and model")
    return root


def detect_format(root: Path, settings: SceneSettings) -> str:
    """The named format, or the first of colmap, transforms, blender whose files are there.

    Raises:
        CaptureError: none of them.
    """
    if found := find_format(root, settings):
        return found
    if partial := incomplete_model(root, settings.model_dir):
        raise CaptureError(f"{partial}: copy the whole folder, or export the model again")
    content = ", ".join(sorted(p.name for p in root.iterdir())[:10]) or "nothing"
    raise CaptureError(
        f"{root} is no capture: neither a COLMAP model (sparse/0/cameras.bin ...), transforms.json, nor "
        f"transforms_train.json is there, but {content}; correct scene.path, let `rtgs run` look for poses "
        "(sfm.use=auto), or run COLMAP on the photos first"
    )


def find_format(root: Path, settings: SceneSettings) -> str | None:
    """The named format, or the first of colmap, transforms, blender whose files are there; None: no poses."""
    if settings.format != "auto":
        return settings.format
    if find_model(root, settings.model_dir) is not None:
        return "colmap"
    if is_transforms(root):
        return "transforms"
    return "blender" if is_blender(root) else None


def read_capture(settings: SceneSettings) -> Capture:
    """Read poses, lenses and points of a capture; no pixels.

    Raises:
        CaptureError: the capture is missing or its description cannot be read.
    """
    root = capture_root(settings)
    readers = {"colmap": read_colmap, "transforms": read_transforms, "blender": read_blender}
    return readers[detect_format(root, settings)](settings, root)
