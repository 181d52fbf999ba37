"""The core stands without the tools around it (docs/architecture.md, rule 1)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rtgs

ROOT = Path(rtgs.__file__).parent
WITHOUT_TOOLS = (
    *("core", "native", "scenes", "optics", "gaussians", "render", "mesh", "pretrained", "prepare"),
    *("train", "methods", "evaluate", "report"),
)
TOOLS = ("hydra", "omegaconf", "mlflow", "dask", "distributed")


def modules(room: str) -> list[str]:
    """Every module of a room by dotted name; those of path tracing need Mitsuba, which is optional."""
    files = [path.relative_to(ROOT.parent).with_suffix("") for path in sorted((ROOT / room).rglob("*.py"))]
    names = [".".join(path.parts).removesuffix(".__init__") for path in files]
    return [name for name in names if not name.endswith("__main__") and ".synthetic" not in name]


def test_the_rooms_of_the_core_import_no_tool():
    names = [name for room in WITHOUT_TOOLS for name in modules(room)]
    assert all(modules(room) for room in WITHOUT_TOOLS)
    code = (
        "import importlib, sys\n"
        f"for name in {names!r}:\n    importlib.import_module(name)\n"
        f"print(sorted({{m.split('.')[0] for m in sys.modules}} & {set(TOOLS)!r}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "name", ["rtgs", "pipelines.cli.main", "pipelines.run", "rtgs.workflow", "rtgs.workflow.sources", "rtgs.track"]
)
def test_what_starts_quickly_imports_no_heavy_library(name):
    heavy = {"torch", "mlflow", "hydra", "pycolmap", "open3d", "matplotlib", "cv2"}
    code = f"import sys, {name}; print(sorted({{m.split('.')[0] for m in sys.modules}} & {heavy!r}))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_planning_loads_neither_torch_nor_the_guard():
    """``rtgs plan`` answers at once, and what runs does not look at its own source."""
    watched = {"torch", "mlflow", "pycolmap", "open3d", "rtgs.workflow.sources", "rtgs.workflow.closure"}
    code = (
        "import sys, pipelines.planning.graph, pipelines.planning.plan\n"
        f"print(sorted({{name for name in sys.modules}} & {watched!r}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_plan_of_a_colmap_capture_leaves_pycolmap_out_of_the_process():
    """It would stay loaded while the run trains."""
    code = (
        "import sys; from pipelines.cli.main import main\n"
        "assert main(['plan', 'scene=demo', f'paths.root={sys.argv[1]}']) == 0\n"
        "print(sorted(set(sys.modules) & {'torch', 'mlflow', 'pycolmap', 'open3d', 'matplotlib', 'cv2'}))"
    )
    command = [sys.executable, "-c", code, "/nowhere"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"
