"""Which steps come before the import: what the capture lacks is made, what it has is skipped, with the reason."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines import import_scene, sfm
from rtgs.config.schema import RunConfig
from rtgs.pipeline import Step
from rtgs.prepare.source import find_source


@dataclass(frozen=True)
class SkippedStep:
    """A step the graph could hold and does not."""

    name: str
    why: str


@dataclass(frozen=True)
class Preparation:
    """The import of a scene, the steps it builds on, and those that are not needed."""

    scene: Step
    steps: tuple[Step, ...] = ()
    skipped: tuple[SkippedStep, ...] = ()


def prepare(config: RunConfig) -> Preparation:
    """The first steps of a run. Looks at the capture and hashes its files.

    Raises:
        CaptureError: the capture cannot be read.
        PrepareError: it has no poses and none may or can be looked for.
    """
    source = find_source(config.scene, config.sfm)
    if source.has_poses:
        scene = import_scene.STEP.step(import_scene.import_params(config.scene))
        return Preparation(scene, (), (SkippedStep("sfm", source.why),))
    poses = sfm.sfm_step(source, config.scene, config.sfm)
    scene = import_scene.STEP.step(import_scene.prepared_params(config.scene, source.path), poses)
    return Preparation(scene, (poses,))
