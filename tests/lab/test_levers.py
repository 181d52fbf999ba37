"""The levers are measured in a tiny mode; errors grow as a cut loosens. No timings are judged."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.common import trace_scene
from benchmarks.common.mirror_scene import mirror_scene
from lab import levers, raster_levers, trace_levers, trace_training


@pytest.fixture
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundredth of the rays: the shape of the answer, not its figures."""
    for module in (trace_scene, trace_levers):
        monkeypatch.setattr(module, "WIDTH", 40)
        monkeypatch.setattr(module, "HEIGHT", 28)


@pytest.mark.usefixtures("few_rays")
def test_levers_of_the_tracer(run, tmp_path: Path) -> None:
    figures = run(levers, "--quick", "--parts", "tracer", "--output", str(tmp_path))
    points = figures["tracer"]["points"]
    found = {point["lever"] for point in points}
    assert found == {
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
    assert (tmp_path / "levers_tracer.png").read_bytes().startswith(b"\x89PNG")


def test_levers_of_the_rasterizer(run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(raster_levers, "WIDTH", 80)
    monkeypatch.setattr(raster_levers, "HEIGHT", 60)
    figures = run(levers, "--quick", "--parts", "rasterizer", "--output", str(tmp_path))
    points = figures["rasterizer"]["points"]
    assert {point["lever"] for point in points} == {"transmittance_cutoff", "alpha_cutoff", "resolution"}
    for lever, default in raster_levers.defaults().items():
        own = [point for point in points if point["lever"] == lever]
        assert own[0]["setting"] == default, "the default comes first"
        errors = [-math.inf if point["psnr"] is None else -point["psnr"] for point in own]
        assert errors == sorted(errors), "a looser cut is less exact"
        assert all(point["ms"] > 0 for point in own)
    assert (tmp_path / "levers_rasterizer.png").read_bytes().startswith(b"\x89PNG")


def test_levers_end_to_end(run, tmp_path: Path) -> None:
    words = ("--steps", "4", "--settings", "2", "--long-side", "32")
    figures = run(levers, "--quick", "--parts", "end_to_end", *words, "--output", str(tmp_path))
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
