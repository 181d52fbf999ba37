"""Tools that time kernels run in a tiny mode and print the promised keys. No timings are judged."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from benchmarks.common import trace_scene, training_runs
from benchmarks.common.machine import thread_cpu_seconds
from benchmarks.speed import gaussians, light, losses, raster, raster_ellipsoids, speed_error, trace
from rtgs.native import core


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
    monkeypatch.setattr(trace_scene, "WIDTH", 40)
    monkeypatch.setattr(trace_scene, "HEIGHT", 28)


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


def test_light(run, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = light.figures((8, 6), (16, 8, 4, 4), 8, calls=2)  # a graph that is kept over calls has a gradient once
    monkeypatch.setattr(light, "figures", lambda: tiny | {f"lookup_128_{kind}": 1.0 for kind in ("ms", "torch_ms")})
    figures = run(light)
    parts = (*light.STEP, "step", "lookup_8")
    assert all(figures[f"{name}_{kind}"] > 0 for name in parts for kind in ("ms", "torch_ms", "ratio"))
    assert figures["step_ms"] == pytest.approx(sum(figures[f"{name}_ms"] for name in light.STEP), abs=0.01)
    assert figures["isa"] == core.isa()
    native, twin = (getattr(light.parts((8, 6), (16, 8, 4, 4), 8)["prefilter"], kind)() for kind in ("native", "twin"))
    assert (native[6 * 16**2 :] - twin[6 * 16**2 :]).abs().max() < 1e-5, "both are the same filter"
