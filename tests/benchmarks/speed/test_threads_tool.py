"""How a training scales with threads: the fit, the tables, and a tiny training on one and on two threads."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from benchmarks.common.machine import machine
from benchmarks.speed import threads
from benchmarks.speed.threads import Run, ThreadsError
from benchmarks.speed.training_parts import StageShares
from rtgs.mesh.container import ObjectMesh, write_object_mesh
from tests.mesh.shapes import sphere

TINY = (
    *("--preset", "smoke", "--steps", "20", "--set", "scene.long_side=48", "method.density.max_surfels=800"),
    *("method.reflection.cells=3", "method.transmittance.interface.count=100", "method.loss.perceptual=0"),
)


def one_stage(seconds: float, shares: dict[str, float], steps: int = 10) -> StageShares:
    return StageShares("diffuse", steps, seconds, seconds, 100, shares, 0.1, 0.0, 0.0, {"base": 100})


@pytest.fixture
def glass(tmp_path: Path) -> Path:
    """Folder of a mesh where ball_statue has its glass ball."""
    folder = tmp_path / "mesh"
    folder.mkdir()
    write_object_mesh(folder, ObjectMesh(sphere(0.5, 24, (0.0, 0.0, 0.56)), "given", 0.02, flat=False))
    return folder


@pytest.mark.parametrize("counts", [(1, 2, 4, 8, 16), (1, 3), (2, 4, 8)])
def test_serial_share_of_exact_times(counts: tuple[int, ...]) -> None:
    assert threads.serial_share(counts, [10 + 90 / count for count in counts]) == pytest.approx(0.1, abs=1e-12)


def test_serial_share_at_its_ends() -> None:
    assert threads.serial_share([1, 2, 4], [8, 4, 2]) == pytest.approx(0, abs=1e-12), "all of it scales"
    assert threads.serial_share([1, 2, 4], [8, 8, 8]) == pytest.approx(1), "nothing does"
    assert threads.serial_share([1, 2], [8, 9]) > 1, "threads cost time"
    assert threads.serial_share([1, 2], [0, 0]) == 0
    with pytest.raises(ThreadsError, match="two numbers"):
        threads.serial_share([2, 2], [1, 1])


def test_serial_share_is_the_least_squares_line() -> None:
    # over 1/n = 1, 1/2, 1/4: mean 7/12, mean time 14/3, slope 50/7, so 1/2 at 1/n = 0
    assert threads.serial_share([1, 2, 4], [8, 3, 3]) == pytest.approx(0.5 / (0.5 + 50 / 7))


def test_stages_and_parts_by_number_of_threads() -> None:
    seconds = ({"raster": 0.9, "shading": 0.1, "once": 0.5}, {"raster": 0.45, "shading": 0.1, "once": 0.4})
    totals = [sum(parts.values()) for parts in seconds]
    shares = [{part: s / total for part, s in parts.items()} for parts, total in zip(seconds, totals, strict=True)]
    runs = [Run(n + 1, 6.5, (one_stage(totals[n], shares[n]),)) for n in range(2)]
    assert runs[0].minutes() == pytest.approx((100 * 0.1 + 0.5 + 6.5) / 60), "what is done once is not scaled up"
    (stage,) = threads.stage_scalings(runs)
    assert stage.step.ms == pytest.approx((100, 55))
    assert stage.step.speedup == pytest.approx((1, 1 / 0.55))
    assert stage.step.serial == pytest.approx(0.1)
    assert [part.name for part in stage.parts] == ["raster", "shading"], "what is done once is no part of a step"
    assert stage.once.ms == pytest.approx((500, 400))
    assert [part.serial for part in stage.parts] == pytest.approx([0, 1])
    assert threads.stages_table([1, 2], [stage]).splitlines() == [
        "| stage | 1 thread | 2 threads | serial |",
        "|---|---|---|---|",
        "| diffuse | 100.0 | 55.0 (1.82x) | 10 % |",
    ]
    assert threads.parts_table([1, 2], stage).splitlines() == [
        "| diffuse | 1 thread | 2 threads | speed-up | serial | serial ms |",
        "|---|---|---|---|---|---|",
        "| raster | 90.00 | 45.00 | 2.00x | 0 % | 0.00 |",
        "| shading | 10.00 | 10.00 | 1.00x | 100 % | 10.00 |",
        "| whole step | 100.00 | 55.00 | 1.82x | 10 % | 10.00 |",
        "| once | 500.00 | 400.00 | 1.25x | 60 % | 300.00 |",
    ]


def test_trainings_of_other_lengths_do_not_compare() -> None:
    runs = [Run(1, 1.0, (one_stage(1.0, {}, steps=10),)), Run(2, 1.0, (one_stage(1.0, {}, steps=20),))]
    with pytest.raises(ThreadsError, match="other stages"):
        threads.stage_scalings(runs)


def test_numbers_of_threads() -> None:
    assert threads.thread_counts([4, 2, 4], 4) == [1, 2, 4]
    with pytest.raises(ThreadsError, match=r"8, 16: must be 1 to 4, the cores"):
        threads.thread_counts([1, 16, 8], 4)
    with pytest.raises(ThreadsError, match="0: must be"):
        threads.thread_counts([0, 1], 4)
    with pytest.raises(ThreadsError, match="above 1"):
        threads.thread_counts([1], 4)


def test_more_threads_than_cores_are_refused_before_anything_runs(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["threads", "--threads", "1", "100000"])
    monkeypatch.setattr(threads, "train", lambda *_: pytest.fail("it trained"))
    with pytest.raises(SystemExit) as ended:
        threads.main()
    assert ended.value.code == 2
    assert "--threads 100000: must be 1 to" in capsys.readouterr().err


def test_trainings_see_no_settings_of_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("GOMP_SPINCOUNT", "0")
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    found = threads.environment()
    assert not {"OMP_NUM_THREADS", "GOMP_SPINCOUNT"} & set(found)
    assert found["PYTHONPATH"].split(":") == [str(Path(__file__).parents[3]), "elsewhere"]


def test_a_failed_training_says_why(tmp_path: Path) -> None:
    words = ["--scene", "ball_statue", "--mesh", str(tmp_path / "absent"), *TINY]
    with pytest.raises(ThreadsError, match=r"on 1 thread ended with 1:\n(.|\n)*absent"):
        threads.train(words, 1)


@pytest.mark.skipif(int(machine()["cores"]) < 2, reason="one core")
def test_a_glass_scene_on_one_and_two_threads(run, glass: Path) -> None:
    figures = run(threads, "--scene", "ball_statue", "--mesh", str(glass), "--threads", "2", *TINY)
    assert figures["threads"] == [1, 2]
    assert len(figures["minutes"]) == 2
    assert [stage["name"] for stage in figures["stages"]] == ["diffuse", "reflection", "transmittance"]
    for stage in figures["stages"]:
        assert all(ms > 0 for ms in stage["ms"])
        assert stage["speedup"] == pytest.approx([1, stage["ms"][0] / stage["ms"][1]])
        assert {"raster", "losses", "adam", "shading"} <= {part["name"] for part in stage["parts"]}
        for index in range(2):
            parts = sum(part["ms"][index] for part in stage["parts"])
            assert math.isclose(parts, stage["ms"][index], rel_tol=1e-6)
    assert "trace" in [part["name"] for part in figures["stages"][2]["parts"]]
    assert figures["stages"][2]["once"]["ms"][0] > figures["stages"][2]["ms"][0], "the object in each camera"
    assert figures["machine"]["isa"]
