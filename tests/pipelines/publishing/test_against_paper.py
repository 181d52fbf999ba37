"""Every way in which a run differs from the paper, from its config: nothing where it is the paper."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pipelines.publishing import against_paper
from pipelines.publishing.against_paper import keys_of, ways_of
from rtgs.config import compose
from rtgs.config.schema import OF_THE_MACHINE
from rtgs.core.decisions import Decision

SCENE = "scene=nu_nerf/ballstatue"


def differing(row: str, *words: str) -> dict[str, str]:
    """Value and the paper's, by key."""
    method = row.split(", ")
    chosen = [f"method={method[0]}", *(f"ablation={name}" for name in method[1:])]
    ways = keys_of(compose([SCENE, *chosen, *words])[0], row)
    return {way.split(" is ")[0]: way.split(" is ")[1] for way in ways}


@pytest.mark.parametrize("row", ["rtgs_printed", "rtgs_printed, no_mesh_guide", "3dgs", "envgs"])
def test_the_paper_differs_from_itself_in_nothing(row: str):
    assert differing(row, "preset=paper") == {}


def test_where_and_how_a_run_is_made_is_no_difference():
    words = {"name": "mine", "threads": 1, "processes": 1, "view": "true"}
    assert words.keys() == set(OF_THE_MACHINE)
    assert differing("rtgs_printed", "preset=paper", *(f"{key}={value}" for key, value in words.items())) == {}


def test_a_short_run_differs_in_more_than_its_length():
    found = differing("rtgs_printed", "preset=quick")
    assert found["schedule.total"] == "2000 instead of 60000"
    assert found["scene.long_side"] == "400 instead of None"
    assert found["method.density.max_surfels"] == "30000 instead of 2000000"
    assert "method.optics.max_gain" not in found
    assert not [key for key in found if key.startswith(("tracking", "paths", "evaluation", "table", "name"))]


def test_rtgs_with_the_papers_schedule_differs_in_all_that_is_its_own():
    found = differing("rtgs", "preset=paper")
    assert found["method.optics.max_gain"] == "1 instead of 0"
    assert found["method.materials.f0"] == "0.9 instead of 0.04"
    assert found["mesh.source"] == "auto instead of tsdf"
    assert found["method.transmittance.wall.light"] == "fresnel instead of learned"
    assert "schedule.total" not in found


def test_an_ablation_of_the_paper_is_compared_with_the_papers_and_one_of_ours_with_the_paper():
    assert "method.loss.transmission_depth" not in differing("rtgs, no_depth_loss", "preset=paper")
    assert differing("rtgs, mesh_hull", "preset=paper").get("mesh.source") is None  # of the paper with a hull
    assert differing("rtgs, opaque_start", "preset=paper")["mesh.source"] == "auto instead of tsdf"


def test_what_a_method_does_not_read_is_no_difference():
    found = differing("3dgs", "preset=quick")
    assert "schedule.total" in found
    assert not [key for key in found if key.startswith(("method.transmittance", "method.reflection", "method.optics"))]


def test_what_training_left_out_is_told(monkeypatch: pytest.MonkeyPatch):
    decisions = (Decision("no perceptual loss", "no weights"), Decision("no distortion loss", "its weight is 0 in x"))
    monkeypatch.setattr(against_paper, "read_summary", lambda folder: SimpleNamespace(decisions=decisions))
    monkeypatch.setattr(against_paper, "final_training", lambda results: None)
    config = compose([SCENE, "method=rtgs_printed", "preset=paper"])[0]
    assert ways_of(config, "rtgs_printed", ()) == ("no perceptual loss: no weights",)
