"""Masks of transparent objects for photos that have none, or in another form."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from rtgs.prepare.masks.settings import MaskSettings
from rtgs.scenes.settings import SceneSettings
from rtgs.workflow import NOT_IN_RECIPE, StepContext, StepKind


@dataclass(frozen=True)
class MaskParams:
    """What masks depend on: the photos, the way they are made, and what that reads; networks are tools of the step."""

    method: str
    """Key of :data:`rtgs.prepare.masks.report.METHODS`."""
    settings: MaskSettings
    """Without the places of networks."""
    scene: SceneSettings
    """What matters of it: which photos, where they lie in the capture; with an empty path."""
    capture: str
    """Digest of the capture, where no step before makes it."""
    marks: str
    """Digest of given masks or of the file of marks; empty: neither is read."""
    path: str = field(metadata=NOT_IN_RECIPE)
    source: str = field(metadata=NOT_IN_RECIPE)
    """Folder that holds given masks and the file of marks."""
    networks: tuple[str, ...] = field(metadata=NOT_IN_RECIPE)
    """Files of GroundingDINO, its tokenizer, SAM 2's encoder and decoder; empty: not used."""
    cache: str = field(metadata=NOT_IN_RECIPE)
    """Folder of single masks."""


def with_networks(settings: MaskSettings, files: tuple[str, ...]) -> MaskSettings:
    """The settings with the places of the networks' files, in the order of :class:`MaskParams`; () takes them out."""
    detector, tokenizer, encoder, decoder = files or ("",) * 4
    return replace(
        settings,
        detector=replace(settings.detector, file=detector, tokenizer=tokenizer),
        segmenter=replace(settings.segmenter, encoder=encoder, decoder=decoder),
    )


def masks(params: MaskParams, context: StepContext) -> None:
    """Write ``masks/<image name>.png``, ``masks.json``, ``masks.csv`` and ``masks.png``."""
    import torch

    from rtgs.prepare.masks.make import MaskRequest, make_masks

    path = str(context.inputs["sfm"]) if "sfm" in context.inputs else params.path
    request = MaskRequest(
        params.method,
        replace(params.scene, path=path),
        with_networks(params.settings, params.networks),
        Path(params.source),
        Path(params.cache),
        torch.get_num_threads(),
    )
    report = make_masks(request, context.out, context.log.info)
    context.tracker.metrics({"masks/made": float(report.masks), "masks/flagged": float(len(report.flagged))})


STEP = StepKind("masks", 3, masks)
