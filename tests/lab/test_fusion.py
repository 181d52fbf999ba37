"""The table "which fusion" of docs/lab/mesh.md at a size that a test can afford."""

from pathlib import Path

import pytest
import torch

from lab import fusion


@pytest.mark.slow
def test_every_fusion_finds_the_container(tmp_path: Path):
    figures = fusion.measure("ball_statue", list(fusion.WAYS), tmp_path, 96)
    found = {(row["way"], row["depths"]): row["distance"] for row in figures}
    assert set(found) == {(way, depths) for way in fusion.WAYS for depths in ("exact", "noisy")}
    for way in fusion.WAYS:
        assert 0 < found[way, "exact"] < 0.01, way
    assert max(found.values()) < 0.02
    assert all(row["peak_mb"] > 50 and row["cpu_seconds"] > 0 for row in figures)


def test_noise_is_of_the_documented_size_and_leaves_holes_alone():
    generator = torch.Generator().manual_seed(0)
    depth = torch.full((200, 300), 2.0)
    depth[:20] = 0.0
    relative = fusion.noisy(depth, generator)[20:] / 2.0 - 1
    assert (fusion.noisy(depth, generator)[:20] == 0).all()
    small = relative[relative.abs() < 4 * (fusion.PIXEL_NOISE + fusion.SMOOTH_NOISE)]
    assert fusion.PIXEL_NOISE < float(small.std()) < fusion.PIXEL_NOISE + fusion.SMOOTH_NOISE
    share = float((relative.abs() > 0.03).float().mean())
    assert 0.4 * fusion.OUTLIERS * 0.8 < share < fusion.OUTLIERS, "those off by 3 to 5 %: two fifths of the outliers"
