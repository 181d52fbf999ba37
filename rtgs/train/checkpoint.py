"""Checkpoints: safetensors for tensors, JSON for the rest; atomic, verified, never unpickled.

``folder/step_00000500/{state.safetensors, record.json}``. A checkpoint is written into a hidden sibling, flushed to
disk and renamed into place in one go; the newest two are kept, so that a damaged newest one still leaves a way on.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from rtgs.core.documents import load_json, parse_json
from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.core.recipe import left_out_at
from rtgs.core.records import record_of
from rtgs.core.refuse import cut
from rtgs.scenes.scene import Scene
from rtgs.train.settings import ScheduleSettings

FORMAT = 1
TENSORS_FILE = "state.safetensors"
RECORD_FILE = "record.json"
KEPT = 2
_TEMPORARY = ".writing_"


class CheckpointError(RtgsError):
    """A checkpoint that cannot be used: missing, damaged, or of another run. The message says what to do."""


@dataclass(frozen=True)
class CheckpointRecord:
    """Everything about a checkpoint that is not a tensor."""

    step: int  # steps done; training goes on with this step
    settings_digest: str  # of the method's settings, schedule and seed
    scene_digest: str
    threads: int  # bit-exact resumption needs the same number ...
    isa: str  # ... and the same instruction set
    versions: tuple[tuple[str, str], ...]  # (package, version)
    elapsed: float  # training time so far, seconds
    elapsed_cpu: float  # CPU time of it, all threads, seconds
    loss_average: float | None  # running averages shown to the user
    psnr_average: float | None
    order_position: int  # views of the current epoch already visited
    settings: str  # canonical JSON that settings_digest is of, for people and for messages


@dataclass(frozen=True)
class Checkpoint:
    """One moment of training."""

    record: CheckpointRecord
    tensors: dict[str, Tensor]  # dotted names; "method.*" is the method's own state


@dataclass(frozen=True)
class RunSettings:
    """What a run must share with the checkpoint it goes on from."""

    method: object  # what the stage reads of the method's settings, a dataclass
    schedule: ScheduleSettings
    seed: int


def canonical_json(settings: RunSettings) -> str:
    """Settings as one JSON text: sorted keys, floats by repr, NaN refused."""
    return json.dumps(asdict(settings), sort_keys=True, allow_nan=False)


def digest(text: str) -> str:
    """Short SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where the checkpoint of ``step`` lies in ``folder``."""
    return folder / f"step_{step:08d}"


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint atomically and return its path. Older ones go only after it is in place."""
    folder.mkdir(parents=True, exist_ok=True)
    final = checkpoint_path(folder, checkpoint.record.step)
    temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=folder))
    tensors_path = temporary / TENSORS_FILE
    save_file({name: tensor.detach().contiguous() for name, tensor in checkpoint.tensors.items()}, tensors_path)
    _flush(tensors_path)
    body = {"format": FORMAT, "tensors_sha256": sha256_of(tensors_path), "record": asdict(checkpoint.record)}
    record_path = temporary / RECORD_FILE
    record_path.write_text(json.dumps(body, indent=1, sort_keys=True, allow_nan=False))
    _flush(record_path)
    _flush(temporary)
    if final.exists():  # the same step again, after a resume from an older one
        shutil.rmtree(final)
    os.rename(temporary, final)
    _flush(folder)
    for old in _steps(folder)[:-KEPT]:
        shutil.rmtree(checkpoint_path(folder, old))
    for leftover in folder.glob(f"{_TEMPORARY}*"):  # of a killed writer; a folder has one writer at a time
        shutil.rmtree(leftover, ignore_errors=True)
    return final


def adopt_checkpoint(source: Path, folder: Path) -> Path:
    """Copy a verified checkpoint folder ``source`` into ``folder`` for a run that goes on from it; returns its path.

    Atomic like :func:`save_checkpoint`: a kill leaves the whole copy or none.

    Raises:
        CheckpointError: ``source`` is damaged.
    """
    final = checkpoint_path(folder, load_checkpoint(source).record.step)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=folder))
    for name in (TENSORS_FILE, RECORD_FILE):
        shutil.copyfile(source / name, temporary / name)
        _flush(temporary / name)
    _flush(temporary)
    os.rename(temporary, final)
    _flush(folder)
    return final


def load_checkpoint(path: Path) -> Checkpoint:
    """Read one checkpoint folder (``.../step_00000500``) and verify it.

    Raises:
        CheckpointError: a file is missing, truncated, altered, or of a format this version does not know.
    """
    record_path, tensors_path = path / RECORD_FILE, path / TENSORS_FILE
    for part in (record_path, tensors_path):
        if not part.is_file():
            raise CheckpointError(f"checkpoint {path}: {part.name} is missing; delete this folder to go on without it")
    try:
        body = load_json(record_path)
        if body["format"] != FORMAT:
            raise CheckpointError(
                f"checkpoint {path}: format {body['format']}, this version reads {FORMAT}; train again or use the "
                "version of rtgs that wrote it"
            )
        expected = str(body["tensors_sha256"])
        record = record_of(CheckpointRecord, body["record"], record_path)
        dict(record.versions)  # pairs
    except CheckpointError:
        raise
    except (RtgsError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"checkpoint {path}: {RECORD_FILE} is damaged ({cut(str(error), 400)}); delete this folder to go on "
            "without it"
        ) from error
    found = sha256_of(tensors_path)
    if found != expected:
        raise CheckpointError(
            f"checkpoint {path}: {TENSORS_FILE} is damaged (SHA-256 {found[:12]}..., {expected[:12]}... was written; "
            f"{tensors_path.stat().st_size} bytes); delete this folder to go on without it"
        )
    try:
        return Checkpoint(record, load_file(tensors_path))
    except SafetensorError as error:
        raise CheckpointError(f"checkpoint {path}: {TENSORS_FILE} does not read: {error}") from error


def load_newest(folder: Path, *, warn: Callable[[str], None]) -> Checkpoint | None:
    """The newest usable checkpoint in ``folder``; None where there is none at all.

    A damaged newest one is reported through ``warn`` and the one before it is taken.

    Raises:
        CheckpointError: there are checkpoints, and none of them is usable.
    """
    steps = _steps(folder)
    problems = []
    for step in reversed(steps):
        try:
            return load_checkpoint(checkpoint_path(folder, step))
        except CheckpointError as error:
            problems.append(str(error))
            warn(str(error))
    if problems:
        raise CheckpointError(
            f"no usable checkpoint among {len(steps)} in {folder}: {problems[0]}. Delete the folder to start again"
        )
    return None


def check_resumable(
    record: CheckpointRecord, now: CheckpointRecord, settings: RunSettings, *, warn: Callable[[str], None]
) -> None:
    """Compare a checkpoint with the run that wants to go on from it (``now``: the same facts of this process, made of
    ``settings``).

    Raises:
        CheckpointError: other settings or another scene: going on would mix two experiments.
    """
    same = record.settings_digest == now.settings_digest
    if differences := [] if same else _differences(record.settings, now.settings, settings):
        raise CheckpointError(
            f"the checkpoint was written with other settings: {'; '.join(differences)}. Use the same settings, or "
            "another output folder"
        )
    if record.scene_digest != now.scene_digest:
        raise CheckpointError(
            f"the checkpoint was trained on another scene or resolution (digest {record.scene_digest}, now "
            f"{now.scene_digest}). Use the same scene, or another output folder"
        )
    changed = [
        f"{what} {old} then, {new} now"
        for what, old, new in (
            ("threads:", record.threads, now.threads),
            ("instruction set:", record.isa, now.isa),
            *((f"{name}:", version, dict(now.versions).get(name)) for name, version in record.versions),
        )
        if old != new
    ]
    if changed:
        warn(f"resuming, but no longer bit for bit what an uninterrupted run gives: {', '.join(changed)}")


def _differences(old: str, new: str, settings: RunSettings) -> list[str]:
    """The first few settings that differ, as 'key: old then, new now'; see :func:`_added_settings` for newer keys."""
    added = dict(_added_settings(settings))
    before, after = ({**added, **_leaves(parse_json(text))} for text in (old, new))
    keys = [key for key in sorted(before.keys() | after.keys()) if before.get(key) != after.get(key)]
    shown = [f"{key}: {before.get(key)} then, {after.get(key)} now" for key in keys[:5]]
    return shown + ([f"and {len(keys) - 5} more"] if len(keys) > 5 else [])


def _leaves(value: object, prefix: str = "") -> dict[str, object]:
    """Dotted keys of nested mappings and lists."""
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return {prefix: value}
    return {key: leaf for name, child in items for key, leaf in _leaves(child, f"{prefix}.{name}".lstrip(".")).items()}


def _added_settings(value: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Keys that settings did not have once, with the value that says what was done then (:mod:`rtgs.core.recipe`): a
    run that an older version began goes on."""
    for item in fields(value) if is_dataclass(value) else ():
        key, inner = f"{prefix}{item.name}", getattr(value, item.name)
        if (before := left_out_at(item)) is not MISSING:
            whole = is_dataclass(before) and not isinstance(before, type)
            yield from _leaves(asdict(before) if whole else before, key).items()  # pyright: ignore
        yield from _added_settings(inner, f"{key}.")


def _steps(folder: Path) -> list[int]:
    """Steps of the checkpoints in ``folder``, oldest first."""
    return sorted(int(path.name.removeprefix("step_")) for path in folder.glob("step_[0-9]*") if path.is_dir())


def _flush(path: Path) -> None:
    """fsync a file or a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def scene_digest(scene: Scene) -> str:
    """Digest of training, test and pseudo views and points: cameras, and a sample of every image and normal map."""
    sha = hashlib.sha256()
    for view in (*scene.train, *scene.test, *scene.pseudo):
        camera = view.camera
        sha.update(repr((view.name, camera.fx, camera.fy, camera.cx, camera.cy, *view.image.shape)).encode())
        for tensor in (camera.rotation, camera.translation, view.image.flatten()[::97]):
            sha.update(tensor.contiguous().numpy().tobytes())
        sha.update(b"no normals" if view.normal is None else view.normal.flatten()[::97].contiguous().numpy().tobytes())
    sha.update(scene.points.contiguous().numpy().tobytes())
    return sha.hexdigest()[:16]
