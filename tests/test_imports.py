"""The core stands without the tools around it (docs/architecture.md, rule 1)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rtgs

ROOT = Path(rtgs.__file__).parent
CORE = ("cameras", "gaussians", "render", "optics", "mesh", "scenes", "train", "methods", "evaluate")
TOOLS = ("hydra", "omegaconf", "mlflow", "dask", "distributed")


def modules(part: str) -> list[str]:
    """Every module of a part of the core by dotted name."""
    if (ROOT / f"{part}.py").is_file():
        return [f"rtgs.{part}"]
    files = [path.relative_to(ROOT.parent).with_suffix("") for path in sorted((ROOT / part).rglob("*.py"))]
    names = [".".join(path.parts).removesuffix(".__init__") for path in files]
    return [name for name in names if not name.endswith("__main__") and ".synthetic" not in name]


def test_the_core_imports_no_tool():
    names = [name for part in CORE for name in modules(part)]
    assert len(names) > 20
    code = (
        "import importlib, sys\n"
        f"for name in {names!r}:\n    importlib.import_module(name)\n"
        f"print(sorted({{m.split('.')[0] for m in sys.modules}} & {set(TOOLS)!r}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


def test_the_library_does_not_reach_up_into_the_pipelines():
    """Only ``python -m rtgs``, a door to the command line, does."""
    reaching = []
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            reaching += [path.relative_to(ROOT).as_posix() for name in names if name.split(".")[0] == "pipelines"]
    assert reaching == ["__main__.py"]


@pytest.mark.parametrize("name", ["pipelines.cli.main", "pipelines.run", "rtgs.workflow", "rtgs.track"])
def test_what_starts_quickly_imports_no_heavy_library(name):
    heavy = {"torch", "mlflow", "hydra", "pycolmap", "open3d", "matplotlib", "cv2"}
    code = f"import sys, {name}; print(sorted({{m.split('.')[0] for m in sys.modules}} & {heavy!r}))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
