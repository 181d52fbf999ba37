"""``rtgs dashboard``: MLflow's own pages on the loopback address, and what there is to look at."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from rtgs.core.errors import RtgsError
from rtgs.track.mlflow import PARENT_TAG, MlflowTracking
from rtgs.workflow.executors import STEPS_EXPERIMENT

_PAGE = 1000  # runs counted per experiment
SWEEP_TAG = "rtgs.sweep"  # of the parent run (pipelines.planning.sweep)
GUIDE = """In an experiment: the table of runs (choose eval/psnr, eval/ssim under Columns); its chart view, the second
button, compares figures, curves and pictures (search view_; full screen shows the runs beside each other).
In a run: Model metrics has the curves (train/psnr, train/loss) and the sliders (<view>/<layer>, one stop per step);
Artifacts has tables/eval.json with every test view, report.html the page, point_cloud.ply the model, config.yaml every
key. The parent run of a sweep holds table.html."""


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
    with suppress(KeyboardInterrupt):
        server = [sys.executable, "-m", *command, "--backend-store-uri", f"sqlite:///{database}"]
        return subprocess.run(server, env=os.environ | quiet).returncode
    return 0


def overview(tracking: MlflowTracking, address: str) -> list[str]:
    """One line per experiment: how many sweeps and runs, the newest and the best of them, and its page."""
    lines = []
    for experiment in tracking.client.search_experiments():
        runs = list(tracking.client.search_runs([experiment.experiment_id], max_results=_PAGE))
        if not runs:
            continue
        page = f"{address}/#/experiments/{experiment.experiment_id}/runs"
        if experiment.name == STEPS_EXPERIMENT:
            lines.append(f"  {experiment.name}: {len(runs)} executed steps  {page}")
            continue
        variants = [run for run in runs if SWEEP_TAG not in run.data.tags]
        sweeps = {run.data.tags.get(PARENT_TAG) for run in variants} - {None}
        text = f"  {experiment.name}: {len(variants)} runs" + (f" in {len(sweeps)} sweeps" if sweeps else "")
        measured = [run for run in variants if "eval/psnr" in run.data.metrics]
        if measured:
            best = max(measured, key=lambda run: run.data.metrics["eval/psnr"])
            text += f", best {best.info.run_name} with {best.data.metrics['eval/psnr']:.2f} dB"
        lines.append(f"{text}  {page}")
    return lines
