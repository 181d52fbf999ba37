"""Trainings in the store: what they were made with, and the trained method read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.build import build
from rtgs.core.documents import parse_json
from rtgs.core.errors import RtgsError
from rtgs.core.recipe import UNLESS, UNLESS_DEFAULT
from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import ScheduleSettings, WatchSettings
from rtgs.workflow.manifest import Manifest

if TYPE_CHECKING:
    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

CHECKPOINT_FOLDER = "checkpoint"
OBJECT_FOLDER = "object_mesh"
HISTORY_FILE = "history.jsonl"
PSEUDO_VIEWS = "pseudo_views"  # the step whose pictures a training learns beside the photos


@dataclass(frozen=True)
class StageParams:
    """One stage of a training: the recipe, the seed, and which stretch of steps.

    ``joined``: not 0 where the stage was trained up to this step and is gone on with, on held-out views as well.
    """

    method: MethodSettings
    schedule: ScheduleSettings
    seed: int
    stage: str
    from_step: int
    until: int
    watch: WatchSettings = field(default_factory=WatchSettings, metadata={"recipe": UNLESS, "value": WatchSettings()})
    joined: int = field(default=0, metadata=UNLESS_DEFAULT)


def stage_params(folder: Path) -> StageParams:
    """The parameters a training artifact was made with, from its manifest.

    Raises:
        RtgsError: the folder is no artifact.
    """
    manifest = Manifest.read(folder)
    if manifest is None:
        raise RtgsError(f"{folder} has no readable manifest: run `rtgs cache gc`, then the command again")
    return build(StageParams, manifest.params)


def load_method(folder: Path, scene: Scene) -> tuple[Model, StageParams]:
    """The method as it was at the end of a training stage, with the object mesh that the artifact carries."""
    from rtgs.methods import create_method
    from rtgs.train.checkpoint import load_checkpoint
    from rtgs.train.seeds import generator_for

    params = stage_params(folder)
    generator = generator_for(params.seed, "initialise")
    method = create_method(params.method, scene, params.schedule, generator, object_mesh_of(folder))
    tensors = load_checkpoint(folder / CHECKPOINT_FOLDER).tensors
    prefix = "method."
    method.load({name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)})
    return method, params


def object_mesh_of(folder: Path) -> ObjectMesh | None:
    """The mesh of the transparent object that a training artifact carries; None: it has none."""
    from rtgs.mesh.container import read_object_mesh

    return read_object_mesh(folder / OBJECT_FOLDER) if (folder / OBJECT_FOLDER).is_dir() else None


def read_history(folder: Path) -> list[dict[str, float]]:
    """Recorded metrics of a training artifact: one mapping per iteration, with its ``step``."""
    lines = (folder / HISTORY_FILE).read_text(encoding="utf-8").splitlines()
    return [{key: value for key, value in parse_json(line).items() if value is not None} for line in lines]


def has_training(inputs: Mapping[str, Path]) -> bool:
    """Whether a training is among the inputs of a step; without one the pictures are another program's."""
    return any(name.startswith("train_") for name in inputs)


def last_training(inputs: Mapping[str, Path]) -> Path:
    """The folder of the training stage that ends latest among the inputs of a step.

    Raises:
        RtgsError: no training artifact among them.
    """
    folders = [folder for name, folder in inputs.items() if name.startswith("train_")]
    if not folders:
        raise RtgsError(f"no training step among the inputs {sorted(inputs)}")
    return max(folders, key=lambda folder: stage_params(folder).until)
