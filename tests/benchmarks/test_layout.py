"""Tools and experiments are where the docs say, and import what they may."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"python -m ((?:benchmarks|lab|rtgs|pipelines)[\w.]*)")


def modules(folder: str) -> set[str]:
    """Every module below a folder of the repository but packages, by dotted name."""
    files = [path for path in (ROOT / folder).rglob("*.py") if path.name != "__init__.py"]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files}


def imported(path: Path) -> set[str]:
    """First words of all that a file imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


def written() -> list[Path]:
    """What names commands: pages, configs, the Makefile."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", ROOT / "lab" / "README.md"]
    for folder, kind in (("docs", "*.md"), ("conf", "*.yaml"), ("benchmarks", "*.yaml")):
        found += sorted((ROOT / folder).rglob(kind))
    return found


def test_the_table_lists_every_tool_once_and_nothing_else() -> None:
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w.]+)` \|.*\| `python -m ([\w.]+)", text, re.MULTILINE)
    commands = [command for _, command in rows]
    assert [name for name, _ in rows] == [command.removeprefix("benchmarks.") for command in commands]
    assert len(commands) == len(set(commands))
    assert set(commands) == modules("benchmarks/speed") | modules("benchmarks/quality")


def test_the_lab_lists_every_experiment() -> None:
    text = (ROOT / "lab" / "README.md").read_text(encoding="utf-8")
    for module in modules("lab"):
        assert f"`{module.split('.')[1]}`" in text or f"`python -m {module}" in text, module


@pytest.mark.parametrize("folder", ["benchmarks/speed", "benchmarks/quality"])
def test_every_tool_is_a_command(folder: str) -> None:
    for path in (ROOT / folder).glob("*.py"):
        if path.name != "__init__.py":
            assert 'if __name__ == "__main__":' in path.read_text(encoding="utf-8"), path


@pytest.mark.parametrize(
    ("folder", "barred"),
    [
        ("benchmarks", {"tests", "lab"}),
        ("lab", {"tests"}),
        ("rtgs", {"tests", "lab", "benchmarks"}),
        ("pipelines", {"tests", "lab", "benchmarks"}),
    ],
)
def test_tools_and_experiments_import_no_tests(folder: str, barred: set[str]) -> None:
    files = sorted((ROOT / folder).rglob("*.py"))
    assert len(files) > 5
    reaching = {path.relative_to(ROOT).as_posix(): imported(path) & barred for path in files}
    assert {path: names for path, names in reaching.items() if names} == {}


def test_every_command_that_is_written_exists() -> None:
    missing = []
    for path in written():
        for name in COMMAND.findall(path.read_text(encoding="utf-8")):
            if importlib.util.find_spec(name.rstrip(".")) is None:
                missing.append(f"{path.relative_to(ROOT)}: {name}")
    assert missing == []
