"""The jobs of a sweep, composed without running any: for ``rtgs plan --multirun`` and the tests."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from rtgs.config.compose import choices_from, without_hydra
from rtgs.config.convert import to_run_config
from rtgs.config.opened import opened_configs
from rtgs.config.schema import Choices, RunConfig, register_schema
from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from hydra._internal.config_loader_impl import ConfigLoaderImpl

_SWEEPER = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"


@dataclass(frozen=True)
class ComposedJob:
    """One combination of a sweep; without a config where its values do not fit, with the reason."""

    words: tuple[str, ...]
    config: RunConfig | None
    choices: Choices | None
    problem: str = ""

    @property
    def title(self) -> str:
        """The run's name, or the words where there is none."""
        return str(self.config.name) if self.config is not None else " ".join(self.words)


def compose_jobs(words: Sequence[str], multirun: bool) -> tuple[tuple[ComposedJob, ...], bool]:
    """Every job that ``rtgs run [--multirun] <words>`` would start, in its order, and whether they are a sweep.

    An experiment file that says ``hydra.mode: MULTIRUN`` is a sweep without the option, as for ``rtgs run``.

    Raises:
        hydra.errors.HydraException: an override or a file does not fit the schema (its cause names the key).
        RtgsError: values are swept without ``--multirun``, or by another sweeper than Hydra's basic one.
    """
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    register_schema()
    with opened_configs():
        state = GlobalHydra.instance()
        assert state.hydra is not None
        words = [*words, "hydra.mode=MULTIRUN"] if multirun else list(words)
        master = state.hydra.compose_config(
            "config", words, run_mode=RunMode.MULTIRUN, with_log_configuration=False, from_shell=True
        )
        if master.hydra.mode != RunMode.MULTIRUN:
            master = state.hydra.compose_config(
                "config", words, run_mode=RunMode.RUN, with_log_configuration=False, from_shell=True
            )
            hydra = master.hydra
            return (_job(without_hydra(master), hydra.runtime.choices, hydra.overrides.task, _words(master)),), False
        loader: Any = state.config_loader()
        composer = _Composer(loader, master)
        return tuple(composer.job(combination) for combination in _combinations(loader, master)), True


def _combinations(loader: ConfigLoaderImpl, master: DictConfig) -> list[list[str]]:
    """The words of each job, as Hydra's basic sweeper splits them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    sweeper = master.hydra.sweeper
    if sweeper.get("_target_") != _SWEEPER:
        raise RtgsError(f"hydra/sweeper {sweeper.get('_target_')}: only the jobs of Hydra's basic sweeper are known")
    swept = [f"{key}={value}" for key, value in (sweeper.params or {}).items()]
    overrides = OverridesParser.create(config_loader=loader).parse_overrides([*swept, *_words(master)])
    (batch,) = BasicSweeper.split_arguments(overrides, None)
    return batch


def _words(master: DictConfig) -> list[str]:
    """As they were given: ``${...}`` in them is of the job's config, not of this one."""
    from omegaconf import OmegaConf

    words = OmegaConf.to_container(master.hydra.overrides.task, resolve=False)
    assert isinstance(words, list)
    return [str(word) for word in words]


class _Composer:
    """Composes jobs; those with the same files chosen share the composition, which is nearly all of the time."""

    def __init__(self, loader: ConfigLoaderImpl, master: DictConfig) -> None:
        from hydra.core.override_parser.overrides_parser import OverridesParser

        self._loader = loader
        self._master = master
        self._parser = OverridesParser.create(config_loader=loader)
        self._groups = set(master.hydra.runtime.choices)
        self._composed: dict[tuple[str, ...], tuple[DictConfig, Any]] = {}

    def job(self, words: Sequence[str]) -> ComposedJob:
        """The job of these words."""
        plain = [word for word in words if self._sets_a_value(word)]
        base = tuple(word for word in words if word not in plain)
        if base not in self._composed:
            composed = self._loader.load_sweep_config(self._master, list(base))
            self._composed[base] = without_hydra(composed), composed.hydra.runtime.choices
        own, groups = self._composed[base]
        if plain:
            own = copy.deepcopy(own)
        for override in self._parser.parse_overrides(plain):
            _set(own, override.key_or_group, override.value(), override.input_line or "")
        return _job(own, groups, words, words)

    def _sets_a_value(self, word: str) -> bool:
        """``key=value`` of a key of ours; what chooses, adds or removes goes through Hydra."""
        key = word.partition("=")[0]
        return key[:1] not in "+~" and key not in self._groups and not key.startswith("hydra") and "@" not in key


def _set(config: DictConfig, key: str, value: object, word: str) -> None:
    """What Hydra does with ``key=value`` once the files are merged; its errors name the word in the same way."""
    from hydra.errors import ConfigCompositionException
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    try:
        OmegaConf.update(config, key, value, merge=True)
    except (ConfigAttributeError, ConfigKeyError) as error:
        raise ConfigCompositionException(f"Could not override '{key}'.") from error
    except OmegaConfBaseException as error:
        raise ConfigCompositionException(f"Error merging override {word}") from error


def _job(composed: DictConfig, groups: Any, overrides: Sequence[str], words: Sequence[str]) -> ComposedJob:
    """The job of ``overrides``; ``words`` are the same as they were given, which can always be read."""
    try:
        return ComposedJob(tuple(words), *to_run_config(composed, choices_from(groups, overrides)))
    except (RtgsError, ValueError) as error:  # ValueError: a setting out of its range
        return ComposedJob(tuple(words), None, None, str(error))
