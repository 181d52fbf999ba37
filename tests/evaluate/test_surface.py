"""The surface in the mask against the truth; what the object's mesh lacks, counted; both in tables and files."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.steps.evaluate import object_facts
from pipelines.steps.report import _guide
from rtgs.evaluate.evaluate import TimedRender, evaluate_views
from rtgs.evaluate.publish import Measured, TableSpec, build_table
from rtgs.evaluate.records import SURFACE_METRICS, EvaluationTable, ObjectFacts, RunFacts, read_json, write_json
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.evaluate.surface import depth_off, hit_shares, surface_scores
from rtgs.evaluate.table_formats import comma_separated, markdown
from rtgs.mesh.container import ObjectMesh, write_object_mesh
from rtgs.mesh.record import MeshRecord, MeshTruth
from rtgs.mesh.score import container_mesh, hit_score
from tests.mesh.shapes import camera_at

QUICK = EvaluationSettings(lpips=False, eight_bit=False)
KNOWN = ObjectFacts("hull", False, 0.97, 0.0012, 0.99, 0.98, 0.02, 0.005, 0.01)


@dataclass(frozen=True)
class Truth:
    depth: Tensor
    normal: Tensor
    specular: Tensor
    reflected: Tensor
    transmitted: Tensor


@dataclass(frozen=True)
class Photo:
    name: str
    image: Tensor
    mask: Tensor | None
    truth: Truth | None


@dataclass(frozen=True)
class Surfaces:
    hit: Tensor
    second: Tensor


def truth() -> Truth:
    """A wall two units away, nothing in the last row."""
    depth = torch.full((12, 14), 2.0)
    depth[-1] = 0.0
    normal = torch.zeros(3, 12, 14)
    normal[2] = -1.0
    light = torch.full((3, 12, 14), 0.2)
    return Truth(depth, normal, depth > 0, light, light)


def tilted(degrees: float) -> Tensor:
    """A normal of length 0.3, so many degrees off the wall's."""
    angle = math.radians(degrees)
    return 0.3 * torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])[:, None, None].expand(3, 12, 14)


def test_medians_and_shares_of_the_masked_pixels_that_show_something():
    exact, mask = truth(), torch.zeros(12, 14, dtype=torch.bool)
    mask[6:, :10] = True  # 50 pixels on the wall, 10 where nothing is
    depth = torch.full((12, 14), 9.0)
    depth[6:, :10] = 2.02
    depth[6:8, :10] = 2.2
    scores = surface_scores(depth, tilted(10.0), exact, mask)
    assert scores["depth_error_masked"] == pytest.approx(0.01, rel=1e-4)
    assert scores["depth_share_masked"] == pytest.approx(30 / 50)
    assert scores["normal_degrees_masked"] == pytest.approx(10.0, abs=1e-2)
    assert scores["normal_share_masked"] == 1.0
    assert surface_scores(depth, tilted(20.0), exact, mask)["normal_share_masked"] == 0.0
    assert set(surface_scores(depth, None, exact, mask)) == set(SURFACE_METRICS[:2])
    assert surface_scores(None, None, exact, mask) == {}
    assert surface_scores(depth, None, exact, ~(exact.depth > 0)) == {}


def test_depth_that_is_off_over_the_whole_picture():
    exact = truth()  # 11 of 12 rows show something
    depth = torch.full((12, 14), 2.08)
    depth[:3] = 2.2
    depth[3, :7] = 0.0
    assert depth_off(depth, exact) == pytest.approx(3.5 / 11)
    assert depth_off(depth, replace(exact, depth=torch.zeros(12, 14))) is None


def test_fallbacks_are_counted_in_the_masks():
    hit, second = torch.zeros(4, 5, dtype=torch.bool), torch.zeros(4, 5, dtype=torch.bool)
    hit[:, :4], second[:, :3] = True, True
    mask = torch.ones(4, 5, dtype=torch.bool)
    mask[0] = False
    assert hit_shares([(Surfaces(hit, second), mask)] * 2) == (3 / 15, 3 / 15)
    assert hit_shares([]) == (None, None)
    assert "2.00% meet one surface only, 0.50% miss the mesh" in KNOWN.fallbacks
    assert "1.00% miss it: nothing is transmitted" in KNOWN.fallbacks
    assert "by nature" in replace(KNOWN, flat=True).fallbacks
    assert replace(KNOWN, one_hit=None).fallbacks == "no masks"
    assert set(KNOWN.numbers()) == {*vars(KNOWN)} - {"source", "flat"}


def evaluated(seed: int = 0, known: ObjectFacts | None = KNOWN) -> EvaluationTable:
    mask = torch.zeros(12, 14, dtype=torch.bool)
    mask[2:8, 2:9] = True
    picture = torch.rand(3, 12, 14, generator=torch.Generator().manual_seed(seed))
    views = [Photo("a.png", picture, mask, truth()), Photo("b.png", picture, None, truth())]
    render = TimedRender(picture, depth=torch.full((12, 14), 2.02), normal=tilted(5.0))
    return evaluate_views([render, render], views, RunFacts("ball_statue", "rtgs"), QUICK, object_facts=known)


def test_they_are_in_the_table_and_come_back_from_its_file(tmp_path: Path):
    table = evaluated()
    assert table.count("normal_degrees_masked") == 1
    assert table.mean("normal_degrees_masked") == pytest.approx(5.0, abs=1e-2)
    assert "only path-traced captures" in table.missing["depth_error_masked"]
    write_json(tmp_path / "metrics.json", table)
    assert read_json(tmp_path / "metrics.json") == table
    assert json.loads((tmp_path / "metrics.json").read_text())["object"]["distance"] == 0.0012
    write_json(tmp_path / "none.json", evaluated(known=None))
    assert read_json(tmp_path / "none.json").object is None


def test_a_published_table_has_them_and_real_captures_only_the_silhouettes():
    spec = TableSpec("table2", "Table 2", "stand_in")
    table = build_table(spec, [Measured(evaluated(), 0)])
    text = markdown(table)
    assert "## Against the truth of path-traced scenes" in text
    for title in ("mesh to container, diagonals", "normal error in the mask, degrees", "depth within 3 % in the mask"):
        assert title in text
    assert "0.0012" in text
    row = next(csv.DictReader(io.StringIO(comma_separated(table))))
    assert float(row["object_distance"]) == 0.0012
    assert float(row["object_silhouette_iou"]) == 0.97
    real = replace(KNOWN, distance=None, front=None, back=None)
    rows = tuple(replace(view, values=view.values | dict.fromkeys(SURFACE_METRICS)) for view in evaluated().rows)
    text = markdown(build_table(spec, [Measured(replace(evaluated(known=real), rows=rows), 0)]))
    assert "IoU of mesh and masks" in text
    assert "path-traced scenes\n" not in text


def test_what_no_pixel_can_tell_is_none_and_the_table_is_written(tmp_path: Path):
    """A pane has no second surface to judge: a share of no pixels is NaN, which JSON has not."""
    true = container_mesh("ball_statue")
    assert true is not None
    middle, size = true.vertices.mean(0), float(true.vertices.max() - true.vertices.min())
    camera = camera_at(tuple(middle - np.array([0, 2 * size, 0])), tuple(middle), width=24, height=18, focal=24)
    pane = ObjectMesh(true, "given", 0.1, flat=True)
    hits = hit_score(pane, true, [camera])
    assert math.isnan(hits.back)
    truth = MeshTruth(0.1, 0.1, 0.1, hits.front, hits.back, hits.normal_median)
    write_object_mesh(tmp_path, pane, MeshRecord(silhouette_iou=1.0, truth=truth))
    known = object_facts(tmp_path, SimpleNamespace(name="ball_statue", train=(), test=()))  # type: ignore[arg-type]
    assert (known.front, known.back) == (hits.front, None)
    table = evaluated(known=known)
    write_json(tmp_path / "metrics.json", table)
    assert read_json(tmp_path / "metrics.json").object == known
    assert _guide(table)[-1].why.endswith("second none to judge")
