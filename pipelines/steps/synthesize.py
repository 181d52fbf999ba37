"""A described scene becomes a path-traced capture with known truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.display import display_for
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.workflow import NOT_IN_RECIPE, Step, StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.scenes.synthetic.description import SceneDescription


@dataclass(frozen=True)
class SynthesizeParams:
    """What a synthetic capture depends on."""

    scene: str
    description: str
    """SHA-256 of the scene's description (:func:`rtgs.scenes.synthetic.capture.description_digest`)."""
    settings: CaptureSettings
    file: str = field(metadata=NOT_IN_RECIPE)
    """The scene file."""
    variant: str | None = field(default=None, metadata=NOT_IN_RECIPE)
    """Of Mitsuba; None: the fastest here."""


def synthesize(params: SynthesizeParams, context: StepContext) -> None:
    """Write the capture; finished views are kept in the partial folder until all are there."""
    from rtgs.scenes.synthetic.capture import write_capture
    from rtgs.scenes.synthetic.description import read_description
    from rtgs.scenes.synthetic.variants import choose_variant

    variant, why = (params.variant, "as asked for") if params.variant else choose_variant()
    context.log.info("%s: rendered by Mitsuba's %s, %s", params.scene, variant, why)
    display = display_for()
    try:
        record = write_capture(
            read_description(Path(params.file)),
            context.out,
            context.partial,
            params.settings,
            variant=variant,
            progress=lambda name, share: display.update(f"{params.scene} {name}", share),
        )
    finally:
        display.close()
    numbers = {"noise_psnr": record.noise_psnr, "seconds": record.seconds, "points": float(record.points)}
    context.tracker.metrics(numbers)
    context.log.info(
        "%s: %d views of %dx%d, test images %.1f dB from converged (worst %.1f)",
        record.name, record.views, record.width, record.height, record.noise_psnr, record.noise_psnr_worst,
    )  # fmt: skip


STEP = StepKind("synthesize", 3, synthesize)


def synthesize_step(description: SceneDescription, file: Path, settings: CaptureSettings, variant: str | None) -> Step:
    """The step that makes one capture."""
    from rtgs.scenes.synthetic.capture import description_digest

    digest = description_digest(description)
    return STEP.step(SynthesizeParams(description.name, digest, settings, str(file), variant))
