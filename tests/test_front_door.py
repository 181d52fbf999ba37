"""``import rtgs``: what it exports, where each name comes from, and that it is quick (test_imports.py)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rtgs


def imported_for_type_checkers() -> dict[str, str]:
    """Module by name, of the imports that only type checkers see."""
    tree = ast.parse(Path(rtgs.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name)]
    return {
        alias.name: str(node.module) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }


def test_type_checkers_and_programs_see_the_same_names():
    assert imported_for_type_checkers() == rtgs._MODULE_OF
    assert sorted(rtgs.__all__) == sorted([*rtgs._MODULE_OF, "__version__"])
    assert set(rtgs.__all__) <= set(dir(rtgs))


@pytest.mark.parametrize("name", rtgs.__all__)
def test_every_name_is_there(name: str):
    found = getattr(rtgs, name)
    if name != "__version__":
        assert found is getattr(sys.modules[rtgs._MODULE_OF[name]], name)
        assert found.__name__ == name


def test_a_name_that_is_not_exported_is_refused():
    with pytest.raises(AttributeError, match=r"no attribute 'rasterise_surfels'; it exports .*rasterize_surfels"):
        rtgs.rasterise_surfels  # noqa: B018
    with pytest.raises(ImportError):
        from rtgs import nothing  # noqa: F401


def test_settings_and_their_checks_load_no_torch():
    code = "import sys, rtgs; rtgs.ScheduleSettings(); rtgs.SceneSettings(); print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
