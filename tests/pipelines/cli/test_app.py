"""The whole chain on a capture of a few tiny pictures, through the command line."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from pipelines.cli.main import main
from pipelines.publishing import results
from rtgs.config.words import friendly_overrides
from rtgs.runs.record import RunRecord
from rtgs.workflow import Store
from tests.pipelines.app_cases import NAMED, QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


@pytest.fixture(scope="module")
def words(capture) -> list[str]:
    return ["run", f"scene={capture}", "method=2dgs", *QUICK]


@pytest.fixture(scope="module")
def first(root, words) -> Path:
    """The run folder of a first run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(words) == 0
    return root / "runs" / f"tiny_room-2dgs-smoke{NAMED}"


def test_a_run_leaves_what_people_look_at(first):
    names = {path.name for path in first.iterdir()}
    expected = {"report.html", "metrics.json", "metrics.csv", "point_cloud.ply", "config.yaml", "run.json", "renders"}
    assert expected <= names
    assert len(list((first / "renders").glob("*.png"))) == 2  # views 0 and 8 of 10
    assert yaml.safe_load((first / "config.yaml").read_text())["schedule"]["total"] == 12
    table = json.loads((first / "metrics.json").read_text())
    assert table["facts"]["steps"] == 12
    assert table["mean"]["psnr"] > 5
    page = (first / "report.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert "per view, maps included" in page  # what was timed


def test_a_second_run_only_reads_the_cache_and_says_so(first, words, capsys):
    before = (first / "run.json").stat().st_mtime_ns
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "5 steps, 5 from the cache, nothing to do" in captured.err
    assert "tiny_room" in captured.out
    assert f"report: runs/tiny_room-2dgs-smoke{NAMED}/report.html" in captured.out
    assert (first / "run.json").stat().st_mtime_ns == before


def test_the_plan_tells_why(first, words, capsys):
    assert main(["plan", *words[1:], "ablation=no_normal_loss"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["sfm", "skipped", "poses", "are", "given", "(transforms)"]
    assert lines[2].split()[:2] == ["masks", "skipped"]
    assert lines[3].split()[:2] == ["normals", "skipped"]
    assert lines[4].split()[0::2][:2] == ["import_scene", "cached"]
    assert "to run   method.loss.normal: 0.05 -> 0.0" in lines[5]
    assert "upstream train_diffuse changed" in lines[6]
    assert lines[-1] == "5 steps, 1 from the cache"


def test_the_report_is_found_and_comes_back_from_the_store(first, capsys):
    assert main(["report"]) == 0
    (first / "report.html").unlink()
    assert main(["report", f"tiny_room-2dgs-smoke{NAMED}"]) == 0
    shown = capsys.readouterr().out.split()
    assert [Path(line).resolve() for line in shown] == [(first / "report.html").resolve()] * 2
    assert (first / "report.html").is_file()
    assert main(["report", "nothing"]) == 1
    assert "no finished run 'nothing'" in capsys.readouterr().err


def test_the_cache_is_listed_and_sound(first, root, capsys):
    assert main(["cache", "ls"]) == 0
    listed = capsys.readouterr().out
    for name in ("import_scene", "train_diffuse", "render", "evaluate", "report"):
        assert name in listed
    assert main(["cache", "verify"]) == 0
    (folder,) = (artifact.folder for artifact in Store(root / "store").artifacts("evaluate"))
    content = (folder / "metrics.csv").read_bytes()
    (folder / "metrics.csv").write_bytes(content.replace(b"2dgs", b"3dgs", 1))
    assert main(["cache", "verify"]) == 1
    assert "metrics.csv has changed" in capsys.readouterr().out
    (folder / "metrics.csv").write_bytes(content)
    assert main(["cache", "gc"]) == 0
    assert "removed 0 folders" in capsys.readouterr().out


def test_a_mesh_on_request(words, first, root):
    trained = len(list(Store(root / "store").artifacts("train_diffuse")))
    assert main([*words, "mesh.extract=true", "mesh.tsdf.resolution=64", "name=meshed"]) == 0
    assert (root / "runs" / "meshed" / "mesh.ply").is_file()
    assert "Mesh" in (root / "runs" / "meshed" / "report.html").read_text()
    assert len(list(Store(root / "store").artifacts("train_diffuse"))) == trained
    assert main([*words, "name=meshed"]) == 0
    assert not (root / "runs" / "meshed" / "mesh.ply").exists()  # another run of this name: nothing is left of it


def test_an_executed_run_is_tracked_with_its_steps(words, first, root):
    assert main([*words, "tracking=jsonl", "seed=7"]) == 0
    runs = {}
    for path in (root / "tracking").rglob("events.jsonl"):
        events = [json.loads(line) for line in path.read_text().splitlines()]
        assert events[-1]["status"] == "finished"
        runs[events[0]["name"].split()[0]] = (path.parent, events)
    assert set(runs) == {f"tiny_room-2dgs-smoke-seed7{NAMED}", "train_diffuse", "render", "evaluate", "report"}
    folder, events = runs[f"tiny_room-2dgs-smoke-seed7{NAMED}"]
    assert events[0]["tags"]["rtgs.method"] == "2dgs"
    assert events[0]["tags"]["rtgs.step.train_diffuse"] == runs["train_diffuse"][1][0]["fingerprint"]
    assert {event["name"] for event in events if event["kind"] == "table"} == {"plan", "eval"}
    metrics = {key: event["step"] for event in events if event["kind"] == "metrics" for key in event["values"]}
    assert metrics["train/loss"] == 12
    assert metrics["eval/psnr"] is None
    assert {"report.html", "point_cloud.ply"} <= {path.name for path in (folder / "artifacts").iterdir()}


def test_a_tracked_run_shows_what_tells_it_apart_and_keeps_the_whole_config(words, first, root):
    """Trackers print every parameter above every picture: only those that a person tells runs apart by."""
    assert main([*words, "tracking=jsonl", "seed=8", "table.data=own"]) == 0
    (path,) = (root / "tracking" / "rtgs-runs").glob("*-seed8*/events.jsonl")
    events = [json.loads(line) for line in path.read_text().splitlines()]
    (told,) = (event["values"] for event in events if event["kind"] == "params")
    names = {"scene": "tiny_room", "method": "2dgs", "preset": "smoke", "ablation": "none", "seed": "8"}
    given = {word.partition("=")[0] for word in QUICK} - {"preset", "tracking", "threads"}
    assert told == names | {key: value for key, value in told.items() if key in given | {"scene.path"}}
    assert told["schedule.total"] == "12"
    config = yaml.safe_load((path.parent / "artifacts" / "config.yaml").read_text())
    assert config == yaml.safe_load((root / "runs" / f"tiny_room-2dgs-smoke-seed8{NAMED}" / "config.yaml").read_text())
    assert f"numpy=={np.__version__}" in (path.parent / "artifacts" / "requirements.txt").read_text().splitlines()
    assert config["method"]["loss"]["normal"] == 0.05


def test_a_run_that_was_not_tracked_is_recorded_once_a_tracker_is_on(words, first, root):
    def recorded() -> int:
        return len(list((root / "tracking" / "rtgs-runs").glob(f"*_tiny_room-2dgs-smoke{NAMED}_*")))

    assert recorded() == 0
    for _ in range(2):
        assert main([*words, "tracking=jsonl"]) == 0
        assert recorded() == 1
    shutil.rmtree(root / "tracking")
    assert main([*words, "tracking=jsonl"]) == 0
    assert recorded() == 1


def test_a_tracked_run_is_noted_only_in_its_own_folder(tmp_path):
    """Another run of the name may have taken the folder while the tracker was closed."""
    folder = tmp_path / "named"
    folder.mkdir()
    mine = [SimpleNamespace(step=SimpleNamespace(name="train", fingerprint="a"))]
    for steps, places in (({"train": "b"}, ()), ({"train": "a"}, ("here",))):
        RunRecord("named", "rtgs run", "now", {}, steps).write(folder)
        results.note_tracked(folder, mine, "here")  # type: ignore[arg-type]
        record = RunRecord.read(folder)
        assert record is not None
        assert (record.steps, record.tracked) == (steps, places)


def test_a_damaged_record_is_named_to_readers_and_replaced_by_a_run(first, words, root, capsys):
    whole = (first / "run.json").read_text()
    (first / "run.json").write_text(whole[:40])
    assert main(["report", first.name]) == 1
    assert "run.json cannot be read as a record" in (told := capsys.readouterr().err)
    assert "delete it, and the same command writes it again" in told
    assert main(words) == 0
    assert "the folder is written anew" in capsys.readouterr().err
    record = RunRecord.read(first)
    assert record is not None
    assert record.steps == json.loads(whole)["steps"]
    assert main(["report", first.name]) == 0


def test_sweeps_share_steps_and_end_with_a_table(words, first, root, capsys):
    store = Store(root / "store")
    before = len(list(store.artifacts("train_diffuse")))
    assert main([*words, "--multirun", "ablation=none,no_normal_loss"]) == 0
    captured = capsys.readouterr()
    assert len(list(store.artifacts("import_scene"))) == 1
    assert len(list(store.artifacts("train_diffuse"))) == before + 1
    table = captured.out.strip().splitlines()
    assert table[-2].split()[:2] == ["tiny_room", "2dgs"]
    assert "2dgs, no_normal_loss" in table[-1]


def test_a_failing_job_does_not_stop_the_others(words, first, capsys):
    assert main([*words, "--multirun", "schedule.densify_every=0,5"]) == 1
    captured = capsys.readouterr()
    assert "1 of 2 jobs failed" in captured.out
    assert "schedule.densify_every is 0" in captured.err
    assert "report: runs/tiny_room-2dgs-smoke" in captured.out


def test_a_composed_config_is_printed_and_nothing_runs(words, root, capsys):
    before = sorted((root / "runs").glob("*"))
    assert main([*words, "seed=41", "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["seed"] == 41
    assert sorted((root / "runs").glob("*")) == before


def test_a_run_without_test_views_ends_with_a_report_without_figures(words, capsys):
    assert main([*words, "scene.split_every=0", "name=unmeasured", "tracking=mlflow"]) == 0
    captured = capsys.readouterr()
    assert "nothing is measured: the scene has no test views" in captured.err
    assert "n/a" in captured.out
    assert "no test views" in (Path("runs") / "unmeasured" / "report.html").read_text(encoding="utf-8")


def test_check_tells_whether_a_capture_can_be_trained_on(capture, tmp_path, capsys):
    assert main(["check", str(capture), "scene.points=random"]) == 0
    assert "ready for training" in capsys.readouterr().out
    assert main(["check", str(tmp_path)]) == 1
    assert "is no capture" in capsys.readouterr().out


def test_weights_are_listed_and_never_fetched(capsys):
    assert main(["weights"]) == 0
    listed = capsys.readouterr().out
    for text in ("vgg16", "sha256", "licence", "RTGS_WEIGHTS"):
        assert text in listed


def test_a_folder_is_as_good_as_a_scene(capture, monkeypatch):
    path = f"scene.path='{capture}'"
    assert friendly_overrides([f"scene={capture}", "-m", "seed=1"]) == ["-m", "scene=capture", path, "seed=1"]
    assert friendly_overrides([f"scene.path={capture}", "--cfg", "job"]) == ["--cfg", "job", path, "scene=capture"]
    assert friendly_overrides(["scene=fox", f"scene.path={capture}"]) == ["scene=fox", path]
    assert friendly_overrides(["scene=fox,bonsai"]) == ["scene=fox,bonsai"]
    monkeypatch.chdir(capture.parent)
    assert friendly_overrides(["scene=tiny room"]) == ["scene=capture", "scene.path='tiny room'"]


def test_help_and_unknown_commands(capsys):
    assert main(["--help"]) == 0
    assert "rtgs run" in capsys.readouterr().out
    assert main(["fly"]) == 2
    assert "unknown command 'fly'" in capsys.readouterr().err


def test_the_module_is_the_same_as_the_command(first, words):
    code = [sys.executable, "-m", "pipelines.run", *words[1:]]
    result = subprocess.run(code, capture_output=True, text=True, check=True)
    assert "nothing to do" in result.stderr


SLOW = frozenset({"torch", "mlflow", "distributed", "cv2", "skimage", "scipy"})


def slow_modules(words: list[str], watched: frozenset[str] = SLOW) -> str:
    """Which of the modules that take long to import a command loads."""
    code = (
        "import sys; from pipelines.cli.main import main; assert main(sys.argv[1:]) == 0; "
        f"print('loaded', sorted({set(watched)!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_planning_loads_nothing_that_takes_seconds():
    assert slow_modules(["plan", "--multirun", "experiment=table3", "preset=smoke"]) == "loaded []"


@pytest.mark.parametrize("sweep", [[], ["--multirun", "table.name=shown"]])
def test_a_run_that_is_all_there_is_shown_again_in_seconds(first, words, sweep):
    assert main([*words, *sweep]) == 0
    assert slow_modules([*words, *sweep]) == "loaded []"


@pytest.mark.parametrize("sweep", [[], ["--multirun", "table.name=recorded"]])
def test_a_run_is_recorded_in_mlflow_without_pandas(first, words, sweep, tmp_path):
    """It would stay in the process for as long as the run trains."""
    recorded = [word if word != "tracking=off" else "tracking=mlflow" for word in [*words, *sweep]]
    recorded += [f"tracking.uri=sqlite:///{tmp_path}/mlflow.db", f"name={tmp_path.name}"]
    assert slow_modules(recorded, frozenset({"mlflow", "pandas", "pyarrow"})) == "loaded ['mlflow']"


STOPS_AT_A_CHECKPOINT = """
import sys, time
from rtgs.train import trainer
save = trainer.save_checkpoint
trainer.save_checkpoint = lambda *given: (save(*given), time.sleep(600))
from pipelines.cli.main import main
main(sys.argv[1:])
"""


def test_a_killed_training_goes_on_and_ends_the_same(words, first, root, tmp_path, monkeypatch, capsys):
    longer = [*words, "schedule.total=200", "schedule.checkpoint_every=20", "name=long"]
    assert main(longer) == 0
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", STOPS_AT_A_CHECKPOINT, *longer], start_new_session=True)
    end = time.monotonic() + 120
    while not list(tmp_path.glob("store/train_diffuse/partial/*/checkpoints/step_*")):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(10)
    assert not list(Store(tmp_path / "store").artifacts("train_diffuse"))

    capsys.readouterr()
    assert main(longer) == 0
    assert "resumed from the checkpoint of step" in capsys.readouterr().err
    (one,), (two,) = (
        [a for a in Store(folder / "store").artifacts("train_diffuse") if a.manifest.params["schedule"]["total"] == 200]
        for folder in (root, tmp_path)
    )
    assert one.manifest.fingerprint == two.manifest.fingerprint
    assert one.manifest.files["base.ply"] == two.manifest.files["base.ply"]
    assert not list((tmp_path / "store").rglob("*.tmp-*"))
    assert not list((tmp_path / "store").glob("*/partial/*"))


def test_an_instruction_set_that_is_misspelled_stops_a_run_before_any_step(first, words, root):
    before = sorted((root / "store").rglob("manifest.json"))
    code = [sys.executable, "-m", "pipelines.run", *words[1:], "seed=9", "name=misspelled"]
    done = subprocess.run(code, env=os.environ | {"RTGS_ISA": "sse9"}, capture_output=True, text=True)
    assert done.returncode == 1
    assert "RTGS_ISA='sse9' is not an instruction set" in done.stderr
    assert before
    assert sorted((root / "store").rglob("manifest.json")) == before
