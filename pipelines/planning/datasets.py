"""The papers' datasets: which of their scenes are in ``DATA_ROOT``, and where what is missing belongs.

The layouts are those of ``conf/scene/<dataset>/*.yaml`` (method.md 8.1, 8.2); nothing is downloaded.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rtgs.config.locate import choices_of
from rtgs.config.sweep import compose_jobs
from rtgs.core.errors import RtgsError
from rtgs.scenes.findings import missing_files
from rtgs.scenes.images import IMAGE_SUFFIXES
from rtgs.scenes.importers.colmap import find_model
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import CaptureError, SceneSettings

TITLES = {
    "ref_real": "Ref-NeRF's real captures (Ref-Real)",
    "nu_nerf": "NU-NeRF's real captures, after COLMAP",
}
VIEWS = {
    "ref_real/sedan": 158,
    "ref_real/gardenspheres": 151,
    "ref_real/toycar": 122,
}  # method.md 8.1; NU-NeRF tells none
_MODEL = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class SceneState:
    """One scene of a dataset on this disk."""

    choice: str  # of the config group ``scene``
    folder: Path
    photos: int  # that the model places
    missing: tuple[str, ...]  # what is not there, by the place where it belongs
    remarks: tuple[str, ...] = ()

    @property
    def ready(self) -> bool:
        """Can be trained on."""
        return not self.missing


def dataset_states(name: str, only: Sequence[str] = ()) -> tuple[SceneState, ...]:
    """Every scene of a dataset, or those of them that are named.

    Raises:
        RtgsError: no dataset of this name, or no such scene in it.
    """
    known = [choice for choice in choices_of("scene") if choice.startswith(f"{name}/")]
    if name not in TITLES or not known:
        raise RtgsError(f"data={name!r} is no dataset: choose one of {', '.join(TITLES)}")
    if unknown := [choice for choice in only if choice not in known]:
        raise RtgsError(f"scene={unknown[0]} is none of data={name}: choose among {', '.join(known)}")
    scenes = list(only) or known
    jobs, _ = compose_jobs([f"scene={','.join(scenes)}"], multirun=True)
    return tuple(_state(choice, job.config.scene) for choice, job in zip(scenes, jobs) if job.config is not None)


def _state(choice: str, scene: SceneSettings) -> SceneState:
    root = Path(scene.path)
    missing, remarks = [*_missing_model(root, scene), *_missing_photos(root, scene)], _mask_remarks(root, scene)
    if missing:
        return SceneState(choice, root, 0, tuple(missing), tuple(remarks))
    try:
        capture = read_capture(scene)
    except CaptureError as error:
        return SceneState(choice, root, 0, (str(error),), tuple(remarks))
    photos = [item for finding in missing_files(capture) for item in finding.items]
    count, expected = len(capture.views), VIEWS.get(choice)
    if expected not in (None, count):
        remarks.append(f"{count} photos where the papers have {expected}: figures are not comparable")
    return SceneState(choice, root, count, tuple(photos), tuple(remarks))


def _missing_model(root: Path, scene: SceneSettings) -> list[str]:
    assert scene.model_dir is not None
    if find_model(root, scene.model_dir):
        return []
    text = any((root / scene.model_dir / f"{part}.txt").is_file() for part in _MODEL)
    files = [root / scene.model_dir / f"{part}{'.txt' if text else '.bin'}" for part in _MODEL]
    elsewhere = find_model(root)
    hint = f" (there is a model in {elsewhere.relative_to(root)}/: move it)" if elsewhere else ""
    return [f"{file}{hint}" for file in files if not file.is_file()]


def _missing_photos(root: Path, scene: SceneSettings) -> list[str]:
    assert scene.images_dir is not None
    folder = root / scene.images_dir
    if folder.is_dir() and any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.rglob("*")):
        return []
    others = sorted(path.name for path in root.glob("images*") if path.is_dir() and path != folder)
    hint = f" (there is {', '.join(others)}: another size, whose figures are others)" if others else ""
    return [f"{folder}/ with the photos{hint}"]


def _mask_remarks(root: Path, scene: SceneSettings) -> list[str]:
    if scene.masks_dir in ("", "masks") or (root / scene.masks_dir).is_dir():
        return []
    return [f"without {root / scene.masks_dir}/, no figures inside the mask, and methods that see through glass stop"]


def check_dataset(name: str, only: Sequence[str] = ()) -> int:
    """Print what is there and what is missing; 0 when every scene, or every one of those named, can be trained on.

    Raises:
        RtgsError: no dataset of this name, or no such scene in it.
    """
    states = dataset_states(name, only)
    print(f"{TITLES[name]} in {os.environ.get('DATA_ROOT', 'data')} (DATA_ROOT):")
    for state in states:
        print(f"{state.choice}: {f'ready, {state.photos} photos' if state.ready else 'not ready; missing:'}")
        for item in state.missing:
            print(f"    {item}")
        for remark in state.remarks:
            print(f"    remark: {remark}")
    ready = [state.choice for state in states if state.ready]
    if len(ready) == len(states):
        return 0
    rest = f"; with what is there: RUN='scene={','.join(ready)}'" if ready else ""
    print(f"{len(ready)} of {len(states)} scenes are ready{rest}")
    return 1
