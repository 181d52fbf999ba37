"""The tool that troubles runs: every trouble once on a toy capture, in a process of its own, since it forks."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.quality.soak import spoil

ROOT = Path(__file__).parents[3]
TOY = (
    "preset=smoke",
    "scene.long_side=24",
    "scene.points=random",
    "scene.random_points=150",
    "schedule.total=24",
    "schedule.checkpoint_every=3",
    "schedule.densify_every=5",
)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Nine pictures from cameras in a row."""
    folder = tmp_path / "row"
    (folder / "images").mkdir(parents=True)
    chance, frames = np.random.default_rng(3), []
    for index in range(9):
        Image.fromarray(chance.integers(0, 255, (18, 24, 3), dtype=np.uint8)).save(folder / f"images/{index}.png")
        pose = np.eye(4)
        pose[:3, 3] = (0.2 * index, 0.1 * (index % 2), 3.0)
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 24, "h": 18, "fl_x": 20.0, "fl_y": 20.0, "cx": 12.0, "cy": 9.0, "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


def test_every_trouble_ends_like_an_undisturbed_run(capture: Path, tmp_path: Path):
    command = [sys.executable, "-m", "benchmarks.quality.soak", "--rounds", "1", "--methods", "2dgs", "--runs", "4"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [*command, f"scene={capture}", *TOY], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    assert [figures[name] for name in ("rounds", "kills", "disk", "races", "damage")] == [1, 1, 1, 1, 1]
    assert sum(count for name, count in figures.items() if name.startswith("hit_")) == figures["sigkill"]
    assert figures.get("resumed_train_diffuse", 0) == min(figures.get("behind_train_diffuse", 0), 1)
    assert figures["flat"]["runs"] == 4
    assert figures["flat"]["handles"] > 2
    assert not list(tmp_path.glob("rtgs_soak_*"))


@pytest.mark.parametrize("how", ["truncate", "remove", "garble", "flip"])
def test_every_damage_changes_the_file(tmp_path: Path, how: str):
    path, content = tmp_path / "file", bytes(range(200))
    for seed in range(20):
        path.write_bytes(content)
        spoil(path, how, random.Random(seed))
        assert not path.exists() or path.read_bytes() != content
        assert path.exists() == (how != "remove")
