"""What counts as empty air, and how much of the picture it makes."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import pytest
import torch
from torch import Tensor

import rtgs
from lab import empty_air
from pipelines.cli.main import main
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.scenes.scene import View
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

SIDE = 16
CAMERA = Camera(torch.eye(3), torch.zeros(3), 16.0, 16.0, SIDE / 2, SIDE / 2, SIDE, SIDE)


@dataclass(frozen=True)
class Truth:
    depth: Tensor
    specular: Tensor


@dataclass(frozen=True)
class Seen:
    camera: Camera
    truth: Truth | None


def wall(depth: float = 2.0) -> Truth:
    """A wall across the picture; its left quarter is a mirror."""
    specular = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    specular[:, : SIDE // 4] = True
    return Truth(torch.full((SIDE, SIDE), depth), specular)


def air(*centers: tuple[float, float, float], truth: Truth | None = None) -> list[bool]:
    view = cast(View, Seen(CAMERA, truth or wall()))
    return empty_air.in_the_air(torch.tensor(centers), [view]).tolist()


def test_what_a_view_sees_through_is_in_the_air():
    assert air((0.0, 0.0, 1.0), (0.0, 0.0, 1.89)) == [True, True]


def test_on_a_surface_behind_it_and_out_of_the_picture_are_not():
    assert air((0.0, 0.0, 1.91), (0.0, 0.0, 3.0), (5.0, 0.0, 1.0), (0.0, 0.0, -1.0)) == [False] * 4


def test_mirrors_nothing_and_the_pixels_beside_them_tell_nothing():
    left = (-0.45, 0.0, 1.0)  # column 0
    beside = (4.5 / 16 - 0.5, 0.0, 1.0)  # column 4, the first that is no mirror
    clear = (5.5 / 16 - 0.5, 0.0, 1.0)
    assert air(left, beside, clear) == [False, False, True]
    assert air((0.0, 0.0, 1.0), truth=wall(0.0)) == [False]


def test_the_nearest_of_the_pixels_around_counts():
    truth = wall(4.0)
    truth.depth[:, SIDE // 2 + 1] = 2.0
    assert air((0.0, 0.0, 1.95), (2.5 / 16 * 1.95, 0.0, 1.95), (3.5 / 16 * 1.95, 0.0, 1.95), truth=truth) == [
        False,
        False,
        True,
    ]


def test_views_without_truth_tell_nothing():
    assert empty_air.in_the_air(torch.tensor([[0.0, 0.0, 1.0]]), [cast(View, Seen(CAMERA, None))]).tolist() == [False]


@pytest.mark.parametrize("kind", [rtgs.Surfels, rtgs.Ellipsoids])
def test_weight_is_that_of_the_marked(kind):
    points = torch.tensor([[-0.3, 0.0, 1.5], [0.3, 0.0, 1.5]])
    start = rtgs.InitSettings(opacity=0.8, scale=0.1, min_points=1)
    generator = torch.Generator().manual_seed(0)
    both = rtgs.gaussians_from_points(kind, points, torch.full((2, 3), 0.5), start, generator)
    first, total = empty_air.summed_weight(both, torch.tensor([True, False]), CAMERA, 0.1)
    second, again = empty_air.summed_weight(both, torch.tensor([False, True]), CAMERA, 0.1)
    assert total == again > 0
    assert min(first, second) > 0
    assert first + second == pytest.approx(total, rel=1e-5)


def test_a_run_of_a_scene_with_truth(root, run, capsys):
    words = [word for word in QUICK if not word.startswith("scene.points")]
    assert main(["run", "scene=matte_room", "method=2dgs", "name=room", *words]) == 0
    capsys.readouterr()
    [found] = run(empty_air, "runs/room")
    assert found["run"] == "room"
    assert 0 < found["weight"] < 1
    assert 0 <= found["points"] < found["gaussians"] < 0.05  # points are on surfaces, and twelve steps move little


def test_a_scene_without_truth_is_refused(root, capture):
    assert main(["run", f"scene={capture}", "method=2dgs", "name=plain", *QUICK]) == 0
    with pytest.raises(RtgsError, match="plain: no test view has true depth"):
        empty_air.measure(root / "runs" / "plain")
