"""Every script of examples/ runs as its first lines say, and writes what it says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rtgs

FOLDER = Path(__file__).resolve().parents[2] / "examples"
LONGEST = 60  # lines of a script


def run(name: str, out: Path, *words: str) -> str:
    """What a script prints; it runs in a process of its own, away from the repository."""
    (script,) = FOLDER.glob(f"{name}_*.py")
    command = [sys.executable, str(script), "--out", str(out), *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=out.parent, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


def spread(path: Path) -> float:
    """Standard deviation of a picture's values in 0..255: 0 where it shows nothing."""
    return float(np.asarray(Image.open(path), dtype=np.float64).std())


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the first example wrote."""
    out = tmp_path_factory.mktemp("first") / "out"
    assert "4000 surfels" in run("01", out, "--size", "64")
    return out


def test_01_rasterises_the_points(first: Path):
    assert sorted(path.name for path in first.iterdir()) == ["depth.png", "gaussians.ply", "image.png", "photo.png"]
    assert Image.open(first / "image.png").size == Image.open(first / "photo.png").size == (64, 48)
    for name in ("image", "depth"):
        assert spread(first / f"{name}.png") > 10
    assert len(rtgs.read_gaussians(first / "gaussians.ply")) == 4000


def test_01_reads_gaussians_of_either_kind(first: Path, tmp_path: Path):
    run("01", tmp_path / "surfels", "--size", "64", "--ply", str(first / "gaussians.ply"))
    again = (tmp_path / "surfels" / "image.png").read_bytes()
    assert again == (first / "image.png").read_bytes()
    surfels = rtgs.read_gaussians(first / "gaussians.ply")
    ellipsoids = rtgs.Ellipsoids.of(dict(surfels.items()) | {"log_scales": surfels.log_scales[:, [0, 1, 1]]})
    rtgs.write_ply(tmp_path / "ellipsoids.ply", ellipsoids)
    printed = run("01", tmp_path / "ellipsoids", "--size", "64", "--ply", str(tmp_path / "ellipsoids.ply"))
    assert "4000 ellipsoids" in printed
    assert spread(tmp_path / "ellipsoids" / "image.png") > 10


def test_02_traces_what_is_seen_and_what_is_mirrored(tmp_path: Path):
    assert "surfels" in run("02", tmp_path / "out", "--size", "64")
    for name in ("seen", "mirrored"):
        assert spread(tmp_path / "out" / f"{name}.png") > 10


def test_03_trains_and_measures(tmp_path: Path):
    printed = run("03", tmp_path / "out", "--size", "64", "--steps", "30")
    before, after = re.findall(r"^(?:before|after 30 steps): ([\d.]+) dB", printed, re.MULTILINE)
    assert float(after) > float(before) + 1
    assert len(list((tmp_path / "out").glob("*.png"))) == 3
    assert isinstance(rtgs.read_gaussians(tmp_path / "out" / "base.ply"), rtgs.Surfels)


def test_04_a_term_of_its_own_changes_what_is_trained(tmp_path: Path):
    printed = run("04", tmp_path / "out", "--steps", "25")
    shares = dict(re.findall(r"^(with|without) the term: ([\d.]+) of", printed, re.MULTILINE))
    assert 0 < float(shares["with"]) < 0.98 * float(shares["without"])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"with.png", "without.png"}


def test_05_writes_a_picture_for_each_frame(first: Path, tmp_path: Path):
    run("05", tmp_path / "out", "--frames", "3", "--width", "64", "--ply", str(first / "gaussians.ply"))
    frames = sorted((tmp_path / "out").glob("*.png"))
    assert [path.name for path in frames] == ["000.png", "001.png", "002.png"]
    assert len({path.read_bytes() for path in frames}) == 3
    assert min(map(spread, frames)) > 10


@pytest.mark.parametrize("more", [(), ("--surfels",)], ids=["ellipsoids", "surfels"])
def test_06_fits_a_photo(tmp_path: Path, more: tuple[str, ...]):
    said = run("06", tmp_path / "out", "--size", "48", "--steps", "40", *more)
    before, after = map(float, re.findall(r"([\d.]+) dB", said))
    assert after > before + 5
    assert spread(tmp_path / "out" / "image.png") > 10


def test_every_script_is_run_here_and_short():
    scripts = sorted(FOLDER.glob("*.py"))
    numbers = [path.name[:2] for path in scripts]
    assert numbers == [f"{number:02d}" for number in range(1, len(scripts) + 1)]
    for number, path in zip(numbers, scripts, strict=True):
        text = path.read_text(encoding="utf-8")
        assert f"test_{number}_" in Path(__file__).read_text(encoding="utf-8")
        assert f"python examples/{path.name} --out out/{number}" in text
        assert len(text.splitlines()) <= LONGEST
        assert not re.search(r"^ *(?:from|import) rtgs\.", text, re.MULTILINE), "examples use what rtgs exports"
