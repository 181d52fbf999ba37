"""What `rtgs dashboard` prints before it serves, and what its server answers: which run is best, how long it took."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipelines.cli.dashboard import GUIDE, overview, serve
from pipelines.cli.sweep_summary import FIGURES
from rtgs.core.errors import RtgsError
from rtgs.track import RunInfo
from rtgs.track.mlflow import MlflowTracking
from rtgs.track.mlflow_view import KIND, KIND_TAG, TAG, VIEW_ID
from tests.view import chromium

ADDRESS = "http://127.0.0.1:5000"
EXPERIMENT = "rtgs/table1"
RUNS = (("fox-2dgs", 20.0), ("fox-rtgs", 21.5), ("fox-envgs", 20.7))
LONGEST_START = 180.0  # seconds of MLflow's server on a busy machine


def swept(root: Path) -> MlflowTracking:
    """A sweep of three runs that took 100 s, each 30 s, and an executed step."""
    tracking = MlflowTracking(root)
    info = RunInfo(EXPERIMENT, "sweep today", "sweep 1", {"rtgs.sweep": "1"}, seconds_before=100.0)
    for name, psnr in RUNS:
        with tracking.sweep(info) as parent:
            one = RunInfo(EXPERIMENT, name, name * 8, {}, parent.id, seconds_before=30.0)
            with tracking.run(one) as tracker:
                tracker.params({"scene": "fox", "method": name.removeprefix("fox-")})
                tracker.metrics({"eval/psnr": psnr, "eval/ssim": 0.5})
    with tracking.sweep(info) as parent:
        parent.table(FIGURES, [{"method": name, "PSNR": psnr, "LPIPS": None} for name, psnr in RUNS])
    with tracking.run(RunInfo("rtgs/steps", "train", "e" * 64, {"rtgs.step": "train"})):
        pass
    return tracking


def test_every_experiment_is_listed_with_its_page_and_best_run(tmp_path):
    lines = overview(swept(tmp_path), ADDRESS)
    (table,) = [line for line in lines if "rtgs/table1: 3 runs in 1 sweeps, best fox-rtgs with 21.50 dB" in line]
    assert re.search(rf"{ADDRESS}/#/experiments/\d+/runs\?viewStateShareKey={VIEW_ID}&workflowType=machine", table)
    (steps,) = [line for line in lines if "rtgs/steps: 1 executed steps" in line]
    assert "viewStateShareKey" not in steps
    assert lines[-1] == steps  # what is compared comes first
    assert any(re.search(r"its pictures: .*/runs/\w+/artifacts/report\.html\?workflow", line) for line in lines)
    assert any(re.search(rf"newest sweep: .*/artifacts/tables/{FIGURES}.json\?workflow", line) for line in lines)
    assert all(word in GUIDE for word in ("Model metrics", "tables/eval.json", "report.html", f"{FIGURES}.json"))


def test_an_experiment_from_before_gets_the_view_and_keeps_its_kind(tmp_path):
    tracking = MlflowTracking(tmp_path)
    number = tracking.client.create_experiment("rtgs/runs", tags={KIND_TAG: "genai_development", TAG: "old"})
    with tracking.run(RunInfo("rtgs/runs", "a", "a" * 64)):
        pass
    tags = tracking.client.get_experiment(number).tags
    assert tags[KIND_TAG] == "genai_development"
    assert json.loads(tags[TAG])["name"] == "rtgs: best first"
    before = tags[TAG]
    with tracking.run(RunInfo("rtgs/runs", "b", "b" * 64)):
        pass
    assert tracking.client.get_experiment(number).tags[TAG] == before


def test_without_runs_it_says_how_to_make_one(tmp_path):
    with pytest.raises(RtgsError, match="rtgs run"):
        serve(tmp_path, 5000)


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[tuple[str, list[str]]]:
    """Address of a dashboard, and the lines that it printed."""
    root = tmp_path_factory.mktemp("served")
    swept(root)
    port = free_port()
    words = [sys.executable, "-m", "rtgs", "dashboard", "--root", str(root), "--port", str(port)]
    log = root / "log"
    with log.open("wb") as stream:
        process = subprocess.Popen(words, stdout=stream, stderr=stream, env=os.environ | {"RTGS_ROOT": str(root)})
    address = f"http://127.0.0.1:{port}"
    try:
        end = time.monotonic() + LONGEST_START
        while not answers(f"{address}/health"):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.3)
        yield address, log.read_text().splitlines()
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)


def free_port() -> int:
    import socket

    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5):
            return True
    except (urllib.error.URLError, OSError):
        return False


def asked(address: str, path: str, body: object = None) -> dict[str, Any]:
    """What the REST API answers."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{address}/api/2.0/mlflow/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def test_the_rest_api_gives_the_view_the_order_and_true_durations(served):
    address, printed = served
    experiment = asked(address, f"experiments/get-by-name?experiment_name={EXPERIMENT}")["experiment"]
    tags = {tag["key"]: tag["value"] for tag in experiment["tags"]}
    assert tags[KIND_TAG] == KIND
    (linked,) = [line.split()[-1] for line in printed if EXPERIMENT in line]
    key = re.search(r"viewStateShareKey=(\w+)", linked)
    assert key is not None
    saved = json.loads(tags[f"mlflow.sharedViewState.{key[1]}"])
    assert {type(saved[name]) for name in ("createdAt", "updatedAt")} == {int}
    state = json.loads(saved["state"])
    assert {"metrics.`eval/psnr`", "metrics.`eval/ssim`", "params.`method`"} <= set(state["selectedColumns"])
    order = f"{state['orderByKey']} {'ASC' if state['orderByAsc'] else 'DESC'}"
    body = {"experiment_ids": [experiment["experiment_id"]], "order_by": [order]}
    runs = asked(address, "runs/search", body)["runs"]
    names = [run["info"]["run_name"] for run in runs]
    assert names == ["fox-rtgs", "fox-envgs", "fox-2dgs", "sweep today"]
    *children, parent = (run["info"] for run in runs)
    assert all(30_000 <= info["end_time"] - info["start_time"] < 100_000 for info in children)
    assert parent["end_time"] - parent["start_time"] >= 100_000
    assert parent["end_time"] >= max(info["end_time"] for info in children)
    assert all(parent["start_time"] <= info["start_time"] for info in children)


def test_the_table_of_a_sweep_is_where_the_link_leads(served):
    address, printed = served
    (link,) = [line.split()[-1] for line in printed if "table of the newest sweep" in line]
    found = re.search(r"/runs/(\w+)/artifacts/(.+)\?", link)
    assert found is not None
    files = asked(address, f"artifacts/list?run_id={found[1]}&path=tables")["files"]
    assert [file["path"] for file in files] == [found[2]]
    with urllib.request.urlopen(f"{address}/get-artifact?run_uuid={found[1]}&path={found[2]}", timeout=60) as answer:
        table = json.load(answer)
    assert table["columns"] == ["method", "PSNR", "LPIPS"]
    assert table["data"][1] == ["fox-rtgs", 21.5, None]


@pytest.mark.skipif(chromium.browser() is None, reason="no Chromium (Debian: apt install chromium)")
def test_the_first_view_in_a_browser_has_the_best_run_on_top(served, tmp_path):
    pytest.importorskip("websockets")
    address, printed = served
    (link,) = [line.split()[-1] for line in printed if EXPERIMENT in line]
    assert link.startswith(address)
    with chromium.open_tab(link, tmp_path) as tab:
        shown = "document.body.innerText"
        tab.wait(f"{shown}.includes('eval/psnr') && {shown}.includes('fox-2dgs')", 180)
        text = tab.evaluate(shown)
    places = [text.index(name) for name in ("fox-rtgs", "fox-envgs", "fox-2dgs", "sweep today")]
    assert places == sorted(places)
    assert "eval/ssim" in text
