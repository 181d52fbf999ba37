"""From what Hydra composed to frozen dataclasses: done once, so that nothing behind it knows of OmegaConf."""

from __future__ import annotations

import os
import re
from dataclasses import asdict, replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rtgs.config.schema import Choices, RunConfig
from rtgs.core.build import build
from rtgs.core.errors import RtgsError
from rtgs.methods import find_method, own_methods
from rtgs.methods.settings import MethodSettings
from rtgs.methods.spec import FEATURES

_UNTELLING = {"images", "input", "rgb", "sparse", "colmap", "0", "data", "dense", "undistorted"}


def to_run_config(composed: DictConfig, choices: Choices) -> tuple[RunConfig, Choices]:
    """The composed config as dataclasses: interpolations resolved, paths absolute, names derived.

    Raises:
        RtgsError: a mandatory value is missing or an interpolation fails (names the key); the ablation is not for the
            method.
    """
    try:
        values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise RtgsError(f"config: {error}; set it on the command line or in its YAML file") from error
    assert isinstance(values, dict)
    config = build(RunConfig, {str(key): value for key, value in values.items()})
    _refuse_idle_ablation(config, choices)
    config = replace(config, method=with_own(config.method))
    scene = config.scene
    if config.table.data == "paper" and scene.path.startswith("embedded:"):
        raise RtgsError(
            f"config: table.data=paper (make: DATA=...), but scene {scene.name} is a path-traced stand-in, which the "
            "papers' figures are not for: choose one of ref_real/... or nu_nerf/..., or leave table.data"
        )
    if not scene.path:
        raise RtgsError(
            "config: scene.path is empty; choose a scene (scene=fox) or give a folder (scene.path=/my/photos)"
        )
    if ":" not in scene.path.split("/")[0]:
        scene = replace(scene, path=_absolute(scene.path))
    if not scene.name:
        scene = replace(scene, name=derive_name(scene.path))
    choices = replace(choices, scene=scene.name)
    config = replace(config, scene=scene, paths=replace(config.paths, root=_absolute(config.paths.root)))
    name = config.name or run_name(choices, config.seed, judged=judged(config))
    if name != Path(name).name or name == "..":
        raise RtgsError(f"config: name={name!r} is to be one folder in runs/: give a name without / that is not ..")
    return replace(config, name=name), choices


def with_own(method: MethodSettings) -> MethodSettings:
    """The settings with those of ``method.own`` that differ from their defaults, in one spelling: 1 and 1.0 are one
    recipe.

    Raises:
        RtgsError: a key that the method does not have, or a value it cannot take.
    """
    if not method.own:
        return replace(method, own={})
    made = find_method(method.name).own_settings(method)
    return replace(method, own={k: v for k, v in asdict(made).items() if v != getattr(type(made)(), k)})


def _refuse_idle_ablation(config: RunConfig, choices: Choices) -> None:
    """An ablation is for methods that have what it takes away.

    Raises:
        RtgsError: the method has not.
    """
    needs = set(config.ablation.needs)
    if unknown := sorted(needs - set(FEATURES)):
        raise RtgsError(f"config: ablation.needs names {', '.join(unknown)}: methods may have {', '.join(FEATURES)}")
    if needs and (lacking := sorted(needs - find_method(config.method.name).has)):
        fit = ", ".join(spec.name for spec in own_methods() if needs <= spec.has)
        raise RtgsError(
            f"config: ablation={choices.ablation} takes nothing away from method {config.method.name}, which has no "
            f"{', '.join(lacking)}: it is for {fit}"
        )


def _absolute(path: str) -> str:
    return str(Path(os.path.expandvars(path)).expanduser().absolute().resolve())


def derive_name(path: str) -> str:
    """A scene's name from its folder: the last part that tells something, in letters, digits, dash, underscore."""
    parts = [part for part in Path(path.split(":", 1)[-1]).parts if part not in ("/", ".")]
    telling = [part for part in parts if part.lower() not in _UNTELLING]
    name = (telling or parts or ["scene"])[-1]
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "scene"


def judged(config: RunConfig) -> bool:
    """Whether a plain method is compared with the run's own."""
    return config.judge.plain not in ("", config.method.name)


def run_name(choices: Choices, seed: int, *, judged: bool = False) -> str:
    """Folder name of a run: ``fox-2dgs-quick``, with the ablation and the seed where they are not the default.

    Scenes of a dataset are called with it (``ref_real_sedan``): a stand-in may have the same name.
    """
    of_dataset = choices.scene_file.endswith(f"/{choices.scene}")
    parts = [choices.scene_file if of_dataset else choices.scene, choices.method, choices.preset]
    if choices.ablation not in ("", "none"):
        parts.append(choices.ablation)
    if judged:
        parts.append("judged")
    if seed:
        parts.append(f"seed{seed}")
    return "-".join(part.replace("/", "_") for part in parts if part)
