"""Tools that compare captures, poses and masks run in a tiny mode and print the promised keys."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.quality import captures, masks, sfm


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
