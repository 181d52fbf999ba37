"""Several attempts at poses: which one counts, and when another is worth its time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from rtgs.prepare.poses import sfm
from rtgs.prepare.settings import SfmSettings


@dataclass
class Model:
    """What is asked of COLMAP's model."""

    photos: int
    observations: int
    error: float
    side: int = 800
    points: int = 100
    cameras: dict[int, SimpleNamespace] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.cameras = {1: SimpleNamespace(width=self.side, height=self.side // 2)}

    def num_reg_images(self) -> int:
        return self.photos

    def num_points3D(self) -> int:
        return self.points

    def compute_num_observations(self) -> int:
        return self.observations

    def compute_mean_reprojection_error(self) -> float:
        return self.error


GOOD = Model(50, 900, 0.4)


@pytest.mark.parametrize(
    ("attempts", "made", "chosen"),
    [
        ([[GOOD], [Model(50, 999, 0.1)]], 1, 0),
        ([[Model(50, 500, 0.96)], [GOOD]], 2, 1),  # every photo placed, wrongly
        ([[Model(30, 900, 0.4)], [Model(50, 800, 0.6)]], 2, 1),
        ([[Model(30, 900, 0.4)], [Model(29, 950, 0.4)], []], 3, 0),
        ([[Model(50, 900, 0.7, side=400)], [Model(50, 800, 0.7, side=400)], [Model(40, 999, 0.1)]], 3, 0),
        ([[Model(50, 900, 1.1, side=1600)]], 1, 0),  # 0.55 at 800 a side
        ([[Model(2, 900, 0.1)], [], []], 3, None),  # too small to count
        ([[Model(50, 0, 0.0, points=0)], [], [Model(9, 90, 0.5)]], 3, 2),  # photos, and no point that holds them
    ],
)
def test_the_best_attempt_counts(monkeypatch, tmp_path: Path, attempts, made: int, chosen: int | None) -> None:
    seen: list[float] = []

    def attempt(place, settings, leniency, ticker):
        seen.append(leniency)
        return attempts[len(seen) - 1]

    monkeypatch.setattr(sfm, "_incremental", attempt)
    photos = SimpleNamespace(photos=[None] * 50)
    models, _ = sfm._map(photos, sfm.Workplace(tmp_path), SfmSettings(), lambda *_: None)  # type: ignore[arg-type]
    assert seen == [0.5**trial for trial in range(made)]
    assert models == ([] if chosen is None else attempts[chosen])
