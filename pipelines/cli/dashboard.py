"""``rtgs dashboard``: MLflow's own pages on the loopback address, and what there is to look at."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pipelines.cli.sweep_summary import FIGURES
from pipelines.cli.termination import serve_until_interrupted
from pipelines.steps.report import PAGE as REPORT
from rtgs.core.errors import RtgsError
from rtgs.track.mlflow import PARENT_TAG, MlflowTracking
from rtgs.track.mlflow_import import pandas_left_out
from rtgs.track.mlflow_view import SORTED_BY, artifact_link, view_link
from rtgs.workflow.executors import STEPS_EXPERIMENT

_PAGE = 1000  # runs counted per experiment
SWEEP_TAG = "rtgs.sweep"  # of the parent run (pipelines.planning.sweep)
GUIDE = """Each link above shows the runs of an experiment, best PSNR first, those of sweeps too, figures as columns
(the view "rtgs: best first" of its menu of views). The second button beside the search compares figures, curves and
pictures (search view_; full screen shows the runs beside each other).
In a run: Model metrics has the curves (train/psnr, train/loss) and the sliders (<view>/<layer>, one stop per step);
Artifacts has tables/eval.json with every test view, report.html the page, point_cloud.ply the model, config.yaml every
key. The parent run of a sweep holds tables/figures.json, and of an experiment with a table table.html."""


@pandas_left_out()
def serve(root: Path, port: int) -> int:
    """Print what to look at, and serve until Ctrl-C; returns the exit code.

    Raises:
        RtgsError: nothing was tracked here.
    """
    database = (root / "mlflow.db").absolute()
    if not database.is_file():
        raise RtgsError(f"{database} does not exist yet: `rtgs run` (with tracking=mlflow) makes it")
    address = f"http://127.0.0.1:{port}"
    tracking = MlflowTracking(root)
    if dead := tracking.reap():
        print(f"{dead} runs whose process is gone are marked as killed")
    print("\n".join([f"{address}  (Ctrl-C ends it)", *overview(tracking, address), "", GUIDE]), flush=True)
    command = ("mlflow", "ui", "--workers", "1", "--host", "127.0.0.1", "--port", str(port))
    quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    server = [sys.executable, "-m", *command, "--backend-store-uri", f"sqlite:///{database}"]
    return serve_until_interrupted(server, os.environ | quiet)


def overview(tracking: MlflowTracking, address: str) -> list[str]:
    """Of each experiment: how many sweeps and runs, its page, the best run and its pictures, the newest table."""
    lines = []
    experiments = tracking.client.search_experiments()
    for experiment in sorted(experiments, key=lambda one: one.name == STEPS_EXPERIMENT):  # what is compared first
        runs = list(tracking.client.search_runs([experiment.experiment_id], max_results=_PAGE))
        if not runs:
            continue
        number = experiment.experiment_id
        if experiment.name == STEPS_EXPERIMENT:
            page = f"{address}/#/experiments/{number}/runs"
            lines.append(f"  {experiment.name}: {len(runs)} executed steps  {page}")
            continue
        tracking.carry_view(experiment)
        variants = [run for run in runs if SWEEP_TAG not in run.data.tags]
        sweeps = {run.data.tags.get(PARENT_TAG) for run in variants} - {None}
        text = f"  {experiment.name}: {len(variants)} runs" + (f" in {len(sweeps)} sweeps" if sweeps else "")
        measured = [run for run in variants if SORTED_BY in run.data.metrics]
        best = max(measured, key=lambda run: run.data.metrics[SORTED_BY], default=None)
        if best is not None:
            text += f", best {best.info.run_name} with {best.data.metrics[SORTED_BY]:.2f} dB"
        lines.append(f"{text}  {view_link(address, number)}")
        if best is not None:
            lines.append(f"    its pictures: {artifact_link(address, number, best.info.run_id, REPORT)}")
        newest = next((run for run in runs if SWEEP_TAG in run.data.tags), None)
        if newest is not None:
            shown = artifact_link(address, number, newest.info.run_id, f"tables/{FIGURES}.json")
            lines.append(f"    table of the newest sweep: {shown}")
    return lines
