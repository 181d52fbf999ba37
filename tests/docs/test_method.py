"""docs/method.md tells the truth where it can be checked: its tables, its keys."""

from __future__ import annotations

import re
from dataclasses import asdict

import pytest
import torch

from rtgs.config.schema import RunConfig
from rtgs.core.recipe import flatten
from rtgs.evaluate.tables import PAPER_SCORES, PaperScore
from rtgs.optics.microfacet import ggx_distribution, remap_roughness
from tests.docs.register import REGISTER, ROOT

PAGE = (ROOT / "docs/method.md").read_text(encoding="utf-8")
GROUPS = {key.split(".")[0] for key in flatten(asdict(RunConfig())) if "." in key}


def rows(text: str) -> list[list[str]]:
    """Cells of every row of a Markdown table, its ruler left out."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("|---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def section(number: str) -> str:
    """The text below one numbered heading, up to the next one."""
    found = re.search(rf"^#+ {re.escape(number)}\.? .*?$(.*?)(?=^#+ \d|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


def test_the_table_of_the_remap_is_the_remap():
    roughness, width, at_normal = (row[1:] for row in rows(section("4.2")))
    g = remap_roughness(torch.tensor([float(cell) for cell in roughness], dtype=torch.float64))
    assert g.tolist() == pytest.approx([float(cell) for cell in width], rel=2e-3)
    distribution = ggx_distribution(torch.ones_like(g), g)
    assert distribution.tolist() == pytest.approx([float(cell) for cell in at_normal], rel=6e-3)


def test_the_published_results_are_those_of_the_tables_module():
    found: dict[tuple[str, str], PaperScore] = {}
    scenes: list[str] = []
    for head, *cells in rows(section("11")):
        if head == "method":
            scenes = cells
        else:
            scores = (PaperScore(*(float(number) for number in cell.split(" / "))) for cell in cells)
            found |= {(head, scene): score for scene, score in zip(scenes, scores, strict=True)}
    assert found == PAPER_SCORES


def test_every_equation_of_the_paper_has_a_place():
    places = rows(section("1.2"))[1:]
    assert [int(row[0]) for row in places] == list(range(1, 19))
    for row in places:
        assert section(row[2]), row


@pytest.mark.parametrize("page", [PAGE, REGISTER.read_text(encoding="utf-8")], ids=["method.md", "decisions.md"])
def test_every_key_is_one_of_the_schema(page: str):
    keys = set(flatten(asdict(RunConfig())))
    keys |= {".".join(key.split(".")[:depth]) for key in keys for depth in range(2, key.count(".") + 1)}  # groups
    named = re.findall(r"`([a-z_0-9]+(?:\.[a-z_0-9]+)+)(?:=[^`]*)?`", page)
    named = [name for name in named if name.split(".")[0] in GROUPS]
    assert len(named) > 20
    assert [name for name in named if name not in keys] == []
