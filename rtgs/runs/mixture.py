"""What a judge decided, ready to render: the full method with the plain one's pixels where it kept that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.evaluate.judgement import JudgeRecord
from rtgs.runs.training import OBJECT_FOLDER, last_training, load_method

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.regions import Regions
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

JUDGE = "judge"  # names of steps: of the one that decides,
PLAIN = "plain"  # of the one that trains the plain method
REST = "_rest"  # and what the names of those end with that go on with a training after both were judged
TRAININGS = ("train_", PLAIN)  # what the names of all steps that train begin with


def plain_training(inputs: Mapping[str, Path]) -> Path:
    """The artifact of the plain method's training as it ended, among the inputs of a step."""
    return inputs.get(PLAIN + REST, inputs[PLAIN])


def regions_of(inputs: Mapping[str, Path]) -> Regions:
    """The regions that are judged each by itself: those of the object mesh of the last training, where it has one."""
    from rtgs.evaluate.regions import Regions
    from rtgs.mesh.container import read_object_mesh

    folder = last_training(inputs) / OBJECT_FOLDER
    return Regions(read_object_mesh(folder) if folder.is_dir() else None)


def evaluated(method: Model, step: int, camera: Camera, mask: Tensor | None = None) -> Tensor:
    """(3, H, W) as a test view with this mask (H, W) bool is rendered."""
    import torch

    from rtgs.methods import Mode

    with torch.no_grad():
        return method.render(camera, step, Mode.EVALUATE, mask=mask).image


@dataclass(frozen=True)
class Mixture:
    """Puts the plain method's pixels where the judge kept it."""

    regions: Regions
    replaced: tuple[int, ...]
    plain: Model
    step: int

    def of(self, camera: Camera, image: Tensor) -> Tensor:
        """(3, H, W) ``image`` of the full method from this camera, with what the judge replaced."""
        from rtgs.evaluate.regions import mixed

        return mixed(image, evaluated(self.plain, self.step, camera), self.regions.numbers(camera), self.replaced)


def read_mixture(inputs: Mapping[str, Path], scene: Scene) -> Mixture | None:
    """What the judge decided, ready to render; None: there was no judge, or it kept the full method everywhere."""
    if JUDGE not in inputs:
        return None
    replaced = JudgeRecord.read(inputs[JUDGE]).replaced
    if not replaced:
        return None
    plain, stage = load_method(plain_training(inputs), scene)
    return Mixture(regions_of(inputs), replaced, plain, stage.until)
