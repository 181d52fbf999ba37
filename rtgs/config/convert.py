"""From what Hydra composed to frozen dataclasses: done once, so that nothing behind it knows of OmegaConf."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rtgs.config.keys import value_of
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.names import derive_name, run_name
from rtgs.config.opened import more_choices
from rtgs.config.schema import Choices, RunConfig
from rtgs.config.steps import scaled_steps
from rtgs.config.words import FOLDER_CHOICE, quoted, unresolved
from rtgs.core.build import build
from rtgs.core.credentials import ADDRESSES, hide
from rtgs.core.documents import load_yaml
from rtgs.core.errors import RtgsError
from rtgs.core.recipe import flatten
from rtgs.methods import find_method, own_methods
from rtgs.methods.settings import MethodSettings
from rtgs.methods.spec import FEATURES


def hide_credentials(composed: DictConfig) -> None:
    """From now on :func:`rtgs.core.credentials.redact` finds the secrets in the addresses of this config."""
    for key in ADDRESSES:
        with suppress(OmegaConfBaseException):  # what cannot be resolved stops the run when it is converted
            hide(str(OmegaConf.select(composed, key, default="")))


def to_run_config(composed: DictConfig, choices: Choices) -> tuple[RunConfig, Choices]:
    """The composed config as dataclasses: interpolations resolved, paths absolute, names derived.

    Raises:
        RtgsError: a mandatory value is missing or an interpolation fails (names the key); the preset has nothing of the
            method; the ablation changes nothing of this run.
    """
    hide_credentials(composed)
    try:
        values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise RtgsError(f"config: {unresolved(error, error.full_key or 'a value')}") from error
    assert isinstance(values, dict)
    config = build(RunConfig, {str(key): value for key, value in values.items()})
    _refuse_preset_of_others(config, choices)
    if config.distill.teachers:
        _refuse_preset_of_others(config, replace(choices, preset=config.distill.preset), "distill.preset")
    if config.ensemble.members > 1:
        _refuse_preset_of_others(config, replace(choices, preset=config.ensemble.preset), "ensemble.preset")
        _refuse_further_models(config, choices)
    _refuse_idle_ablation(config, choices)
    config = _of_external(config)
    method, schedule = scaled_steps(with_own(config.method), config.schedule, config.steps_scaler)
    config = replace(config, method=method, schedule=schedule)
    find_method(config.method.name).refuse_poses(config.method)
    scene = config.scene
    if config.table.data == "paper" and scene.path.startswith("embedded:"):
        raise RtgsError(
            f"config: table.data=paper (make: DATA=...), but scene {scene.name} is a path-traced stand-in, which the "
            "papers' figures are not for: choose one of ref_real/... or nu_nerf/..., or leave table.data"
        )
    if not scene.path:
        raise RtgsError(
            "config: scene.path is empty; choose a scene (scene=demo) or give a folder (scene.path=/my/photos)"
        )
    if ":" not in scene.path.split("/")[0]:
        scene = replace(scene, path=_absolute(scene.path))
    if not scene.name:
        scene = replace(scene, name=derive_name(scene.path))
    choices = replace(choices, scene=scene.name)
    if choices.scene_file.startswith(FOLDER_CHOICE):  # so that others can repeat the run
        words = (f"scene.path={quoted(scene.path)}", *choices.overrides)
        choices = replace(choices, scene_file="capture", overrides=words)
    config = replace(config, scene=scene, paths=replace(config.paths, root=_absolute(config.paths.root)))
    name = config.name or own_name(config, choices)
    if name != Path(name).name or name == "..":
        raise RtgsError(f"config: name={name!r} is to be one folder in runs/: give a name without / that is not ..")
    return replace(config, name=name), choices


def own_name(config: RunConfig, choices: Choices) -> str:
    """The run's name where none is given: :func:`rtgs.config.names.run_name`, of other programs with theirs."""
    pictures, program = pictures_only(config), config.external.name
    row = f"external_{derive_name(program)}" if program and pictures else ""
    return run_name(choices, config.seed, judged=judged(config), row=row, pictures=pictures and not program)


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


def _refuse_further_models(config: RunConfig, choices: Choices) -> None:
    """An ensemble is of models of one kind, trained on the photos alone.

    Raises:
        RtgsError: it is asked for by a word, not by a preset, and so is a judge, or teachers; or nothing is trained.
    """
    asked = [key for word in choices.overrides for key in _keys_of_word(word)]
    if "ensemble.members" in asked and (other := why_one_model(config)):
        raise RtgsError(f"config: ensemble.members={config.ensemble.members} with {other}: give one of the two")


def _refuse_preset_of_others(config: RunConfig, choices: Choices, key: str = "preset") -> None:
    """``preset=paper_<kind>`` is what authors publish for scenes of a kind: a method without a file for it has none.

    Raises:
        RtgsError: the method has none.
    """
    preset, method = choices.preset, choices.method or config.method.name
    if pictures_only(config) or _has_preset(method, preset):
        return
    fit = [spec.name for spec in own_methods() if _has_preset(spec.name, preset)]
    raise RtgsError(
        f"config: {key}={preset} has nothing of method {method}: it is for {', '.join(fit)}; preset=paper is its "
        "published schedule"
    )


def _has_preset(method: str, preset: str) -> bool:
    """``method`` is the name of its file. Presets of a folder of one's own hold for all."""
    shipped = preset.startswith("paper_") and preset in choices_of("preset")
    return not shipped or f"{preset}_{method}" in (*choices_of("method_in_preset"), *more_choices("method_in_preset"))


def _refuse_idle_ablation(config: RunConfig, choices: Choices) -> None:
    """An ablation is for methods that have what it takes away, with presets that have it on.

    Raises:
        RtgsError: the method has not, it is off, or words go over all of it.
    """
    needs = set(config.ablation.needs)
    if unknown := sorted(needs - set(FEATURES)):
        raise RtgsError(f"config: ablation.needs names {', '.join(unknown)}: methods may have {', '.join(FEATURES)}")
    if pictures_only(config) and choices.ablation not in ("", "none"):
        raise RtgsError(
            f"config: ablation={choices.ablation} takes nothing away from method external, which is pictures"
        )
    if needs and (lacking := sorted(needs - find_method(config.method.name).has)):
        fit = ", ".join(spec.name for spec in own_methods() if needs <= spec.has)
        raise RtgsError(
            f"config: ablation={choices.ablation} takes nothing away from method {config.method.name}, which has no "
            f"{', '.join(lacking)}: it is for {fit}"
        )
    _refuse_off(config, choices)
    _refuse_overridden(choices)


def _refuse_off(config: RunConfig, choices: Choices) -> None:
    """``ablation.idle_with``: presets, and ``key=value`` where a value has it off, whoever set that."""
    idle_with = config.ablation.idle_with
    said = f"config: ablation={choices.ablation} takes nothing away from method {config.method.name} with"
    if choices.preset in idle_with:
        presets = (name for name in choices_of("preset") if _has_preset(config.method.name, name))
        fit = ", ".join(name for name in presets if name not in idle_with)
        raise RtgsError(f"{said} preset={choices.preset}, where it is off already: it is for preset {fit}")
    for key, _, text in (each.partition("=") for each in idle_with if "=" in each):
        try:
            value = value_of(config, key)
        except AttributeError as error:
            raise RtgsError(
                f"config: ablation.idle_with of ablation={choices.ablation} names {key}, which is no key of method "
                f"{config.method.name}: write KEY=VALUE of a key that `rtgs explain` lists, or a preset"
            ) from error
        if value == OmegaConf.from_dotlist([f"value={text}"])["value"]:
            raise RtgsError(
                f"{said} {key}={value}, where it is off already: leave the ablation out, or give {key} another value "
                f"(`rtgs explain {key}` says where it is set)"
            )


def _keys_of_word(word: str) -> list[str]:
    """The dotted names that a word sets: its own, or those in a group's ``{...}``, which is merged."""
    name, _, text = word.lstrip("+~").partition("=")
    if not text.startswith("{"):
        return [name]
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return list(flatten(OverridesParser.create().parse_override(word).value(), name))


def _refuse_overridden(choices: Choices) -> None:
    """Words go over files: where they set all that an ablation sets, it changes nothing, whatever the values are.

    Of ablations of ``conf/``; those of a folder of one's own are not looked up.
    """
    file = conf_dir() / "ablation" / f"{choices.ablation}.yaml"
    if choices.ablation in ("", "none") or not file.is_file():
        return
    words = {key: word for word in choices.overrides for key in _keys_of_word(word)}
    content = {group: values for group, values in load_yaml(file).items() if group not in ("ablation", "defaults")}
    keys = list(flatten(content))
    if keys and set(keys) <= set(words):
        said = " ".join(dict.fromkeys(words[key] for key in keys))
        raise RtgsError(
            f"config: ablation={choices.ablation} changes nothing: all that it sets ({', '.join(keys)}) is set on the "
            f"command line ({said}), which goes over it: leave out the ablation or these words"
        )


def pictures_only(config: RunConfig) -> bool:
    """Whether the run scores pictures of another program instead of training."""
    return find_method(config.method.name).elsewhere


def _of_external(config: RunConfig) -> RunConfig:
    """With absolute folders, where pictures of another program are scored.

    Raises:
        RtgsError: the run asks for what only a training has.
    """
    if not pictures_only(config):
        return config
    external = config.external
    evaluation = config.evaluation
    asked = {
        f"judge.plain={config.judge.plain}": config.judge.plain != "",
        "mesh.extract=true": config.mesh.extract,
        f"evaluation.supersample={evaluation.supersample}": evaluation.supersample != 1,
        "evaluation.refined_poses=always": evaluation.refined_poses == "always",
        "watch.cpu_seconds": bool(config.watch.cpu_seconds),
        "watch.steps": bool(config.watch.steps),
    }
    if wrong := [word for word, is_asked in asked.items() if is_asked]:
        raise RtgsError(f"config: {wrong[0]} with method=external: there is nothing but pictures; leave it out")
    folders = {key: _absolute(path) for key in ("renders", "layers") if (path := getattr(external, key))}
    return replace(config, external=replace(external, **folders))


def _absolute(path: str) -> str:
    return str(Path(os.path.expandvars(path)).expanduser().absolute().resolve())


def judged(config: RunConfig) -> bool:
    """Whether a plain method is compared with the run's own."""
    return config.judge.plain not in ("", config.method.name)


def why_one_model(config: RunConfig) -> str:
    """The words that leave a run without further models, whatever its preset says; empty: none does."""
    if pictures_only(config):
        return f"method={config.method.name}"
    if judged(config):
        return f"judge.plain={config.judge.plain}"
    return f"distill.teachers={config.distill.teachers}" if config.distill.teachers else ""


def models_of(config: RunConfig) -> int:
    """How many models a run's pictures are the mean of; 1: no mean is taken."""
    return 1 if why_one_model(config) else config.ensemble.members
