"""``rtgs run`` through Hydra: from words to jobs.

``hydra.main`` reads ``sys.argv``, formats errors as an environment variable says, and gives a callback no way back to
the program that started it. So a run is started here from the objects that ``hydra.main`` itself is made of. Some are
internal to Hydra; ``pyproject.toml`` bounds its version. What a run knows of itself is in its :class:`HydraApp`.
"""

from __future__ import annotations

import argparse
import importlib
import io
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from hydra import version
from hydra._internal.callbacks import Callbacks
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf

from pipelines.cli.app import NO_SWEEP, Membership, RunOutcome, execute, short
from pipelines.cli.live_runs import live_runs
from pipelines.cli.sweep_summary import finished_elsewhere, same_folders, side_by_side, write_tables
from pipelines.planning.plan import MergedJobs
from pipelines.planning.sweep import Sweep
from rtgs.config.compose import choices_from
from rtgs.config.convert import hide_credentials, to_run_config
from rtgs.config.locate import conf_dir
from rtgs.config.opened import VERSION_BASE, more_folder, search_path
from rtgs.config.schema import register_schema
from rtgs.config.words import friendly_overrides
from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError
from rtgs.track.mlflow_import import pandas_left_out
from rtgs.workflow import Plan, SweepOutcomes

log = logging.getLogger("rtgs")
TOPLEVEL_PLUGINS = "hydra_plugins"  # where Hydra wants them
_JOB_NAME = "app"  # of the log file in a run's output folder
_NOT_CHOSEN = ("after_preset: ", "method_in_preset: ", "method_on_scene", "figure: ")  # of conf/: no groups of a run


class HydraApp:
    """The task function behind Hydra, one for each ``rtgs run``; it keeps what the jobs in this process gave.

    Attributes:
        sweep: known in the process that starts a sweep, from before its jobs; None: a single run.
        error: of a single run, kept from Hydra, which would add to it; or of the sweep's table.
        outcomes: of the jobs that succeeded in this process.
        failures: one line for each job that failed in this process.
    """

    def __init__(self) -> None:
        self.sweep: Sweep | None = None
        self.error: Exception | None = None
        self.outcomes: list[RunOutcome] = []
        self.failures: list[str] = []

    @pandas_left_out()  # again: a launcher's process has not come through run_hydra
    def __call__(self, composed: DictConfig) -> None:
        """One job, here or in a process that a launcher started."""
        self._job(composed, SweepOutcomes({}))

    def after(self, outcomes: SweepOutcomes) -> TaskFunction:
        """:meth:`pipelines.planning.sweep.SweepTask.after`."""
        return lambda composed: self._job(composed, outcomes)

    def shown(self, merged: MergedJobs, plan: Plan) -> AbstractContextManager[Mapping[str, str]]:
        """:meth:`pipelines.planning.sweep.SweepTask.shown`."""
        assert self.sweep is not None
        return live_runs(merged, plan, self.sweep)

    def _job(self, composed: DictConfig, outcomes: SweepOutcomes) -> None:
        hydra = HydraConfig.get()
        hide_credentials(composed)
        _redact_files(hydra)
        sweep = Sweep.of(hydra) if hydra.mode == RunMode.MULTIRUN else None
        try:
            config, choices = to_run_config(composed, choices_from(hydra.runtime.choices, hydra.overrides.task))
            self.outcomes.append(execute(config, choices, Membership(sweep, outcomes)))
        except Exception as error:
            if sweep is None:
                self.error = error
                return
            self.failures.append(redact(f"job {hydra.job.num} ({hydra.job.override_dirname}): {error}"))
            log.error("%s", self.failures[-1])
            sweep.leave_error(int(hydra.job.num), error)
            raise

    def summary(self, words: Sequence[str]) -> str:
        """Table and failures of a sweep; of a single run only the table, if one is asked for.

        ``words``: of the command line.
        """
        if self.sweep is not None and self.sweep.elsewhere:
            self.outcomes, self.failures = finished_elsewhere(words, self.sweep)
        total = len(self.outcomes) + len(self.failures)
        parts = [side_by_side(self.outcomes)] if self.outcomes and total > 1 else []
        parts.append(same_folders(self.outcomes))
        try:
            parts.append("\n".join(f"table: {short(path)}" for path in write_tables(self.outcomes, self.sweep)))
        except ValueError as error:  # what else there is to tell is told
            self.error = error
        if self.failures and total > 1:
            parts.append("\n".join([f"{len(self.failures)} of {total} jobs failed:", *self.failures]))
        return "\n\n".join(part for part in parts if part)


@pandas_left_out()
def run_hydra(words: Sequence[str]) -> HydraApp:
    """Compose and run, or print what an option of Hydra asks for; returns the app with what its jobs gave.

    Raises:
        RtgsError: options that do not go together.
        Exception: what a single run raised, or the first job of a sweep that failed.
    """
    register_schema()
    _know_own_launcher()
    parser = get_args_parser()
    parser.prog = "rtgs run"
    options = parser.parse_args(friendly_overrides(words))
    _check(options)
    app, name = HydraApp(), options.config_name or "config"
    try:
        with _hydra(options) as hydra:
            if _asks(options):
                _answer(hydra, name, options, parser)
                return app
            _start(hydra, name, options, app)
    finally:  # the summary composes, so Hydra is gone by now
        if text := app.summary(words):
            print(f"\n{text}")
    if app.error is not None:
        raise app.error
    return app


def _check(options: argparse.Namespace) -> None:
    """Refuse what ``hydra.main`` refuses, and what makes no sense here.

    Raises:
        RtgsError: names the options.
    """
    if options.experimental_rerun is not None:
        raise RtgsError("--experimental-rerun is not offered: the same words run again, and find what is cached")
    if options.resolve and options.cfg is None and not options.help:
        raise RtgsError("--resolve goes with --cfg or --help only")
    one_of = {
        "--run": options.run,
        "--multirun": options.multirun,
        "--cfg": options.cfg is not None,
        "--info": options.info is not None,
        "--shell-completion": options.shell_completion,
    }
    given = [option for option, is_given in one_of.items() if is_given]
    if len(given) > 1:
        raise RtgsError(f"{' and '.join(given)} exclude each other")


@contextmanager
def _hydra(options: argparse.Namespace) -> Iterator[Hydra]:
    """Hydra over the folder of configs and ``--config-dir``, gone when the run is."""
    folder = conf_dir() if options.config_path is None else Path(options.config_path).absolute()
    more = None if options.config_dir is None else more_folder(options.config_dir)
    search = search_path(folder, more)
    version.setbase(VERSION_BASE)
    hydra = Hydra.create_main_hydra2(task_name=_JOB_NAME, config_search_path=search)
    try:
        yield hydra
    finally:
        GlobalHydra.instance().clear()


def _asks(options: argparse.Namespace) -> bool:
    asked = (options.help, options.hydra_help, options.cfg, options.info, options.shell_completion)
    return any(bool(option) for option in asked)


def _answer(hydra: Hydra, name: str, options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Print what was asked for instead of a run."""
    overrides = options.overrides
    if options.help:
        text = io.StringIO()
        with redirect_stdout(text):
            hydra.app_help(config_name=name, args_parser=parser, args=options)
        print("\n".join(line for line in text.getvalue().splitlines() if not line.startswith(_NOT_CHOSEN)))
    elif options.hydra_help:
        hydra.hydra_help(config_name=name, args_parser=parser, args=options)
    elif options.cfg:
        hydra.show_cfg(
            config_name=name,
            overrides=overrides,
            cfg_type=options.cfg,
            package=options.package,
            resolve=options.resolve,
        )
    elif options.shell_completion:
        hydra.shell_completion(config_name=name, overrides=overrides)
    else:
        hydra.show_info(options.info, config_name=name, overrides=overrides)


def _start(hydra: Hydra, name: str, options: argparse.Namespace, app: HydraApp) -> None:
    """A single run or a sweep, as ``--multirun`` or the config's ``hydra.mode`` says."""
    overrides = list(options.overrides)
    mode = hydra.get_mode(config_name=name, overrides=overrides)  # None: nothing is said, or nothing composes
    if mode is None or (options.multirun and mode == RunMode.RUN):
        mode = RunMode.MULTIRUN if options.multirun else RunMode.RUN
        overrides.append(f"hydra.mode={mode.name}")
    if mode == RunMode.RUN:
        hydra.run(config_name=name, task_function=app, overrides=overrides)
    else:
        _sweep(hydra, name, overrides, app)


def _sweep(hydra: Hydra, name: str, overrides: list[str], app: HydraApp) -> None:
    """What ``Hydra.multirun`` does, where the app learns of its sweep before any job.

    Raises:
        RtgsError: ``view=true``, before workers train for hours.
    """
    if any(re.fullmatch(r"\+*view=(true|1|yes|on)", word, re.IGNORECASE) for word in overrides):
        raise RtgsError(NO_SWEEP)
    config = hydra.compose_config(name, overrides, RunMode.MULTIRUN, with_log_configuration=True)
    app.sweep = Sweep.of(config.hydra)
    app.sweep.begin()
    callbacks = Callbacks(config)
    callbacks.on_multirun_start(config=config, config_name=name)
    context = HydraContext(config_loader=hydra.config_loader, callbacks=callbacks)
    sweeper = Plugins.instance().instantiate_sweeper(config=config, hydra_context=context, task_function=app)
    words = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    assert isinstance(words, list)
    sweeper.sweep(arguments=words)
    callbacks.on_multirun_end(config=config, config_name=name)


def _redact_files(hydra: Any) -> None:
    """Hydra has written the config of this job beside its log, with what files of the user's hold.

    Only what it wrote is changed: the folders may be the user's own.
    """
    written: list[Path] = []
    if hydra.output_subdir:
        folder = Path(hydra.runtime.output_dir) / str(hydra.output_subdir)
        written += [folder / name for name in ("config.yaml", "hydra.yaml", "overrides.yaml")]
    if hydra.mode == RunMode.MULTIRUN:
        written.append(Path(hydra.sweep.dir) / "multirun.yaml")
    for path in written:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        if redact(text) != text:
            path.write_text(redact(text), encoding="utf-8")


def _know_own_launcher() -> None:
    """Hydra loads plugins by name from folders that it lists; an editable installation has none to list."""
    plugin = importlib.import_module(f"{TOPLEVEL_PLUGINS}.rtgs_dask_launcher")
    Plugins.instance().register(plugin.RtgsDaskLauncher)
