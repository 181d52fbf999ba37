"""CONTRIBUTING.md names the files of each kind of change: every path leads somewhere, and lists are where it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.citations import FOLDERS, SINGLE, Library

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PATH = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[^`\s]*|{'|'.join(map(re.escape, SINGLE))})`")
KINDS = (
    *("method in this project", "kind of Gaussian", "loss term", "pipeline step", "ablation", "scene"),
    *("native kernel", "tool that measures", "experiment", "page of docs", "exported name", "example"),
)
DEFINED = {
    "rtgs/methods/registry.py": "_OWN =",
    "rtgs/methods/family.py": "StageSpec(",
    "rtgs/methods/parts/kinds.py": "GaussianKind(",
    "rtgs/methods/losses.py": "LossTerm(",
    "rtgs/train/settings.py": "class LossSettings",
    "rtgs/core/recipe.py": "UNLESS_DEFAULT =",
    "rtgs/gaussians/materials.py": "Channel(",
    "rtgs/scenes/settings.py": "CaptureFormat =",
    "rtgs/native/native.cmake": "set(RTGS_KERNELS",
    "rtgs/__init__.py": "_PLACES =",
}
"""What the page says that a file holds."""


def rows(text: str) -> dict[str, list[str]]:
    """Paths of each row of the table of changes."""
    table = text.partition("| what | files |")[2].partition("\n\n")[0]
    cells = [line.strip("|").split("|", 1) for line in table.splitlines()[2:]]
    return {cell[0].strip(): PATH.findall(cell[1]) for cell in cells}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_change_has_its_files(kind: str):
    assert rows(PAGE)[kind]


def test_every_path_is_there():
    library = Library(ROOT)
    named = PATH.findall(PAGE)
    assert len(named) > 60
    assert [path for path in named if not library.exists(path)] == []
    assert not library.exists("/".join(("rtgs", "methods", "<name>.toml")))


@pytest.mark.parametrize(("file", "text"), DEFINED.items())
def test_a_file_holds_what_the_page_says(file: str, text: str):
    assert file in PATH.findall(PAGE)
    assert text in (ROOT / file).read_text(encoding="utf-8")


def test_commands_that_write_files_are_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"`make ([\w-]+)`", PAGE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = [path.name for path in (ROOT / "docs").glob("*.md") if path.name != "README.md"]
    assert [name for name in pages if f"]({name})" not in index] == []
