"""Names of scenes and runs: a run is called by everything that tells it from others."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from rtgs.config.keys import short_key
from rtgs.config.schema import OF_THE_MACHINE, Choices

LONGEST_OVERRIDES = 60  # characters of a run's name
LONGEST_VALUE = 24
_UNTELLING = {"images", "input", "rgb", "sparse", "colmap", "0", "data", "dense", "undistorted"}
# Where results go, what has its own place in the name, and what does not change them.
_NOT_NAMED = ("paths.", "tracking.", "table.", "watch.", "viewer.", "hydra.", "hydra/")
_ELSEWHERE = {"scene", "method", "preset", "ablation", "experiment", "tracking", "judge"}
_ELSEWHERE |= {"external.name", "seed", "scene.path", "scene.name", *OF_THE_MACHINE}


def derive_name(path: str) -> str:
    """A scene's name from its folder: the last part that tells something, in letters, digits, dash, underscore."""
    parts = [part for part in Path(path.split(":", 1)[-1]).parts if part not in ("/", ".")]
    telling = [part for part in parts if part.lower() not in _UNTELLING]
    name = (telling or parts or ["scene"])[-1]
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "scene"


def run_name(choices: Choices, seed: int, *, judged: bool = False, row: str = "", pictures: bool = False) -> str:
    """Folder name of a run: ``fox-2dgs-quick``, with the ablation, the seed and the overridden keys where they are not
    the default: ``fox-2dgs-quick-dssim_0.1``. ``row``: in the place of the method's name. ``pictures``: of another
    program without a name; which they are tells the run from others.

    Scenes of a dataset are called with it (``ref_real_sedan``): a stand-in may have the same name.
    """
    of_dataset = choices.scene_file.endswith(f"/{choices.scene}")
    parts = [choices.scene_file if of_dataset else choices.scene, row or choices.method, choices.preset]
    if choices.ablation not in ("", "none"):
        parts.append(choices.ablation)
    if judged:
        parts.append("judged")
    if seed:
        parts.append(f"seed{seed}")
    parts.append(overridden(choices.overrides, pictures=pictures))
    return "-".join(part.replace("/", "_") for part in parts if part)


def overridden(words: Sequence[str], *, pictures: bool = False) -> str:
    """What words such as ``method.loss.dssim=0.1`` add to a run's name: ``dssim_0.1``; in the order of the keys.

    Keys of ``external`` count only with ``pictures``. A digest of all the words follows where they are too long for a
    name, or hold what a name cannot.
    """
    given = dict(map(_told, words))
    unnamed = _NOT_NAMED if pictures else (*_NOT_NAMED, "external.")
    told = {key: given[key] for key in sorted(given) if not key.startswith(unnamed) and key not in _ELSEWHERE}
    parts, whole = [], True
    for key, value in told.items():
        plain = re.sub(r"[^A-Za-z0-9._-]+", "_", value)[:LONGEST_VALUE]
        part = f"{short_key(key)}_{plain}"
        fits = sum(map(len, parts)) + len(parts) + len(part) <= LONGEST_OVERRIDES
        whole = whole and fits and plain == value
        parts += [part] if fits else []
    if not whole:
        exact = "\n".join(f"{key}={value}" for key, value in told.items())
        parts.append(hashlib.sha256(exact.encode()).hexdigest()[:6])
    return "-".join(parts)


def _told(word: str) -> tuple[str, str]:
    """Key and value, without Hydra's marks and quotes."""
    key, _, value = word.partition("=")
    return key.lstrip("+~"), value.strip("'\"")
