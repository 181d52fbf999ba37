"""Compose a config without running anything: for ``rtgs plan``, ``rtgs check`` and the tests."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from omegaconf import DictConfig

from rtgs.config.convert import to_run_config, with_own
from rtgs.config.opened import opened_configs
from rtgs.config.schema import OF_THE_MACHINE, Choices, RunConfig, register_schema
from rtgs.config.steps import scaled_steps
from rtgs.config.words import unresolved
from rtgs.core.build import build
from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError
from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import ScheduleSettings


def compose(overrides: Sequence[str]) -> tuple[RunConfig, Choices]:
    """The config of ``rtgs run <overrides>``.

    Raises:
        hydra.errors.HydraException: an override or a file does not fit the schema (its cause names the key).
        RtgsError: a value is missing.
    """
    from hydra import compose as hydra_compose

    register_schema()
    with opened_configs():
        composed = hydra_compose("config", overrides=list(overrides), return_hydra_config=True)
    hydra = composed.hydra
    choices = choices_from(hydra.runtime.choices, hydra.overrides.task)
    return to_run_config(without_hydra(composed), choices)


def compose_plain(method: str, choices: Choices) -> tuple[MethodSettings, ScheduleSettings]:
    """Another method's own numbers at the preset of a run, and the schedule they give; of what the run sets by word,
    keys of ``schedule`` and ``steps_scaler`` hold for it as well.

    Raises:
        hydra.errors.HydraException: no such method or preset.
    """
    words = _words_of(choices, ("schedule", "steps_scaler"))
    return _own_numbers(_groups(choices, method=method, ablation="", experiment=""), words)


def compose_other(preset: str, choices: Choices) -> tuple[MethodSettings, ScheduleSettings]:
    """The recipe of a run's further models: at another preset, with its ablation, its experiment and its words for the
    training; an empty ``preset`` is the run's own.

    Raises:
        hydra.errors.HydraException: no such preset.
    """
    words = _words_of(choices, ("method", "schedule", "steps_scaler"))
    return _own_numbers(_groups(choices, **({"preset": preset} if preset else {})), words)


def _words_of(choices: Choices, keys: tuple[str, ...]) -> list[str]:
    """The words of a run that set one of these keys, or something under it."""
    return [word for word in choices.overrides if _key(word).split(".")[0] in keys]


def _groups(choices: Choices, **others: str) -> list[str]:
    """The words that choose the files of a run, some of them others; those of an empty name are left out."""
    names = ("method", "preset", "ablation", "experiment")
    chosen = {"scene": choices.scene_file, **{name: getattr(choices, name) for name in names}} | others
    return [f"{group}={name}" for group, name in chosen.items() if name]


def _own_numbers(groups: list[str], words: list[str]) -> tuple[MethodSettings, ScheduleSettings]:
    """The method and the schedule of a command, scaled."""
    from hydra import compose as hydra_compose
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    register_schema()
    if GlobalHydra.instance().is_initialized():  # in a job: it knows the folders that the command line adds
        composed = hydra_compose("config", overrides=[*groups, *words])
    else:
        with opened_configs():
            composed = hydra_compose("config", overrides=[*groups, *words])
    found, schedule = (OmegaConf.to_container(composed[group], resolve=True) for group in ("method", "schedule"))
    assert isinstance(found, dict)
    assert isinstance(schedule, dict)
    own = with_own(build(MethodSettings, {str(key): value for key, value in found.items()}))
    steps = build(ScheduleSettings, {str(key): value for key, value in schedule.items()})
    return scaled_steps(own, steps, float(composed.steps_scaler))


def without_hydra(composed: DictConfig) -> DictConfig:
    """The part of a composed config that is ours."""
    from omegaconf import OmegaConf, open_dict

    own = composed.copy()
    OmegaConf.set_readonly(own, False)
    with open_dict(own):
        own.pop("hydra", None)
    return own


def choices_from(groups: Mapping[str, object], overrides: Sequence[str]) -> Choices:
    """Hydra's record of chosen files and overrides as :class:`Choices`.

    Where a run is tracked and who looks at it is no part of what it is: these words are left out, and credentials
    with them.

    Raises:
        RtgsError: ``${...}`` in an override has no value.
    """
    names = {str(key): str(value) for key, value in groups.items() if value is not None}
    chosen = {key: names.get(key, "") for key in ("method", "preset", "ablation", "experiment")}
    told_otherwise = {*names, "hydra", "paths.root", *OF_THE_MACHINE} - {"sfm", "masks", "normals", "judge"}
    elsewhere = ("tracking.", "viewer.")
    keys = [
        item
        for item in _resolved(overrides)
        if (_key(item) not in told_otherwise or _sets_values(item)) and not _key(item).startswith(elsewhere)
    ]
    return Choices(**chosen, scene_file=names.get("scene", ""), overrides=tuple(map(redact, keys)))


def _resolved(overrides: Sequence[str]) -> list[str]:
    """The overrides with the values that ``${...}`` in them stands for; Hydra's own list finds them as it is read."""
    from omegaconf import ListConfig
    from omegaconf.errors import OmegaConfBaseException

    found = []
    for index in range(len(overrides)):
        try:
            found.append(str(overrides[index]))
        except OmegaConfBaseException as error:
            assert isinstance(overrides, ListConfig)  # words in a plain list are not resolved
            word = str(overrides._get_node(index))
            taken = " and ".join(re.findall(r"\$\{[\w.]+\}", word))  # not all of the value: it may hold a password
            if not taken:
                raise RtgsError(f"config: {unresolved(error, _key(word))}") from error
            raise RtgsError(
                f"config: {_key(word)} on the command line takes {taken}: {str(error).splitlines()[0]}; give a value, "
                "or ${KEY} of a key that has a value of its own"
            ) from error
    return found


def _sets_values(override: str) -> bool:
    """Whether the word chooses no file of a group, but sets keys under it: ``method={loss:{dssim:0}}``."""
    return override.partition("=")[2].lstrip().startswith("{")


def _key(override: str) -> str:
    return override.split("=", 1)[0].lstrip("+~")
