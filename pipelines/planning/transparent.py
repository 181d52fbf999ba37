"""Whether a run gets the stage for transparent objects: known from the capture's masks before anything runs."""

from __future__ import annotations

from typing import NamedTuple

from pipelines.planning.inspection import Inspection
from pipelines.planning.preparation import Preparation
from rtgs.config.schema import RunConfig
from rtgs.mesh.settings import COVERED
from rtgs.methods import StageSpec, find_method
from rtgs.scenes.settings import CaptureError, SceneSettings


class Transparency(NamedTuple):
    """Whether the scene has a transparent object, and why that is thought."""

    present: bool
    why: str


def find_transparency(config: RunConfig, inspection: Inspection, prepared: Preparation) -> Transparency:
    """Look at the masks of the capture, as far as the first that bounds something. A step that makes masks is believed:
    should they be empty, that stage says so and changes nothing.

    Raises:
        CaptureError: a mask cannot be read, or the scene names a folder of masks and none is there: the row of a table
            would be called by a method whose stage for glass was left out.
    """
    spec = find_method(config.method.name)
    if spec.object_stage(config.method) is None:
        off = next((stage for stage in spec.stages if stage.needs_object), None)
        why = f"method {spec.name} has no stage for them" if off is None else _switched_off(off)
        return Transparency(False, why)
    if any(step.name == "masks" for step in prepared.steps):
        return Transparency(True, "masks are made")
    files = inspection.mask_files
    if not files and config.scene.masks_dir not in ("", SceneSettings().masks_dir):
        raise CaptureError(_masks_wanted(config, inspection))
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


def _masks_wanted(config: RunConfig, inspection: Inspection) -> str:
    folder = inspection.folder / config.scene.masks_dir
    return (
        f"scene {config.scene.name} has its masks in {folder} (scene.masks_dir={config.scene.masks_dir}), and there is "
        f"none of a photo of it: {config.method.name} would train without its stage for transparent objects. Put them "
        "there, or draw some (masks=polygon); without masks: ablation=two_stages, or masks=none"
    )


def _switched_off(stage: StageSpec) -> str:
    return f"{stage.on_key} switches it off" if stage.on_key else f"the method's settings switch {stage.name} off"
