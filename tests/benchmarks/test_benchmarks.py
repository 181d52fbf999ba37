"""Every benchmark runs in a tiny mode and ends with a JSON object that has the promised keys. No timings are judged."""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from benchmarks import (
    captures,
    gaussians,
    losses,
    masks,
    optics_gain,
    raster,
    raster_ellipsoids,
    raster_levers,
    sfm,
    speed_error,
    trace,
    trace_levers,
    trace_scene,
    trace_training,
    train_step,
    training_choices,
    training_parts,
    training_runs,
    transmittance_step,
)
from benchmarks.machine import thread_cpu_seconds
from rtgs.native import core
from tests.methods.mirror_scene import mirror_scene


@pytest.fixture(autouse=True)
def _nothing_shared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No prototypes and no captures beside the repository: what a stranger has."""
    monkeypatch.setenv("RTGS_SHARED", str(tmp_path / "absent"))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run a benchmark's ``main`` with a command line and return the object on its last line."""

    def last_line(module: ModuleType, *words: str) -> dict[str, Any]:
        monkeypatch.setattr(sys, "argv", [module.__name__, *words])
        before = core.isa()
        module.main()
        assert core.isa() == before, "a benchmark puts the instruction set back"
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return last_line


def test_raster(run) -> None:
    figures = run(raster, "--repeat", "1", "--counts", "20000")
    for stage in ("project", "forward", "backward", "full"):
        assert figures[f"ratio_{stage}_20k"] is None, "without the prototype there is nothing to compare with"
    assert set(figures["ms_20k"]) == {"ours", "full"}
    assert all(figures[key] > 0 for key in ("cost_of_outputs_20k", "speedup_2_threads", "peak_memory_mb"))
    assert figures["machine"]["isa"] == core.isa()


def test_raster_ellipsoids(run) -> None:
    figures = run(raster_ellipsoids, "--repeat", "1", "--counts", "20000")
    assert all(figures[f"ratio_{stage}_20k"] > 0 for stage in ("project", "forward", "backward"))
    assert set(figures["ms_20k"]) == {"ellipsoids", "surfels"}
    assert figures["speedup_2_threads"] > 0
    assert figures["peak_memory_mb"] > 0
    assert (figures["splat"], figures["splat_mgaussians_per_s"]) == ("absent", None)


@pytest.fixture
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundredth of the rays: the shape of the answer, not its figures."""
    for module in (trace_scene, trace_levers):
        monkeypatch.setattr(module, "WIDTH", 40)
        monkeypatch.setattr(module, "HEIGHT", 28)


def test_cpu_time_of_a_thread_counts_up_to_the_call() -> None:
    """Work far shorter than a tick of the scheduler takes time, in the thread that does it."""
    for _ in range(20):
        before = thread_cpu_seconds()
        sum(range(1000))
        after = thread_cpu_seconds()
        assert after[threading.get_native_id()] > before[threading.get_native_id()]


@pytest.mark.usefixtures("few_rays")
def test_trace(run) -> None:
    figures = run(trace, "--repeat", "1", "--counts", "20000")
    assert figures["prototype"] is False
    for rays in ("cam", "refl"):
        for name in ("forward", "backward", "build", "refit", "full", "sh3"):
            assert figures[f"ratio_{name}_20k_{rays}"] is None, "without the prototype there is nothing to compare with"
        assert set(figures[f"ms_20k_{rays}"]) == {"features", "full", "sh3"}
        assert figures[f"cost_of_sh3_20k_{rays}"] > 0
        assert 5 < figures[f"hits_per_ray_20k_{rays}"] < 100
    assert set(figures["incoherent_auto_takes"].values()) <= {"given", "sorted"}
    assert all(figures[key] > 0 for key in ("ratio_incoherent", "speedup_2_threads", "peak_memory_mb"))


@pytest.mark.usefixtures("few_rays")
def test_speed_error_of_the_tracer(run, tmp_path: Path) -> None:
    figures = run(speed_error, "--quick", "--parts", "tracer", "--rounds", "2", "--output", str(tmp_path))
    points = figures["tracer"]["points"]
    levers = {point["lever"] for point in points}
    assert levers == {
        *("transmittance_cutoff", "alpha_cutoff", "refit_interval", "traced_share", "traced_block"),
        *("specular_threshold", "resolution"),
    }
    assert all(point["ms"] > 0 and point["relative_time"] > 0 for point in points)
    for lever in ("transmittance_cutoff", "alpha_cutoff"):
        errors = [point["gradient_error"] for point in points if point["lever"] == lever]
        assert errors == sorted(errors), "a looser cut is less exact"
        assert errors[0] < 0.1
    for lever, default in trace_levers.defaults().items():
        assert any(p["setting"] == default for p in points if p["lever"] == lever), "the default is among the settings"
    assert (tmp_path / "speed_error_tracer.png").read_bytes().startswith(b"\x89PNG")


def test_speed_error_of_the_rasterizer(run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(raster_levers, "WIDTH", 80)
    monkeypatch.setattr(raster_levers, "HEIGHT", 60)
    figures = run(speed_error, "--quick", "--parts", "rasterizer", "--rounds", "2", "--output", str(tmp_path))
    points = figures["rasterizer"]["points"]
    assert {point["lever"] for point in points} == {"transmittance_cutoff", "alpha_cutoff", "resolution"}
    for lever, default in raster_levers.defaults().items():
        own = [point for point in points if point["lever"] == lever]
        assert own[0]["setting"] == default, "the default comes first"
        errors = [-math.inf if point["psnr"] is None else -point["psnr"] for point in own]
        assert errors == sorted(errors), "a looser cut is less exact"
        assert all(point["ms"] > 0 for point in own)
    assert (tmp_path / "speed_error_rasterizer.png").read_bytes().startswith(b"\x89PNG")


def test_speed_error_end_to_end(run, tmp_path: Path) -> None:
    words = ("--lever-steps", "4", "--lever-settings", "2", "--long-side", "32")
    figures = run(speed_error, "--quick", "--parts", "end_to_end", *words, "--output", str(tmp_path))
    points = figures["end_to_end"]
    assert [point["equal"] for point in points] == ["steps", "steps", "time"]
    assert points[0]["steps"] == points[1]["steps"] == 4
    assert all(point["psnr"] > 0 and point["cpu_seconds"] > 0 for point in points)


def test_every_lever_is_measured_end_to_end() -> None:
    reference, *others = trace_training.SETTINGS.values()
    turned = {word for words in others for word in words if word not in reference}
    keys = {word.split("=")[0].removeprefix("method.reflection.") for word in turned}
    assert keys == {"traced.threshold", "traced.share", "rebuild_every", "transmittance_cutoff", "alpha_cutoff"}
    assert trace_training.HALVED in trace_training.SETTINGS, "the resolution is turned by the scene"


def test_equal_time_is_found_from_two_runs() -> None:
    def point(steps: int) -> trace_training.EndToEndPoint:
        return trace_training.EndToEndPoint("a", "steps", steps, 1e-4 * steps**1.5, None, None)

    assert trace_training.afforded_steps(point(600), point(1275), point(900).cpu_seconds) == 900


def test_half_the_resolution_is_of_the_training_views_alone() -> None:
    made = mirror_scene(8, 25, 18, points=20, test_every=8).scene
    half = trace_training.half_resolution(made)
    assert half.test == made.test
    before, after = made.train[0], half.train[0]
    assert after.image.shape == (3, 9, 12)
    assert (after.camera.width, after.camera.height, after.camera.fx) == (12, 9, before.camera.fx / 2)
    assert after.image[:, 0, 0].tolist() == pytest.approx(before.image[:, :2, :2].mean((1, 2)).tolist())


def test_train_step(run) -> None:
    figures = run(train_step, "--rounds", "1")
    parts = ("activate", "raster", "photometric", "normal", "adam", "density")
    assert figures["step_over_raster"] > 0
    assert all(figures[f"{part}_ms"] > 0 for part in parts)
    assert math.isclose(sum(figures[f"share_{part}"] for part in (*parts, "rest")), 1, abs_tol=0.01)


def test_training_parts(run) -> None:
    words = ("--preset", "smoke", "--steps", "24", "--set", "scene.long_side=48", "method.reflection.matte.probation=0")
    figures = run(training_parts, "--scene", "spheres", *words)
    diffuse, reflection = figures["stages"]
    assert [stage["stage"] for stage in figures["stages"]] == ["diffuse", "reflection"]
    assert {"raster", "losses", "adam", "shading"} <= set(diffuse["shares"])
    assert {"trace", "tree", "choose"} <= set(reflection["shares"])
    assert diffuse["rays"] == 0
    assert reflection["rays"] > 0
    for stage in figures["stages"]:
        assert math.isclose(sum(stage["shares"].values()), 1, abs_tol=1e-6)
        assert stage["fixed"] > 0
    assert figures["extrapolated"]
    assert sum(stage["preset_steps"] for stage in figures["stages"]) == 120, "those of the preset"
    expected = sum(stage["seconds"] * stage["preset_steps"] / stage["steps"] for stage in figures["stages"]) / 60
    assert figures["minutes"] == pytest.approx(expected, abs=6e-4)
    assert figures["cpu_minutes"] > 0
    assert figures["mesh_seconds"] == 0
    assert figures["machine"]["isa"]


GLASS = (
    *("scene.long_side=48", "method.density.max_surfels=800", "method.reflection.cells=3"),
    *("method.transmittance.interface.count=100", "method.loss.perceptual=0"),
)


def test_training_parts_of_a_glass_scene_holds_mesh_and_third_stage(run) -> None:
    words = ("--preset", "smoke", "--steps", "20", "--set", *GLASS, "mesh.object.hull.voxels=24")
    figures = run(training_parts, "--scene", "tall_bottle", *words)
    third = figures["stages"][2]
    assert [stage["stage"] for stage in figures["stages"]] == ["diffuse", "reflection", "transmittance"]
    assert [stage["preset_steps"] for stage in figures["stages"]] == [36, 36, 48], "of preset smoke"
    assert {"base", "reflection", "transmittance", "interface"} == set(third["surfels"])
    assert third["rays"] > figures["stages"][1]["rays"], "straight rays besides"
    assert third["fixed"] > 0
    assert figures["mesh_seconds"] > 0
    trained = sum(stage["seconds"] * stage["preset_steps"] / stage["steps"] for stage in figures["stages"])
    assert figures["minutes"] == pytest.approx((trained + figures["mesh_seconds"]) / 60, abs=1e-3)


def test_transmittance_step(run) -> None:
    words = ("--steps", "20", "--settle", "2", "--rounds", "2", "--set", *GLASS)
    figures = run(transmittance_step, "--scene", "ball_statue", *words)
    assert figures["mask_share"] == pytest.approx(0.25, abs=0.01), "ball_statue fills 0.37 of its pictures"
    assert figures["ratio"] == pytest.approx(figures["third_stage_ms"] / figures["second_stage_ms"], abs=2e-2)
    assert {"transmittance", "interface"} <= set(figures["surfels"])
    assert figures["machine"]["isa"]


def test_optics_gain(run, tmp_path: Path) -> None:
    figures = run(optics_gain, str(tmp_path / "gain.png"))
    assert (tmp_path / "gain.png").read_bytes().startswith(b"\x89PNG")
    largest = figures["largest_gain"]
    assert largest["S_max 1"]["f0 0.04"] <= 1, "energy is conserved"
    assert largest["S_max 16"]["f0 0.04"] > 4, "near grazing"


def test_captures(run, tmp_path: Path) -> None:
    words = ["--preset", "smoke", "--scenes", "demo", "--methods", "3dgs", "2dgs+no_methods", "--root", str(tmp_path)]
    figures = run(captures, *words, "--set", "schedule.total=12", "scene.long_side=48")
    assert [entry["method"] for entry in figures["figures"]] == ["3dgs"]
    assert figures["figures"][0]["runs"][0]["psnr"] > 5
    assert figures["failures"][0].startswith("demo, 2dgs+no_methods, seed 0: ")
    text = (tmp_path / "captures-smoke.md").read_text(encoding="utf-8")
    assert "| demo | 3dgs | 48x36 | " in text
    assert "- failed: demo, 2dgs+no_methods, seed 0: " in text


def test_captures_gives_the_spread_over_seeds() -> None:
    runs = [captures.Measured(20.0 + k, 0.5, 10.0, 5.0, 100.0 + k, 1000 * k, "48x36", 2) for k in range(3)]
    cells = dict(zip(captures.COLUMNS, captures.row("demo", "3dgs", runs)))
    assert cells["PSNR"] == "21.00 +- 1.00"
    assert (cells["peak MB"], cells["Gaussians"], cells["seeds"]) == ("102", "1,000", "3")
    assert captures.row("demo", "3dgs", runs[:1])[4] == "20.00"


def test_losses(run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "SIZES", ((40, 30),))
    monkeypatch.setattr(losses, "NATIVE_CALLS", 1)
    monkeypatch.setattr(losses, "TORCH_CALLS", 1)
    monkeypatch.setattr(losses, "PERCEPTUAL_SIZE", (72, 66))
    monkeypatch.setattr(losses, "PERCEPTUAL_CALLS", 1)
    figures = run(losses)
    assert 0 < figures["perceptual_crop_ms"] < figures["perceptual_72x66_ms"] * 4
    for name in ("photometric", "normal", "normal_depth_weighted", "mono_normal"):
        assert all(figures[f"{name}_40x30_{kind}"] >= 0 for kind in ("ms", "torch_ms", "ratio"))
    assert figures["isa"] == core.isa()


def test_gaussians(run) -> None:
    figures = run(gaussians, "--counts", "1000", "--repeat", "2")
    for isa in core.available_isas():
        assert figures[f"activate_both_{isa}_1k"] > 0
    named = ("ratio_activate", "ratio_adam", "adam", "observe", "densify", "write_ply", "read_ply")
    assert all(figures[f"{name}_1k"] > 0 for name in named)


def test_speed_error(run, tmp_path: Path) -> None:
    kernel = ("--quick", "--surfels", "60", "--width", "32", "--rounds", "2")
    training = ("--scenes", "demo", "--steps", "2", "3", "--caps", "2000", "--long-side", "32")
    figures = run(speed_error, "--parts", "kernel", "training", *kernel, *training, "--output", str(tmp_path))
    paths = figures["kernel"]["paths"]
    assert set(paths) == {*core.available_isas(), "twin_float32", "twin_float64"}
    assert all(path["ms"] > 0 for path in paths.values())
    for name in set(paths) - {"twin_float64"}:
        assert 0 <= paths[name]["share_beyond"] <= 1
        assert 0 < paths[name]["picture_worst"] < 1e-3
        assert 0 < paths[name]["gradient_worst"] < 1e-2
    assert [(point["steps"], point["cap"]) for point in figures["training"]] == [(2, 2000), (3, 2000)]
    assert all(point["psnr"] > 0 and point["peak_memory_mb"] > 0 for point in figures["training"])
    assert json.loads((tmp_path / "speed_error.json").read_text(encoding="utf-8")) == figures
    assert (tmp_path / "speed_error.png").read_bytes().startswith(b"\x89PNG")
    assert run(speed_error, "--parts", "--keep", "--output", str(tmp_path)) == figures, "drawn again, nothing measured"


def test_speed_error_shrinks_the_schedule() -> None:
    overrides = dict(word.split("=") for word in training_runs.schedule_overrides(500, "quick"))
    assert overrides["schedule.total"] == overrides["schedule.means_lr_steps"] == "500"
    assert 100 <= int(overrides["schedule.densify_from"]) < int(overrides["schedule.densify_until"]) < 500


def test_speed_error_sweep_has_each_point_once() -> None:
    assert sorted(speed_error.sweep([500, 1000], [5, 10])) == [(500, 10), (1000, 5), (1000, 10)]


def test_sfm(run) -> None:
    figures = run(sfm)
    assert figures["rows"] == [], "without the photo sets there is nothing to compare with"
    row = sfm.Row("fox", 5, 4, ("e.jpg",), 0.01, 0.02, 0.001, 0.002, 0.01, 0.5, 1.0, 2.0, 3.0, 900.0, 300.0)
    assert "| fox | 4 of 5 (not e.jpg) | 0.010, max 0.020 | 1.00, max 2.00 | +1.00% |" in sfm.table([row])


def test_sfm_measures_a_set_once(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tokenizers")
    pytest.importorskip("onnx")
    from tests.prepare.glass_scene import shots, write_capture

    root = write_capture(tmp_path / "shared/data/room", shots(6, 320, 240))
    monkeypatch.setenv("RTGS_SHARED", str(tmp_path / "shared"))

    def here(words: list[str], **_) -> SimpleNamespace:
        with contextlib.redirect_stdout(io.StringIO()) as out:
            sfm.main(words[words.index("--one") :])
        return SimpleNamespace(returncode=0, stdout=out.getvalue().encode())

    monkeypatch.setattr(sfm.subprocess, "run", here)  # the process of its own, without its imports
    words = ("room", "--threads", "1", "--keep", str(tmp_path / "kept"))
    figures = run(sfm, *words)
    (row,) = figures["rows"]
    assert (row["given"], row["found"], row["missing"]) == (6, 6, [])
    assert row["rotation_max"] < 1
    assert row["translation_max"] < 0.05
    assert all(row[key] > 0 for key in ("seconds_per_photo", "cpu_per_photo", "memory_mb", "imports_mb"))
    for path in (root / "images").iterdir():
        path.unlink()
    assert run(sfm, *words)["rows"] == [row], "nothing is measured again"


@pytest.mark.parametrize("part", ["detector", "segmenter"])
def test_masks_times_a_network(run, part: str, tmp_path: Path) -> None:
    """Tiny networks with the ports of the real ones, already in their places: none is made."""
    pytest.importorskip("tokenizers")
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from tests.prepare.glass_scene import write_networks

    write_networks(tmp_path)
    figures = run(masks, "--part", part, "--photos", "1", "--one", str(tmp_path))
    assert set(figures) == {"seconds", "cpu_seconds", "load_seconds", "memory_mb", "imports_mb"}
    assert all(value > 0 for value in figures.values())


def test_training_choices_judges_without_test_views(run) -> None:
    words = ["--scenes", "ball_statue", "--preset", "smoke", "--set", "scene.long_side=48 schedule.total=40"]
    record = run(training_choices, *words, "--also", "method.loss.dssim=0")
    as_it_is, other = record["scores"]
    assert other["trial"]["words"].endswith("method.loss.dssim=0")
    assert as_it_is["psnr"] != other["psnr"]
    assert 5 < as_it_is["psnr"] < 40
    assert as_it_is["gaussians"] > 0
    assert as_it_is["cpu_seconds"] > 0


def test_training_choices_holds_out_training_views() -> None:
    scene = mirror_scene(16, 16, 12).scene
    kept = training_choices.judged_in_training(scene)
    judged, trained = {view.name for view in kept.test}, {view.name for view in kept.train}
    assert judged
    assert not judged & trained
    assert judged | trained == {view.name for view in scene.train}
