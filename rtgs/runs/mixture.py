"""Pictures of several models, ready to render: what a judge decided, with the plain method's pixels where it kept that,
and the mean of an ensemble."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rtgs.evaluate.judgement import JudgeRecord
from rtgs.runs.training import OBJECT_FOLDER, last_training, load_method

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.regions import Regions
    from rtgs.methods import RenderOptions
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

JUDGE = "judge"  # names of steps: of the one that decides,
PLAIN = "plain"  # of the one that trains the plain method
REST = "_rest"  # and what the names of those end with that go on with a training after both were judged
MEMBER = "member"  # what the names of the steps begin with that train the further models of an ensemble
TRAININGS = ("train_", PLAIN)  # what the names of the steps begin with that train what a judge compares


def plain_training(inputs: Mapping[str, Path]) -> Path:
    """The artifact of the plain method's training as it ended, among the inputs of a step."""
    return inputs.get(PLAIN + REST, inputs[PLAIN])


def regions_of(inputs: Mapping[str, Path]) -> Regions:
    """The regions that are judged each by itself: those of the object mesh of the last training, where it has one."""
    from rtgs.evaluate.regions import Regions
    from rtgs.mesh.container import read_object_mesh

    folder = last_training(inputs) / OBJECT_FOLDER
    return Regions(read_object_mesh(folder) if folder.is_dir() else None)


def member_name(number: int, step: str = "") -> str:
    """Of a step of an ensemble: the one that ends a further model's training, or ``step`` on the way there."""
    return f"{MEMBER}_{number}_{step}" if step else f"{MEMBER}_{number}"


def is_member(name: str) -> bool:
    """Whether a step of this name ends the training of a further model."""
    return re.fullmatch(rf"{MEMBER}_[0-9]+", name) is not None


def members_of(inputs: Mapping[str, Path]) -> tuple[Path, ...]:
    """The artifacts of an ensemble's further models, as their trainings ended; empty: there is one model."""
    return tuple(folder for name, folder in inputs.items() if is_member(name))


def evaluated(
    method: Model, step: int, camera: Camera, mask: Tensor | None = None, options: RenderOptions | None = None
) -> Tensor:
    """(3, H, W) as a test view with this mask (H, W) bool is rendered."""
    import torch

    from rtgs.methods import Mode, RenderOptions

    with torch.no_grad():
        return method.render(camera, step, Mode.EVALUATE, options or RenderOptions(), mask=mask).image


class Mixture(Protocol):
    """Makes the picture that counts of the run's model's and of other models'."""

    def of(
        self, camera: Camera, image: Tensor, mask: Tensor | None = None, options: RenderOptions | None = None
    ) -> Tensor:
        """(3, H, W) from this camera; ``image`` is the run's model's, rendered with ``mask`` and ``options``."""
        ...


@dataclass(frozen=True)
class Ensemble:
    """Shows the mean of the pictures of all models, each within 0 and 1.

    Its squared error is never above the mean of theirs, by what their pictures differ (Krogh and Vedelsby, "Neural
    network ensembles, cross validation, and active learning", 1995).
    """

    members: tuple[tuple[Model, int], ...]  # without the run's own; each with the step as of which it is rendered

    def of(
        self, camera: Camera, image: Tensor, mask: Tensor | None = None, options: RenderOptions | None = None
    ) -> Tensor:
        """(3, H, W) the mean of ``image`` and the others' pictures from this camera."""
        import torch

        others = [evaluated(method, step, camera, mask, options) for method, step in self.members]
        return torch.stack([image, *others]).clamp(0, 1).mean(0)


@dataclass(frozen=True)
class Judged:
    """Puts the plain method's pixels where the judge kept it."""

    regions: Regions
    replaced: tuple[int, ...]
    plain: Model
    step: int

    def of(
        self, camera: Camera, image: Tensor, mask: Tensor | None = None, options: RenderOptions | None = None
    ) -> Tensor:
        """(3, H, W) ``image`` of the full method from this camera, with what the judge replaced: plain methods know no
        masks."""
        from rtgs.evaluate.regions import mixed

        return mixed(image, evaluated(self.plain, self.step, camera), self.regions.numbers(camera), self.replaced)


def read_mixture(inputs: Mapping[str, Path], scene: Scene) -> Mixture | None:
    """The other models that the pictures are of, ready to render.

    None: there are none; or a judge kept the full method everywhere.
    """
    if folders := members_of(inputs):
        loaded = (load_method(folder, scene) for folder in folders)
        return Ensemble(tuple((method, stage.until) for method, stage in loaded))
    if JUDGE not in inputs:
        return None
    replaced = JudgeRecord.read(inputs[JUDGE]).replaced
    if not replaced:
        return None
    plain, stage = load_method(plain_training(inputs), scene)
    return Judged(regions_of(inputs), replaced, plain, stage.until)
