"""docs/api.md is the reference of what rtgs exports: made of the docstrings, and none is missing."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

import rtgs

ROOT = Path(__file__).resolve().parents[2]
FUNCTION = '''def fill(box, level=1):
    """Fill it.

    Parameters
    ----------
    box : Box
        What is filled.
    level : int, optional
        How far.

    Returns
    -------
    int
        How full it was.
    """
'''


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_api", ROOT / "docs" / "make_api.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def toy(root: Path, text: str) -> Path:
    """A package that exports ``fill`` from a module of this text."""
    (root / "rtgs" / "core").mkdir(parents=True)
    (root / "rtgs" / "__init__.py").write_text('from rtgs.core.box import fill\n\n__all__ = ["fill"]\n')
    (root / "rtgs" / "core" / "__init__.py").write_text("")
    (root / "rtgs" / "core" / "box.py").write_text(text)
    return root


def test_the_page_is_as_the_docstrings_are(tool: ModuleType):
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert page == tool.build().rstrip() + "\n", "run `make docs`"


def test_every_exported_name_has_an_entry(tool: ModuleType):
    names = re.findall(r"^### (\w+)$", tool.build(), re.MULTILINE)
    assert sorted(names) == sorted(name for name in rtgs.__all__ if name != "__version__")


def test_an_entry_says_what_goes_in_and_what_comes_out(tool: ModuleType, tmp_path: Path):
    page = tool.build(toy(tmp_path, FUNCTION))
    assert "### fill\n\n`rtgs.core.box" in page
    assert "- `box` (Box): What is filled.\n- `level` (int): How far.\n\nReturns:\n\n- int: How full it was.\n" in page


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def fill(box, level=1):\n    return box\n", "has no docstring"),
        (FUNCTION.replace("level : int", "height : int"), "Parameter 'height' does not appear in the function"),
        ('def fill():\n    """Fill it.\n\n    Returns:\n        How full it was.\n    """\n', "underlined titles"),
    ],
    ids=["no docstring", "another parameter", "another layout"],
)
def test_what_is_not_documented_stops_the_build(tool: ModuleType, tmp_path: Path, text: str, message: str):
    with pytest.raises(ValueError, match=message):
        tool.build(toy(tmp_path, text))


def test_a_name_of_a_room_without_a_heading_is_named(tool: ModuleType, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(tool, "GROUPS", {"Rendering": ("rtgs.render",)})
    with pytest.raises(ValueError, match=r"no heading of GROUPS in docs/make_api\.py takes fill"):
        tool.build(toy(tmp_path, FUNCTION))
