"""Whether a run gets the third stage: known from the capture's masks before anything runs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pipelines.planning.preparation import Preparation
from rtgs.config.schema import RunConfig
from rtgs.mesh.settings import COVERED
from rtgs.methods import find_method
from rtgs.prepare.source import find_source


class Transparency(NamedTuple):
    """Whether the scene has a transparent object, and why that is thought."""

    present: bool
    why: str


def find_transparency(config: RunConfig, prepared: Preparation) -> Transparency:
    """Look at the masks of the capture, as far as the first that bounds something. A step that makes masks is believed:
    should they be empty, the third stage says so and changes nothing.

    Raises:
        CaptureError: a mask cannot be read.
    """
    if find_method(config.method.name).object_stage(config.method) is None:
        return Transparency(False, "method.transmittance.enabled=false")
    if any(step.name == "masks" for step in prepared.steps):
        return Transparency(True, "masks are made")
    files = _mask_files(config)
    if not files:
        return Transparency(False, "the scene has no masks of transparent objects")
    from rtgs.scenes.images import read_mask

    full = 0
    for path in files:
        share = float(read_mask(path).mean())
        if 0 < share < COVERED:
            return Transparency(True, f"{path.name} shows a transparent object")
        full += share >= COVERED
    if full:
        others = "" if full == len(files) else ", the others are empty"
        why = f"{full} of {len(files)} masks cover the whole picture{others}: nothing tells glass from room"
        return Transparency(False, why)
    return Transparency(False, f"all {len(files)} masks of the scene are empty")


def _mask_files(config: RunConfig) -> list[Path]:
    from rtgs.scenes.images import MASK_SUFFIXES
    from rtgs.scenes.importers.registry import read_capture

    scene = config.scene
    source = find_source(scene, config.sfm)
    if source.has_poses:
        return [view.mask for view in read_capture(scene).views if view.mask is not None]
    if not scene.masks_dir or not source.path.is_dir():
        return []
    folder = source.path / scene.masks_dir
    return sorted(path for path in folder.rglob("*") if path.suffix in MASK_SUFFIXES) if folder.is_dir() else []
