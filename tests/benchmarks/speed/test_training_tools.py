"""Tools that time trainings run in a tiny mode and print the promised keys. No timings are judged."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from benchmarks.speed import train_step, training_parts, transmittance_step
from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectMesh, write_object_mesh
from tests.mesh.shapes import sphere


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
    assert [stage["preset_steps"] for stage in figures["stages"]] == [24, 48, 48], "of preset smoke, before glass"
    assert {"base", "reflection", "transmittance", "interface"} == set(third["surfels"])
    assert third["rays"] > figures["stages"][1]["rays"], "straight rays besides"
    assert third["fixed"] > 0
    assert third["shares"]["once"] > 0
    assert figures["mesh_seconds"] > 0
    trained = sum(stage["seconds"] * stage["preset_steps"] / stage["steps"] for stage in figures["stages"])
    assert figures["minutes"] == pytest.approx((trained + figures["mesh_seconds"]) / 60, abs=1e-3)


def test_what_is_done_once_keeps_its_parts_to_itself() -> None:
    ticks = iter(range(100))
    clock = training_parts.PartClock(lambda: float(next(ticks)))
    with clock.part("shading"), clock.part("once"):
        with clock.part("trace"), clock.part("once"):
            pass
        with clock.part("raster"):
            pass
    with clock.part("raster"):
        pass
    assert dict(clock.seconds) == {"shading": 2, "once": 1, "raster": 1}


def test_training_parts_by_the_wall_on_one_thread(run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "thread_time", lambda: pytest.fail("CPU seconds"))
    words = ("--preset", "smoke", "--steps", "24", "--set", "scene.long_side=48", "method.reflection.matte.probation=0")
    figures = run(training_parts, "--scene", "spheres", "--wall", *words)
    assert all(stage["seconds"] > 0.9 * stage["cpu_seconds"] for stage in figures["stages"])


def test_training_parts_refuses_a_mesh_that_no_stage_takes_or_that_is_not_there(run, tmp_path: Path) -> None:
    words = ("--preset", "smoke", "--steps", "20", "--set", "scene.long_side=48")
    with pytest.raises(RtgsError, match=r"mesh\.json"):
        run(training_parts, "--scene", "ball_statue", "--mesh", str(tmp_path), *words)
    write_object_mesh(tmp_path, ObjectMesh(sphere(0.5, 12), "given", 0.02, flat=False))
    with pytest.raises(RtgsError, match="no stage for glass"):
        run(training_parts, "--scene", "spheres", "--mesh", str(tmp_path), *words)


def test_transmittance_step(run) -> None:
    words = ("--steps", "20", "--settle", "2", "--rounds", "2", "--set", *GLASS)
    figures = run(transmittance_step, "--scene", "ball_statue", *words)
    assert figures["mask_share"] == pytest.approx(0.194, abs=0.005), "0.25, and less in every fourth, wide view"
    assert figures["ratio"] == pytest.approx(figures["third_stage_ms"] / figures["second_stage_ms"], abs=2e-2)
    assert {"transmittance", "interface"} <= set(figures["surfels"])
    assert figures["machine"]["isa"]
