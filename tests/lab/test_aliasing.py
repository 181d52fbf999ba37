"""The experiments on sizes and regions in a tiny mode."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab import aliasing, error_regions

WORDS = ("--scene", "ball_statue", "--preset", "smoke", "--side", "48")


def test_one_training_is_judged_at_sizes_and_error_maps_compare_two(run, tmp_path: Path) -> None:
    judged = ("--judge", "48", "32", "--supersample", "1", "2", "--set", "schedule.total=30")
    kept = {name: str(tmp_path / f"{name}.pt") for name in ("2dgs", "3dgs")}
    runs = {name: run(aliasing, *WORDS, *judged, "--method", name, "--keep", path) for name, path in kept.items()}
    first = runs["2dgs"]
    assert [(score["side"], score["supersample"]) for score in first["scores"]] == [(48, 1), (48, 2), (32, 1), (32, 2)]
    assert len({score["psnr"] for score in first["scores"]}) == 4
    assert all(5 < score["psnr"] < 40 for score in first["scores"])
    again = run(aliasing, *WORDS, *judged, "--method", "2dgs", "--given", kept["2dgs"])
    assert again["scores"] == first["scores"]
    assert again["gaussians"] == first["gaussians"]

    box = ("--box", "left half", "all", "0", "0", "0.5", "1", "--pictures", str(tmp_path / "maps"))
    pair = ("--first", "2dgs", kept["2dgs"], "--second", "3dgs", kept["3dgs"])
    found = run(error_regions, *WORDS, *pair, *box)
    scores = {score["region"]: score for score in found}
    whole = scores["all"]
    assert (whole["share"], whole["excess"]) == (1.0, pytest.approx(1.0))
    assert scores["left half"]["share"] == pytest.approx(0.5)
    thirds = [scores[f"{name} third"] for name in ("near", "middle", "far")]
    assert sum(third["share"] for third in thirds) == pytest.approx(1.0)
    assert sum(third["excess"] for third in thirds) == pytest.approx(1.0)
    apart = [scores.get(name, {"share": 0.0})["share"] for name in ("thin", "edges, not thin", "flat")]
    assert sum(apart) == pytest.approx(1.0)
    assert list((tmp_path / "maps").glob("*.png"))
