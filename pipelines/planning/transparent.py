"""Whether a run gets the third stage: known from the capture's masks before anything runs."""

from __future__ import annotations

from typing import NamedTuple

from pipelines.planning.inspection import Inspection
from pipelines.planning.preparation import Preparation
from rtgs.config.schema import RunConfig
from rtgs.mesh.settings import COVERED
from rtgs.methods import find_method


class Transparency(NamedTuple):
    """Whether the scene has a transparent object, and why that is thought."""

    present: bool
    why: str


def find_transparency(config: RunConfig, inspection: Inspection, prepared: Preparation) -> Transparency:
    """Look at the masks of the capture, as far as the first that bounds something. A step that makes masks is believed:
    should they be empty, the third stage says so and changes nothing.

    Raises:
        CaptureError: a mask cannot be read.
    """
    if find_method(config.method.name).object_stage(config.method) is None:
        return Transparency(False, "method.transmittance.enabled=false")
    if any(step.name == "masks" for step in prepared.steps):
        return Transparency(True, "masks are made")
    files = inspection.mask_files
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
