"""A capture of a few tiny pictures, words that train on it in seconds, and an empty folder to run in."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli.main import main
from rtgs.config.names import overridden

WIDTH, HEIGHT, VIEWS = 32, 24, 10
QUICK = (
    "preset=smoke",
    "scene.long_side=32",
    "scene.points=random",
    "scene.random_points=200",
    "schedule.total=12",
    "schedule.checkpoint_every=6",
    "schedule.densify_every=5",
    "tracking=off",
    "threads=1",
)
NAMED = f"-{overridden(QUICK)}"
"""What they add to a run's name."""


def folders(run: Path) -> dict[str, Path]:
    """The artifact of each step of a run."""
    steps = json.loads((run / "run.json").read_text())["steps"]
    return {name: run.parents[1] / "store" / name / key[:2] / key for name, key in steps.items()}


def finished(root: Path, capture: Path, words: tuple[str, ...], name: str) -> Path:
    """The folder of a run of this name, for fixtures that many tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("RTGS_ROOT", str(root))
        assert main(["run", f"scene.path={capture}", *words, f"name={name}"]) == 0
    return root / "runs" / name


def pose(index: int) -> list[list[float]]:
    """Camera to world (OpenGL axes) on a ring around the origin, looking at it."""
    angle = 2 * math.pi * index / VIEWS
    backward = np.array([math.cos(angle), 0.2, math.sin(angle)])
    backward /= np.linalg.norm(backward)
    right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    matrix[:3, 3] = 3 * backward
    return matrix.tolist()


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A nerfstudio capture of ten pictures."""
    folder = tmp_path_factory.mktemp("captures") / "tiny room"
    (folder / "images").mkdir(parents=True)
    frames = []
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    for index in range(VIEWS):
        picture = np.stack([128 + 90 * np.sin(x / 5 + index), 128 + 90 * np.cos(y / 4), 100 + x], axis=-1)
        Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(folder / "images" / f"{index:03d}.png")
        frames.append({"file_path": f"images/{index:03d}.png", "transform_matrix": pose(index)})
    shared = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": frames}))
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("root")


@pytest.fixture(autouse=True)
def _in_root(root, monkeypatch):
    """Commands run as from an empty folder; the loggers Hydra sets up are put back."""
    monkeypatch.chdir(root)
    monkeypatch.setenv("RTGS_ROOT", str(root))
    monkeypatch.delenv("RTGS_DEBUG", raising=False)
    handlers, level = logging.root.handlers[:], logging.root.level
    yield
    logging.root.handlers[:], logging.root.level = handlers, level
