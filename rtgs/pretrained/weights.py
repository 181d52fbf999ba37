"""Pretrained files: what they are called, where they are looked for, how they are verified. Nothing is downloaded.

The mechanism, and the files the metrics need; :mod:`rtgs.prepare.pretrained` adds those of the preparation and is the
whole registry, which ``rtgs weights status`` prints.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of

if TYPE_CHECKING:
    from torch import Tensor

SUMS_FILE = "SHA256SUMS"
REACHES = ()  # the files are looked for; which there are is for the recipe to say


class MissingWeights(RtgsError):
    """A pretrained file is not on this machine. The message names the places searched and where to get it."""


class WrongWeights(RtgsError):
    """A pretrained file is there but is not the expected one."""


@dataclass(frozen=True)
class PretrainedFile:
    """One pretrained file this project can use."""

    name: str  # key in the registry
    filename: str  # relative to a weights folder
    sha256: str  # of the whole file; empty: not known, since people export it themselves
    megabytes: float
    licence: str
    source: str  # a page to read, in words; never fetched by the program
    used_for: str
    export: str = ""  # how to make it, where it is not published in this form


VGG16 = PretrainedFile(
    name="vgg16",
    filename="vgg16-397923af.pth",
    sha256="397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    megabytes=528.0,
    licence="torchvision BSD-3-Clause; trained on ImageNet, whose terms are for research",
    source="torchvision's model page for VGG16_Weights.IMAGENET1K_V1 (download.pytorch.org/models/vgg16-397923af.pth)",
    used_for="the features of LPIPS and of the perceptual loss",
)
LPIPS_VGG = PretrainedFile(
    name="lpips_vgg",
    filename="lpips_v0.1/vgg.pth",
    sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    megabytes=0.01,
    licence="BSD-2-Clause",
    source="github.com/richzhang/PerceptualSimilarity, lpips/weights/v0.1/vgg.pth",
    used_for="the linear heads of LPIPS v0.1",
)
REGISTRY: dict[str, PretrainedFile] = {file.name: file for file in (VGG16, LPIPS_VGG)}


@dataclass(frozen=True)
class WeightStatus:
    """What is known of one pretrained file on this machine."""

    file: PretrainedFile
    path: Path | None
    problem: str  # empty when the file is there and its SHA-256 agrees


def weight_folders() -> tuple[Path, ...]:
    """Folders searched, first match wins.

    ``RTGS_WEIGHTS``; ``~/.cache/rtgs/weights``; ``weights/`` beside the package; ``$RTGS_SHARED/data/weights`` when
    ``RTGS_SHARED`` is set; torch's own cache of checkpoints, where torchvision would have put the VGG.
    """
    folders: list[Path] = []
    if os.environ.get("RTGS_WEIGHTS"):
        folders.append(Path(os.environ["RTGS_WEIGHTS"]).expanduser())
    folders.append(Path("~/.cache/rtgs/weights").expanduser())
    folders.append(Path(__file__).resolve().parents[2] / "weights")
    if os.environ.get("RTGS_SHARED"):
        folders.append(Path(os.environ["RTGS_SHARED"]).expanduser() / "data" / "weights")
    folders.append(_torch_cache() / "hub" / "checkpoints")
    return tuple(folders)


def _torch_cache() -> Path:
    """Where torch keeps what it downloads (``torch.hub``'s documentation), found without loading torch."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME") or os.path.join(cache, "torch")
    return Path(os.path.expanduser(home))  # unlike Path.expanduser, does not raise for a user without a home


def find_weights(file: PretrainedFile, folders: Iterable[Path] | None = None) -> Path:
    """Path of a pretrained file; its content is not looked at (see :func:`verify_weights`).

    Raises:
        MissingWeights: in none of the folders.
    """
    searched = tuple(weight_folders() if folders is None else folders)
    for folder in searched:
        if (folder / file.filename).is_file():
            return folder / file.filename
    places = ", ".join(_readable(folder) for folder in searched)
    how = f" Made by: {file.export}." if file.export else ""
    raise MissingWeights(
        f"weights missing: {file.filename} ({file.megabytes:g} MB, {file.used_for}); searched {places}. "
        f"Get it from {file.source} (licence: {file.licence}) and put it into one of these folders, "
        f"or point RTGS_WEIGHTS to yours.{how}"
    )


def _readable(folder: Path) -> str:
    """A folder as a person would name it: the same words on every machine."""
    root = Path(__file__).resolve().parents[2]
    if folder.is_relative_to(root):
        return f"{folder.relative_to(root)}/ beside the package"
    for variable in ("RTGS_WEIGHTS", "RTGS_SHARED"):
        if (place := os.environ.get(variable)) and folder.is_relative_to(Path(place).expanduser()):
            return str(Path(f"${variable}") / folder.relative_to(Path(place).expanduser()))
    return f"~/{folder.relative_to(Path.home())}" if folder.is_relative_to(Path.home()) else str(folder)


def verify_weights(file: PretrainedFile, path: Path) -> None:
    """Compare the SHA-256 of ``path`` with the registered one, and with that in ``SHA256SUMS``; nothing where there is
    neither.

    Raises:
        WrongWeights: they differ: another model, or a download cut short.
    """
    if not (file.sha256 or noted_digest(path)):
        return
    digest = sha256_of(path)
    check_noted_digest(path, digest)
    if file.sha256 and digest != file.sha256:
        raise WrongWeights(
            f"{path} is not {file.filename}: SHA-256 {digest[:16]}..., expected {file.sha256[:16]}... "
            f"({path.stat().st_size / 2**20:.1f} MB, expected about {file.megabytes:g} MB). "
            f"Fetch it again from {file.source}"
        )


def noted_digest(path: Path) -> str:
    """The SHA-256 a person noted for a file, as ``sha256sum`` writes it, in the ``SHA256SUMS`` of its folder or of the
    folder above; empty: none.

    Raises:
        WrongWeights: that file is no list of digests.
    """
    for folder in path.parents[:2]:
        listed = folder / SUMS_FILE
        if not listed.is_file():
            continue
        for line in listed.read_text(encoding="utf-8").splitlines():
            digest, _, name = line.partition(" ")
            if line.strip() and not (len(digest) == 64 and name.strip()):
                raise WrongWeights(f"{listed}: {line[:40]!r} is no line of sha256sum (digest, two blanks, file name)")
            if name.strip().removeprefix("*").removeprefix("./") == path.relative_to(folder).as_posix():
                return digest.lower()
    return ""


def check_noted_digest(path: Path, digest: str) -> None:
    """Compare the SHA-256 of a file with the noted one, if there is one.

    Raises:
        WrongWeights: they differ.
    """
    noted = noted_digest(path)
    if noted and noted != digest:
        raise WrongWeights(
            f"{path} has SHA-256 {digest[:16]}..., {SUMS_FILE} beside it says {noted[:16]}...: it is another file, or "
            f"a copy cut short; copy it again, or correct {SUMS_FILE}"
        )


def weights_report(
    folders: Iterable[Path] | None = None, files: Iterable[PretrainedFile] | None = None
) -> list[WeightStatus]:
    """One status per file (default: those of the metrics); files that are there are verified."""
    searched = tuple(weight_folders() if folders is None else folders)
    report = []
    for file in REGISTRY.values() if files is None else files:
        path = None
        try:
            path = find_weights(file, searched)
            verify_weights(file, path)
            problem = ""
        except (MissingWeights, WrongWeights) as error:
            problem = str(error)
        report.append(WeightStatus(file, path, problem))
    return report


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Named tensors of a ``.safetensors`` file or of a ``.pth`` state dict (tensors only, nothing else is unpickled).

    Raises:
        WrongWeights: not such a file.
    """
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (SafetensorError, OSError) as error:
            raise WrongWeights(f"{path} is not a readable safetensors file: {error}") from error
    import torch

    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds, from zip errors to pickle errors
        raise WrongWeights(f"{path} is not a readable checkpoint of tensors: {error}") from error
    if not isinstance(loaded, dict) or not all(isinstance(value, torch.Tensor) for value in loaded.values()):
        raise WrongWeights(f"{path} holds {type(loaded).__name__}, expected a dictionary of tensors (a state dict)")
    return loaded
