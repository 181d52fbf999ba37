"""Hydra's ``hydra/launcher=rtgs_dask``: all jobs of a sweep as one merged plan on Dask workers.

Hydra takes launchers from the namespace package ``hydra_plugins`` only; everything of substance is in
``pipelines.planning.sweep`` and ``rtgs.workflow.engine``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobReturn, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from pipelines.planning.plan import Job
from pipelines.planning.sweep import SweepTask, run_merged
from rtgs.config.compose import choices_from, without_hydra
from rtgs.config.convert import to_run_config
from rtgs.config.schema import open_schema
from rtgs.core.errors import RtgsError
from rtgs.workflow.engine import EngineSettings

log = logging.getLogger("rtgs")
NAME = "rtgs_dask"


class RtgsDaskLauncher(Launcher):
    """Plans all jobs, runs the union on the engine, then lets every job write its own results in this process."""

    def __init__(self, **engine: Any) -> None:
        settings = {item.name: engine[item.name] for item in fields(EngineSettings) if item.name in engine}
        for name in ("hosts", "slurm_directives", "step_threads", "step_memory", "step_limit"):
            settings[name] = list(settings.get(name, []))
        self.settings = EngineSettings(**settings)
        self._context: HydraContext | None = None
        self._task: SweepTask | None = None
        self._config: DictConfig | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Hydra hands over what a launcher needs."""
        if not isinstance(task_function, SweepTask):
            raise RtgsError(f"hydra/launcher={NAME} runs the jobs of `rtgs run` only, not {task_function!r}")
        self._context, self._task, self._config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs; what each of them raised is in its :class:`JobReturn`."""
        assert self._context is not None
        assert self._task is not None
        assert self._config is not None
        setup_globals()
        configure_log(self._config.hydra.hydra_logging, self._config.hydra.verbose)
        Path(str(self._config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        composed = [self._compose(number, words, initial_job_idx) for number, words in enumerate(job_overrides)]
        task, returns = self._task, []
        jobs = [job for config in composed if (job := _job(config)) is not None]
        with ExitStack() as shown:
            outcomes = run_merged(jobs, self.settings, lambda *planned: shown.enter_context(task.shown(*planned)))
            after = task.after(outcomes)
            for words, config in zip(job_overrides, composed):
                log.info("#%s: %s", config.hydra.job.num, " ".join(filter_overrides(words)))
                returns.append(
                    run_job(
                        hydra_context=self._context,
                        task_function=after,
                        config=config,
                        job_dir_key="hydra.sweep.dir",
                        job_subdir_key="hydra.sweep.subdir",
                    )
                )
                configure_log(self._config.hydra.hydra_logging, self._config.hydra.verbose)
        return returns

    def _compose(self, number: int, words: Sequence[str], first: int) -> DictConfig:
        assert self._context is not None
        assert self._config is not None
        config = self._context.config_loader.load_sweep_config(self._config, list(words))
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = first + number
        return config


def _job(composed: DictConfig) -> Job | None:
    """The job of a composed config; None when its values do not fit: then the job itself says so."""
    hydra = composed.hydra
    try:
        return Job(*to_run_config(without_hydra(composed), choices_from(hydra.runtime.choices, hydra.overrides.task)))
    except Exception as error:
        log.debug("left out of the merged plan: %s", error)
        return None


def _register() -> None:
    """The launcher's options under ``hydra.launcher``, typed: a misspelt one stops there."""
    target = f"{__name__}.{RtgsDaskLauncher.__qualname__}"
    body = {"__annotations__": {"_target_": str}, "_target_": target}
    node = dataclass(type("RtgsDaskLauncherConfig", (open_schema(EngineSettings),), body))
    ConfigStore.instance().store(group="hydra/launcher", name=NAME, node=node, provider="rtgs")


_register()
