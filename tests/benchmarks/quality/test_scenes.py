"""The scenes that methods are tried on beside the shipped ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtgs.scenes.synthetic.description import read_description

SCENES = sorted((Path(__file__).parents[3] / "benchmarks" / "scenes").glob("*.toml"))
SHIPPED = {path.stem for path in (Path(__file__).parents[3] / "rtgs/scenes/synthetic/scenes").glob("*.toml")}


def test_there_are_some_and_none_has_the_name_of_a_shipped_one():
    assert len(SCENES) >= 5
    assert not SHIPPED & {path.stem for path in SCENES}


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_each_can_be_made_and_has_glass_or_mirrors(path: Path):
    found = read_description(path)
    assert {shape.material.kind for shape in found.shapes} & {"thin_glass", "mirror"}
    assert len({shape.name for shape in found.shapes}) == len(found.shapes)
