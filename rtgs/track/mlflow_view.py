"""The view of an experiment's runs that answers which is best: columns and order, kept as MLflow's pages keep them.

MLflow's pages save a view of the table of runs as a tag of the experiment (``mlflow.sharedViewState.<id>``) and open it
with ``?viewStateShareKey=<id>`` (MLflow 3.17: a JSON object of ``name``, ``createdAt``, ``updatedAt`` and ``state``, a
string of JSON; read from its published pages). Rows that are sorted by a metric are not folded under their parents.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

VIEW_ID = "rtgs_best"
NAME = "rtgs: best first"
TAG = f"mlflow.sharedViewState.{VIEW_ID}"
KIND_TAG = "mlflow.experimentKind"
KIND = "custom_model_development"
SORTED_BY = "eval/psnr"
PARAMS = ("scene", "method", "preset", "ablation", "seed")
METRICS = ("eval/psnr", "eval/ssim", "eval/lpips_01", "eval/flip", "eval/psnr_masked", "cost/train_seconds", "surfels")
_MODE = "workflowType=machine_learning"
_ATTRIBUTES = ("Created", "Duration")
_EPOCH = 1  # milliseconds: the same view is the same tag, whoever writes it


def view_state() -> dict[str, Any]:
    """What the page shows: runs by PSNR, figures as columns, the runs of sweeps as rows of their own."""
    columns = [
        *(_column("attributes", name) for name in _ATTRIBUTES),
        *(_column("params", name) for name in PARAMS),
        *(_column("metrics", name) for name in METRICS),
    ]
    return {
        "searchFilter": "",
        "orderByKey": _column("metrics", SORTED_BY),
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "modelVersionFilter": "All Runs",
        "selectedColumns": columns,
        "runsHiddenMode": "FIRST_20_RUNS",  # whose curves and pictures the charts show
        "viewMaximized": True,
    }


def view_tags() -> Mapping[str, str]:
    """The tags of an experiment that carry the view, and say that it is of models in training."""
    state = json.dumps(view_state(), separators=(",", ":"))
    saved = {"name": NAME, "createdAt": _EPOCH, "updatedAt": _EPOCH, "state": state}
    return {TAG: json.dumps(saved, separators=(",", ":")), KIND_TAG: KIND}


def artifact_link(address: str, experiment_id: str, run_id: str, path: str) -> str:
    """The page of a run's file or folder, in the mode of :func:`view_link`."""
    return f"{address}/#/experiments/{experiment_id}/runs/{run_id}/artifacts/{path}?{_MODE}"


def view_link(address: str, experiment_id: str) -> str:
    """The page of an experiment in this view, in MLflow's mode for model training."""
    where = f"{address}/#/experiments/{experiment_id}/runs"
    return f"{where}?viewStateShareKey={VIEW_ID}&{_MODE}"


def _column(kind: str, name: str) -> str:
    return f"{kind}.`{name}`"
