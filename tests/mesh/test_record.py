"""``mesh.json``: what is written comes back, old files are read, damaged ones are named."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.mesh.record import MeshRecord, MeshTruth, SurfaceFit

SCENE = MeshRecord(note="Voxel 0.1.", picture_from="a.png", depth_trunc=3.0, pieces_found=2, pieces_kept=1, voxel=0.1)
OBJECT = MeshRecord(
    note="Of the transparent object.",
    silhouette_iou=0.99,
    candidates={"hull": 0.99, "pane": 0.5},
    decisions=(Decision("object mesh: hull", "mesh.source is auto"), Decision("no TSDF mesh", "no depth")),
    masks_outvoted=0,
    trimmed=0.01,
    trim_views=8,
    truth=MeshTruth(0.1, 0.1, 0.1, 0.9, math.nan, 2.0),
    source="hull",
    voxel=0.02,
    flat=False,
    surface="free",
    surface_fit=SurfaceFit(0.99, 0.995, 0.4, 0.3, 0.05, strength=1.5, sharp=0.2, unseen=0.0, feet=1, held=0),
    vertices=8,
    faces=12,
)

UNSEEN = replace(OBJECT, truth=None, surface_fit=SurfaceFit(0.99, 0.995, None, None, 1.0))


@pytest.mark.parametrize(
    "record", [SCENE, replace(OBJECT, truth=None), UNSEEN, MeshRecord(absent="there are no masks")]
)
def test_a_record_comes_back_and_what_is_not_known_is_not_written(record: MeshRecord, tmp_path: Path) -> None:
    record.write(tmp_path)
    assert MeshRecord.read(tmp_path) == record
    values = json.loads((tmp_path / "mesh.json").read_text())
    known = {key for key, value in vars(record).items() if value not in (None, ())}
    assert set(values) == known


def test_a_share_of_no_pixels_stays_nan(tmp_path: Path) -> None:
    OBJECT.write(tmp_path)
    truth = MeshRecord.read(tmp_path).truth
    assert truth is not None
    assert math.isnan(truth.back_within_3_percent)
    assert truth.front_within_3_percent == 0.9


def test_files_of_older_versions_are_read(tmp_path: Path) -> None:
    """Pairs for decisions, an empty object where no truth is known; the copy beside a checkpoint has five keys."""
    (tmp_path / "mesh.json").write_text('{"decisions": [["what", "why"]], "truth": {}, "absent": "no masks"}')
    record = MeshRecord.read(tmp_path)
    assert record == MeshRecord(absent="no masks", decisions=(Decision("what", "why"),))
    (tmp_path / "mesh.json").write_text('{"source": "hull", "voxel": 0.1, "flat": false, "vertices": 8, "faces": 12}')
    assert MeshRecord.read(tmp_path) == MeshRecord(source="hull", voxel=0.1, flat=False, vertices=8, faces=12)


@pytest.mark.parametrize(
    "text",
    ['{"voxel": "big"}', '{"decisions": [["alone"]]}', '{"decisions": 3}', '{"truth": {"distance": 1}}', "{", "[]"],
)
def test_a_damaged_file_is_named_with_the_remedy(text: str, tmp_path: Path) -> None:
    (tmp_path / "mesh.json").write_text(text)
    with pytest.raises(RtgsError, match=r"mesh\.json cannot be read as a record .*rtgs cache verify"):
        MeshRecord.read(tmp_path)
